"""Every configuration under conf/ composes, fits its schema, and names things that exist."""

from __future__ import annotations

import dataclasses
import inspect
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import optax
import pytest
from hydra import compose, initialize_config_dir
from hydra.errors import ConfigCompositionException
from omegaconf import OmegaConf

from experiments.compare import suites_named
from tagjax.baselines.goller.experiment import GollerExperiment
from tagjax.baselines.tagview.experiment import TagviewExperiment
from tagjax.baselines.tagview.matching import MatchSettings
from tagjax.config import ConfigError, EvaluateConfig, TrainConfig, TrainFlowConfig, build, from_mapping
from tagjax.evaluation.compare import SystemSettings
from tagjax.evaluation.evaluate import ScoreSettings
from tagjax.evaluation.flow import FlowEvaluationSettings
from tagjax.flow.network import AbstractFlowNetwork
from tagjax.sim.suites import PLANAR, Suite
from tagjax.tagattention import TagAttention
from tagjax.tracer import AbstractTracer

CONF = Path(__file__).parents[1] / "conf"


def _compose(name: str, *overrides: str) -> Any:
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        return OmegaConf.to_container(compose(name, list(overrides)), resolve=True)


GROUPS = ("data", "tracer", "optimizer", "objective", "joint", "logger", "experiment", "debug")


def _options(group: str) -> list[str]:
    return [f"{group}={path.stem}" for path in sorted((CONF / group).glob("*.yaml"))]


@pytest.mark.parametrize(
    "override",
    [option for group in GROUPS for option in _options(group)],
)
def test_every_training_configuration_is_valid(override: str) -> None:
    config = from_mapping(TrainConfig, _compose("train", override))
    assert isinstance(build(config.tracer), AbstractTracer)
    assert isinstance(build(config.optimizer), optax.GradientTransformation)
    for settings in config.baselines.values():
        assert isinstance(build(settings), AbstractTracer)
    assert config.objective.weights()


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["flow=raft_small"],
        ["recipe=fine_tune"],
        ["recipe=raft"],
        ["recipe=student"],
        ["recipe=flownet"],
        ["recipe=flownet", "flow=flownet_c"],
    ],
)
def test_every_flow_training_configuration_is_valid(overrides: list[str]) -> None:
    config = from_mapping(TrainFlowConfig, _compose("train_flow", *overrides))
    made = jax.eval_shape(lambda: eqx.filter(build(config.flow), eqx.is_array))
    assert isinstance(made, AbstractFlowNetwork)
    for size in (config.data.variation.height, config.data.variation.width, config.data.variation.margin_px):
        assert size % made.divisor == 0
    assert isinstance(build(config.optimizer), optax.GradientTransformation)


def test_every_recipe_is_tested() -> None:
    assert set(_options("recipe")) == {"recipe=fine_tune", "recipe=flownet", "recipe=raft", "recipe=student"}


def test_evaluation_configurations_are_valid() -> None:
    assert from_mapping(EvaluateConfig, _compose("evaluate")).tracer is None
    named = from_mapping(EvaluateConfig, _compose("evaluate", "tracer=tagattention_paper", "frames=[0,20]"))
    assert named.tracer is not None
    assert isinstance(build(named.tracer), AbstractTracer)
    assert named.frames == (0, 20)


def test_flow_evaluation_configurations_are_valid() -> None:
    settings = from_mapping(FlowEvaluationSettings, _compose("evaluate_flow"))
    assert settings.flows


@pytest.mark.parametrize(("name", "schema"), [("goller", GollerExperiment), ("tagview", TagviewExperiment)])
def test_forerunners_configurations_are_valid(name: str, schema: type) -> None:
    values = _compose(name)
    fields = {field.name for field in dataclasses.fields(schema)}
    assert from_mapping(schema, {key: value for key, value in values.items() if key in fields})
    assert set(values) - fields <= {"command", "progress", "training"}


def test_the_comparison_takes_each_system_as_its_own_experiments_do() -> None:
    systems = _compose("compare")["systems"]
    vision, view = _compose("tagvision"), _compose("tagview")
    assert systems["tagvision"] == vision["system"]
    assert systems["tagvision_calibration"] == vision["calibration"]
    assert systems["tagview"] == view["system"]
    assert systems["goller"] == _compose("goller")["settings"]
    # The online detections use one of the settings that are compared on the same tracks.
    assert vision["matching"]["adapted"] == vision["system"]["match"]
    assert view["matching"][view["main"]] == {name: view["system"][name] for name in ("reads", "match")}
    whole = from_mapping(MatchSettings, view["system"]["match"])
    for name, change in (("no_rssi", {"mu": 0.0}), ("camera_origin", {"origin": "principal"})):
        assert from_mapping(MatchSettings, view["matching"][name]["match"]) == dataclasses.replace(whole, **change)
    for name, tracer in (("people", "tagattention"), ("handheld", "tagattention_handheld")):
        assert systems["tagattention"][name]["tracer"] == _compose("train", f"tracer={tracer}")["tracer"]


def test_frames_are_scored_alike_everywhere() -> None:
    scores = [_compose(name)["scores"] for name in ("train", "compare")]
    assert scores[0] == scores[1]
    assert from_mapping(ScoreSettings, scores[0]) == ScoreSettings()


def test_every_story_has_tracer_settings_in_the_comparison() -> None:
    systems = from_mapping(SystemSettings, _compose("compare")["systems"])
    for path in (CONF / "benchmark").glob("*.yaml"):
        suite = from_mapping(Suite, suites_named(path.stem)[path.stem])
        stories = {variant.story or suite.story for variant in suite.variants} - {PLANAR}
        assert stories <= set(systems.settings_of), path.stem
    with pytest.raises(ConfigError, match="settings_of names magic"):
        dataclasses.replace(systems, settings_of={"crowd": "magic"})


def test_a_misspelt_override_is_refused() -> None:
    with pytest.raises(ConfigCompositionException):
        _compose("train", "loop.num_step=3")


def test_the_tracer_file_names_every_setting() -> None:
    given = set(_compose("train")["tracer"]) - {"_target_"}
    assert given == set(inspect.signature(TagAttention).parameters)
