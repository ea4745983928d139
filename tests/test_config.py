"""Strict configuration: unknown keys, wrong types, and targets outside the package are refused by name."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import optax
import pytest
from omegaconf import OmegaConf

from tagjax.core.settings import ConfigError, build, changed, from_mapping
from tagjax.evaluation.run import EvaluateConfig
from tagjax.metrics.recordings import ScoreSettings
from tagjax.recording.opening import VirtualTagSettings
from tagjax.tracing.clips import ClipSettings
from tagjax.training.config import TrainConfig
from tagjax.training.loop import LoopSettings
from tagjax.training.loss import ObjectiveSettings
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
        ({"data": {"recordings": "a.zarr"}}, "expected a list"),
        ({"logger": {"mode": "loud"}}, "expected one of 'disabled', 'offline', 'online'"),
        ({"data": {"clips": {"stride": None}}}, "data.clips.stride: found None"),
        ({"data": 3}, "expected keys and values"),
        ({"data": {"clips": {"stride": 0}}}, r"data\.clips: stride is 0; expected at least 1"),
        ({"data": {"clips": {"stride": -2}}}, r"data\.clips: stride is -2"),
        ({"data": {"clips": {"window": 1}}}, r"data\.clips: window is 1; expected at least 2"),
        ({"data": {"clips": {"max_reads": 0}}}, r"data\.clips: max_reads is 0; expected at least 1"),
        ({"data": {"clips": {"length": 6, "window": 7}}}, r"length is 6; expected at least the window's 7"),
        ({"data": {"virtual_tag": {"seeds": [1]}}}, r"data\.virtual_tag: tracks is null, so there is no virtual tag"),
        ({"data": {"virtual_tag": {"seeds": []}}}, r"data\.virtual_tag: seeds is empty; expected at least one"),
        ({"scores": {"tags_at_once": 0}}, r"scores: tags_at_once is 0; expected at least 1"),
        ({"scores": {"frames_at_once": -1}}, r"scores: frames_at_once is -1; expected at least 1"),
        ({"scores": {"mask_level": 50.0}}, r"scores: mask_level is 50\.0; expected a value from 0 to 1"),
        ({"scores": {"frames": [9, 3]}}, r"scores: frames is \[9, 3\]; expected \[from, to\]"),
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
        from_mapping(EvaluateConfig, {"stride": 0})
    assert from_mapping(DataSettings, {}) == DataSettings()


def test_build_makes_what_the_target_names() -> None:
    assert isinstance(build({"_target_": "optax.adam", "learning_rate": 0.1}), optax.GradientTransformation)
    nested = {"_target_": "optax.sgd", "learning_rate": {"_target_": "optax.constant_schedule", "value": 0.2}}
    assert isinstance(build(nested), optax.GradientTransformation)
    resting = build({"_target_": "tagjax.tracing.clips.ClipSettings", "stride": 2})
    assert resting == ClipSettings(stride=2)


@pytest.mark.parametrize(
    ("target", "message"),
    [
        ("os.system", "starts with tagjax. or optax."),
        ("tagjaxevil.thing", "starts with tagjax. or optax."),
        ("tagjax.recording.dataclasses.asdict", "can be called"),
        ("tagjax.training.logging.os.system", "can be called"),
        ("tagjax.core.settings._resolve", "can be called"),
        ("optax.adamm", "can be called"),
        ("tagjax.nothing.here", "can be called"),
        (None, "found None"),
    ],
)
def test_targets_that_are_refused(target: str | None, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build({"_target_": target})


def test_unknown_settings_of_a_target_are_refused() -> None:
    with pytest.raises(ConfigError, match="alhpa"):
        build({"_target_": "tagjax.tagattention.TagAttention", "alhpa": 1.0})


@pytest.mark.parametrize("tracer", ["tagattention.TagAttention", "tagattention.paper.TagAttentionPaper"])
@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"cell": 0}, r"tracer: cell is 0; expected a whole number of at least 1"),
        ({"cell": 4.5}, r"tracer: "),  # beartype is first here
        ({"beta": 2.0}, r"tracer: beta is 2\.0; expected a share from 0 to 1"),
        ({"alpha_m2": -1.0}, r"tracer: alpha_m2 is -1\.0; expected a positive value"),
        ({"alpha_m2": float("nan")}, r"tracer: alpha_m2 is nan; expected a positive value"),
    ],
)
def test_settings_that_no_tracer_can_have_are_named(tracer: str, settings: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        build({"_target_": f"tagjax.{tracer}", **settings}, where="tracer")


def _written(path: str) -> dict[str, Any]:
    """What a file under conf/ says itself, without what it is composed with."""
    values = OmegaConf.to_container(OmegaConf.load(CONF / path))
    assert isinstance(values, dict)
    return {str(key): value for key, value in values.items() if key not in ("defaults", "hydra")}


@pytest.mark.parametrize(
    ("path", "section", "schema"),
    [
        ("objective/coherent.yaml", None, ObjectiveSettings),
        ("data/default.yaml", None, DataSettings),
        ("data/default.yaml", "clips", ClipSettings),
        ("data/default.yaml", "virtual_tag", VirtualTagSettings),
        ("train.yaml", "scores", ScoreSettings),
        ("scores/default.yaml", None, ScoreSettings),
        ("evaluate.yaml", "virtual_tag", VirtualTagSettings),
    ],
)
def test_defaults_in_code_are_those_of_the_files(path: str, section: str | None, schema: type) -> None:
    """A library user who names no value gets what the command line runs with; every field is in the file."""
    values = _written(path)
    chosen = values if section is None else values[section]
    assert set(chosen) == {field.name for field in dataclasses.fields(schema)}
    assert from_mapping(schema, chosen) == schema()


def test_defaults_of_an_evaluation_are_those_of_the_file() -> None:
    values = _written("evaluate.yaml")
    assert from_mapping(EvaluateConfig, {**values, "clips": {}, "scores": {}}) == EvaluateConfig()
    for name, settings in (("clips", ClipSettings()), ("scores", ScoreSettings())):
        assert changed(settings, values[name], where=name) == settings
    assert set(values["scores"]) == {field.name for field in dataclasses.fields(ScoreSettings)}
    # A training clip's length, motion, tags and workers mean nothing to an evaluation, which has its own epcs.
    assert set(values["clips"]) == {field.name for field in dataclasses.fields(ClipSettings)} - {
        "length",
        "epcs",
        "least_motion",
        "most_tags",
        "workers",
    }
