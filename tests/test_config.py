"""Strict configuration: unknown keys, wrong types, and targets outside the package are refused by name."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import optax
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tagjax.benchmarks.stages import BenchmarkSettings
from tagjax.core.build import build
from tagjax.core.settings import ConfigError, changed, from_mapping
from tagjax.evaluation.flow import FlowEvaluationSettings
from tagjax.evaluation.run import EvaluateConfig
from tagjax.flow.losses import FlowLossSettings
from tagjax.metrics.recordings import ScoreSettings
from tagjax.recording.loading import VirtualTagSettings
from tagjax.tagattention import TagAttention
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.clips import ClipSettings
from tagjax.training.config import TrainConfig
from tagjax.training.flow_sources import FlowDataSettings
from tagjax.training.hindsight import HindsightSettings
from tagjax.training.logging import LoggerSettings
from tagjax.training.loop import LoopSettings
from tagjax.training.objective import ObjectiveSettings
from tagjax.training.optimizers import build_optimizer
from tagjax.training.processes import DistributedSettings
from tagjax.training.sources import DataSettings

CONF = Path(__file__).parents[1] / "conf"

LEAST = {"tracer": {"_target_": "tagjax.tagattention.TagAttention"}, "optimizer": {"_target_": "optax.sgd"}}


def test_nested_values_reach_their_fields() -> None:
    given = {**LEAST, "clip_norm": 2, "data": {"recordings": ["a.zarr"], "clips": {"stride": 8, "epcs": None}}}
    made = from_mapping(TrainConfig, given)
    assert made.clip_norm == 2.0
    assert isinstance(made.clip_norm, float)
    assert made.data.recordings == ("a.zarr",)
    assert made.data.clips.stride == 8
    assert made.loop == LoopSettings()


def test_what_a_schema_holds_survives_the_round_trip() -> None:
    made = from_mapping(TrainConfig, LEAST)
    assert from_mapping(TrainConfig, dataclasses.asdict(made)) == made


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"steps": 3}, "unknown key 'steps'"),
        ({"data": {"clips": {"strid": 3}}}, r"data\.clips: unknown key 'strid'"),
        ({"seed": "one"}, "seed: found 'one'; expected int"),
        ({"seed": True}, "seed: found True"),
        ({"data": {"recordings": "a.zarr"}}, "expected a list of str"),
        ({"logger": {"mode": "loud"}}, "expected one of 'disabled', 'offline', 'online'"),
        ({"data": {"clips": {"window": None}}}, "data.clips.window: found None"),
        ({"data": 3}, "expected keys and values"),
        ({"data": {"clips": {"stride": 0}}}, r"data\.clips: stride is 0; expected at least 1"),
        ({"data": {"clips": {"stride": -2}}}, r"data\.clips: stride is -2"),
        ({"data": {"clips": {"window": 1}}}, r"data\.clips: window is 1; expected at least 2"),
        ({"data": {"clips": {"max_reads": 0}}}, r"data\.clips: max_reads is 0; expected at least 1"),
        ({"data": {"clips": {"length": 6, "window": 7}}}, r"length is 6; expected at least the window's 7"),
        ({"data": {"virtual_tag": {"seeds": [1]}}}, r"data\.virtual_tag: tracks is null, so there are no virtual tags"),
        ({"data": {"virtual_tag": {"seeds": []}}}, r"data\.virtual_tag: seeds is empty; expected at least one"),
        ({"scores": {"tags_at_once": 0}}, r"scores: tags_at_once is 0; expected at least 1"),
        ({"scores": {"frames_at_once": -1}}, r"scores: frames_at_once is -1; expected at least 1"),
        ({"scores": {"mask_level": 50.0}}, r"scores: mask_level is 50\.0; expected a value from 0 to 1"),
        ({"scores": {"from_s": 2.0, "until_s": 1.0}}, r"scores: until_s is 1\.0; expected more than from_s, 2\.0"),
    ],
)
def test_wrong_configuration_names_the_key(given: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(TrainConfig, {**LEAST, **given})


def test_missing_keys_and_lengths() -> None:
    with pytest.raises(ConfigError, match="tracer"):
        from_mapping(TrainConfig, {"optimizer": LEAST["optimizer"]})
    assert from_mapping(EvaluateConfig, {"frames": [3, 9]}).frames == (3, 9)
    with pytest.raises(ConfigError, match="found 3 elements; expected 2"):
        from_mapping(EvaluateConfig, {"frames": [3, 9, 2]})
    with pytest.raises(ConfigError, match="stride is 0; expected at least 1"):
        from_mapping(EvaluateConfig, {"clips": {"stride": 0}})
    assert from_mapping(DataSettings, {}) == DataSettings()


def test_build_makes_what_the_target_names() -> None:
    adam = build_optimizer({"_target_": "optax.adam", "learning_rate": 0.1})
    assert isinstance(adam, optax.GradientTransformation)
    nested = {"_target_": "optax.sgd", "learning_rate": {"_target_": "optax.constant_schedule", "value": 0.2}}
    assert isinstance(build_optimizer(nested), optax.GradientTransformation)
    assert isinstance(make_tracer({"_target_": "tagjax.tagattention.TagAttention"}), TagAttention)
    assert build({"_target_": "clips", "stride": 2}, {"clips": ClipSettings}) == ClipSettings(stride=2)


@pytest.mark.parametrize(
    "target",
    [
        "os.system",
        "tagjax.evaluation.timing.in_own_process",
        "tagjax.tagattention.learned.save_parameters",
        "tagjax.core.files.remove",
        "tagjax.training.logging.os.system",
        "tagjax.tagattention.TagAttention.__init__",
        "optax.tree_utils.tree_map_params",
        "optax.adam",
        "TagAttention",
        "",
        None,
        3,
        ["tagjax.tagattention.TagAttention"],
    ],
)
def test_only_tracers_are_built_where_a_tracer_is_expected(target: Any) -> None:
    with pytest.raises(
        ConfigError, match=r"tracer: found _target_ .* expected one of tagjax\.tagattention\.TagAttention"
    ):
        make_tracer({"_target_": target})


def test_nothing_is_called_before_all_names_are_checked() -> None:
    called = []
    slot = {"outer": lambda **given: called.append("outer"), "inner": lambda: called.append("inner")}
    settings = {"_target_": "outer", "a": {"_target_": "inner"}, "b": {"_target_": "os.system"}}
    with pytest.raises(ConfigError, match=r"x\.b: found _target_ 'os\.system'; expected one of inner"):
        build(settings, {"outer": slot["outer"]}, where="x", inner={"inner": slot["inner"]})
    with pytest.raises(ConfigError, match="expected plain values"):
        build(settings, slot, where="x")
    with pytest.raises(ConfigError, match=r"optimizer\.learning_rate: found _target_ 'optax\.adam'"):
        build_optimizer({"_target_": "optax.adam", "learning_rate": {"_target_": "optax.adam", "learning_rate": 1.0}})
    assert called == []


def test_unknown_settings_of_a_target_are_refused() -> None:
    with pytest.raises(ConfigError, match="alhpa"):
        make_tracer({"_target_": "tagjax.tagattention.TagAttention", "alhpa": 1.0})


LITERAL, LEARNABLE = "tagattention.literal.TagAttentionLiteral", "tagattention.TagAttention"


@pytest.mark.parametrize(
    ("tracer", "settings", "message"),
    [
        (LITERAL, {"cell": 0}, r"tracer: cell is 0; expected an integer of at least 1"),
        (LITERAL, {"cell": 4.5}, r"tracer: "),  # beartype is first here
        (LITERAL, {"beta": 2.0}, r"tracer: beta is 2\.0; expected a fraction from 0 to 1"),
        (LITERAL, {"alpha_m2": -1.0}, r"tracer: alpha_m2 is -1\.0; expected a positive value"),
        (LITERAL, {"alpha_m2": float("nan")}, r"tracer: alpha_m2 is nan; expected a positive value"),
        (LEARNABLE, {"dwell": {"memory_s": -1.0}}, r"tracer\.dwell: .*-1\.0; expected a positive"),
        (LEARNABLE, {"dwell": {"memory_ms": 1.0}}, r"tracer\.dwell: .*memory_ms"),
        (LEARNABLE, {"dwell": None}, r"tracer: dwell and attention are both off"),
    ],
)
def test_settings_that_no_tracer_can_have_are_named(tracer: str, settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        make_tracer({"_target_": f"tagjax.{tracer}", **settings})


def _composed(command: str, *overrides: str) -> Any:
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return OmegaConf.to_container(compose(command, list(overrides)), resolve=True)


@pytest.mark.parametrize(
    ("command", "overrides", "path", "schema", "changes"),
    [
        ("train", [], "data", DataSettings, {}),
        ("train", ["experiment=clips"], "objective", ObjectiveSettings, {}),
        ("train", [], "hindsight", HindsightSettings, {}),
        ("train", [], "scores", ScoreSettings, {}),
        ("train", [], "loop", LoopSettings, {}),
        ("train", [], "logger", LoggerSettings, {}),
        ("train", [], "distributed", DistributedSettings, {}),
        ("train_flow", [], "distributed", DistributedSettings, {}),
        ("train_flow", [], "data", FlowDataSettings, {"drawn"}),
        ("train_flow", [], "loss", FlowLossSettings, {"smooth_first"}),
        ("evaluate", [], "virtual_tag", VirtualTagSettings, {}),
        ("evaluate_flow", [], "", FlowEvaluationSettings, {"pairs"}),
        ("benchmark", [], "", BenchmarkSettings, {}),
    ],
)
def test_defaults_in_code_are_those_of_the_files(
    command: str, overrides: list[str], path: str, schema: type, changes: set[str]
) -> None:
    """YAML is the home; a library user who gives no value gets what the command runs with. `changes` are exceptions."""
    values = _composed(command, *overrides)
    chosen = values if not path else values[path]
    names = {field.name for field in dataclasses.fields(schema)}
    given = {name: value for name, value in chosen.items() if name in names}
    assert set(given) == names
    assert path == "" or set(chosen) == names
    made, default = from_mapping(schema, given), schema()
    assert {name for name in names if getattr(made, name) != getattr(default, name)} == set(changes)


def test_defaults_of_an_evaluation_are_those_of_the_file() -> None:
    values = _composed("evaluate")
    names = {field.name for field in dataclasses.fields(EvaluateConfig)}
    given = {name: value for name, value in values.items() if name in names}
    assert from_mapping(EvaluateConfig, {**given, "clips": {}, "scores": {}}) == EvaluateConfig()
    for name, settings in (("clips", ClipSettings()), ("scores", ScoreSettings())):
        assert changed(settings, values[name], where=name) == settings
    assert set(values["scores"]) == {field.name for field in dataclasses.fields(ScoreSettings)}
    # Of a training clip only: its length, motion, tags and workers. The tags of an evaluation are the key `epcs`.
    of_training = {"length", "epcs", "min_motion", "max_tags", "workers"}
    assert set(values["clips"]) == {field.name for field in dataclasses.fields(ClipSettings)} - of_training


def test_an_unknown_key_comes_with_the_closest_known_one() -> None:
    with pytest.raises(ConfigError, match=r"unknown key 'strid'; known keys are stride, .*; did you mean 'stride'\?$"):
        from_mapping(TrainConfig, {**LEAST, "data": {"clips": {"strid": 3}}})


def test_several_unknown_keys_are_named_at_once() -> None:
    with pytest.raises(ConfigError, match=r"^loop: unknown key 'num_step', 'speed';"):
        from_mapping(TrainConfig, {**LEAST, "loop": {"num_step": 3, "speed": 1}})


@dataclasses.dataclass(frozen=True)
class _Inner:
    size: float = 1.0


@dataclasses.dataclass(frozen=True)
class _Outer:
    """Every kind of field that a schema has."""

    count: int
    word: str | None = None
    choice: Literal["all"] | tuple[int, ...] | None = None
    pair: tuple[float, float] = (0.0, 1.0)
    inner: tuple[_Inner, ...] = ()
    named: Mapping[str, _Inner] = dataclasses.field(default_factory=dict)
    values: Mapping[str, tuple[int | float | str | bool, ...]] = dataclasses.field(default_factory=dict)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"count": "1"}, r"^at\.count: found '1'; expected int"),
        ({"count": 1.0}, r"^at\.count: found 1\.0; expected int"),
        ({}, r"^at: no key 'count'; expected one: int"),
        ({"count": 1, "word": 3}, r"^at\.word: found 3; expected str"),
        ({"count": 1, "choice": "some"}, r"^at\.choice: found 'some'; expected (?=.*'all')(?=.*list of int).* or null"),
        ({"count": 1, "pair": [1, 2, 3]}, r"^at\.pair: found 3 elements; expected 2"),
        ({"count": 1, "pair": [1]}, r"^at\.pair: found 1 elements; expected 2"),
        ({"count": 1, "pair": [1, "2"]}, r"^at\.pair\[1\]: found '2'; expected float"),
        ({"count": 1, "inner": [{"size": 1}, {"siez": 2}]}, r"^at\.inner\[1\]: unknown key 'siez'.*mean 'size'"),
        ({"count": 1, "named": {"a": {"size": True}}}, r"^at\.named\.a\.size: found True; expected float"),
        ({"count": 1, "named": {"a": 3}}, r"^at\.named\.a: found 3; expected keys and values"),
        ({"count": 1, "values": {"a": [[1]]}}, r"^at\.values\.a\[0\]: found \[1\]; expected int .* or float"),
    ],
)
def test_the_place_of_a_fault_is_named_at_any_depth(given: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(_Outer, given, where="at")


def test_values_keep_their_types() -> None:
    given = {"count": 2, "choice": [1, 2], "pair": [1, 2.5], "inner": [{"size": 3}]}
    made = from_mapping(_Outer, {**given, "values": {"a": [1, 0.5, "b", True]}})
    assert made.choice == (1, 2)
    assert made.pair == (1.0, 2.5)
    assert made.inner == (_Inner(3.0),)
    assert [type(one) for one in (*made.pair, made.inner[0].size)] == [float] * 3
    assert [type(one) for one in made.values["a"]] == [int, float, str, bool]
    assert changed(made, {"count": 3, "word": None}, where="") == dataclasses.replace(made, count=3)
