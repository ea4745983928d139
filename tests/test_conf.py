"""Every configuration under conf/ composes, fits its schema, and names things that exist."""

from __future__ import annotations

import dataclasses
import inspect
import re
from pathlib import Path

import equinox as eqx
import jax
import optax
import pytest
from composed import CONF, composed, settings
from hydra.core.plugins import Plugins
from hydra.errors import ConfigCompositionException, MissingConfigException
from hydra.plugins.sweeper import Sweeper
from omegaconf import OmegaConf

from experiments.suites import suites_named
from tagjax.baselines.goller.experiment import GollerExperiment
from tagjax.baselines.tagview.experiment import TagviewExperiment
from tagjax.baselines.tagview.matching import MatchSettings
from tagjax.core.settings import from_mapping
from tagjax.evaluation.flow import FlowEvaluationSettings
from tagjax.evaluation.run import EvaluateConfig
from tagjax.evaluation.sweep import SweepConfig
from tagjax.flow.network import AbstractFlowNetwork
from tagjax.metrics.recordings import ScoreSettings
from tagjax.tagattention import TagAttention
from tagjax.tagattention.tracer_settings import make_tracer
from tagjax.tracing.tracer import AbstractTracer
from tagjax.training.config import TrainConfig
from tagjax.training.flow_config import TrainFlowConfig
from tagjax.training.flow_run import make_network
from tagjax.training.optimizers import build_optimizer

GROUPS = ("data", "tracer", "optimizer", "objective", "joint", "logger", "scores", "experiment", "debug")
OPTUNA = any("optuna" in plugin.__module__ for plugin in Plugins.instance().discover(Sweeper))  # of the sweep extra


def _options(group: str) -> list[str]:
    return [f"{group}={path.stem}" for path in sorted((CONF / group).glob("*.yaml"))]


ONLY_FOR_EVALUATIONS = "scores=as_trained"  # all its values are null
TRAINING = [option for group in GROUPS for option in _options(group) if option != ONLY_FOR_EVALUATIONS]


@pytest.mark.parametrize("override", TRAINING)
def test_every_training_configuration_is_valid(override: str) -> None:
    needed = ["experiment=clips"] if override == "joint=pyramid" else []  # the flow learns from clips only
    config = settings(TrainConfig, "train", *needed, override)
    assert isinstance(make_tracer(config.tracer), AbstractTracer)
    assert isinstance(build_optimizer(config.optimizer), optax.GradientTransformation)
    for baseline in config.baselines.values():
        assert isinstance(make_tracer(baseline), AbstractTracer)
    assert config.learned.weights()


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["flow=raft_small"],
        ["recipe=none"],
        ["recipe=fine_tune"],
        ["recipe=raft"],
        ["recipe=student"],
        ["recipe=flownet"],
        ["recipe=flownet", "flow=flownet_c"],
        ["recipe=[flownet,fine_tune]"],
        ["flow_loss@loss=unflow"],
    ],
)
def test_every_flow_training_configuration_is_valid(overrides: list[str]) -> None:
    config = settings(TrainFlowConfig, "train_flow", *overrides)
    made = jax.eval_shape(lambda: eqx.filter(make_network(config.flow), eqx.is_array))
    assert isinstance(made, AbstractFlowNetwork)
    for size in (config.data.variation.height, config.data.variation.width, config.data.variation.margin_px):
        assert size % made.divisor == 0
    assert isinstance(build_optimizer(config.optimizer), optax.GradientTransformation)


def test_every_recipe_is_tested() -> None:
    names = {"fine_tune", "flownet", "none", "raft", "student"}
    assert set(_options("recipe")) == {f"recipe={name}" for name in names}


def test_evaluation_configurations_are_valid() -> None:
    assert settings(EvaluateConfig, "evaluate").tracer is None
    chosen = settings(EvaluateConfig, "evaluate", "tracer=tagattention_literal", "frames=[0,20]", "scores.lock_s=0.5")
    assert chosen.tracer is not None
    assert isinstance(make_tracer(chosen.tracer), AbstractTracer)
    assert chosen.frames == (0, 20)
    assert chosen.scores["lock_s"] == 0.5


def test_a_sweep_sees_the_clips_of_its_tracer() -> None:
    suites = {"suites": suites_named(["velocity_threshold"])}
    estimators = {"tagattention_published": "published", "tagattention": "robust"}
    for tracer, parameter in (("tagattention_published", "v0_m_s"), ("tagattention", "dwell.memory_s")):
        values = {**composed("sweep_paper", f"tracer={tracer}"), "grid": {parameter: [0.1]}}
        values.pop("progress")
        clips = from_mapping(SweepConfig, {**values, **suites}).clip_settings()
        assert (clips.stride, clips.estimator) == (None, estimators[tracer])


def test_flow_evaluation_configurations_are_valid() -> None:
    assert settings(FlowEvaluationSettings, "evaluate_flow").flows


@pytest.mark.parametrize(("name", "schema"), [("goller", GollerExperiment), ("tagview", TagviewExperiment)])
def test_configurations_of_the_earlier_systems_are_valid(name: str, schema: type) -> None:
    assert settings(schema, name)
    fields = {field.name for field in dataclasses.fields(schema)}
    assert set(composed(name)) - fields <= {"command", "progress"}


def test_the_comparison_takes_each_system_as_its_own_experiments_do() -> None:
    systems = composed("compare")["systems"]
    vision, view = composed("tagvision"), composed("tagview")
    assert systems["tagvision"] == vision["system"]
    assert systems["tagvision_calibration"] == vision["calibration"]
    assert systems["tagview"] == view["system"]
    assert systems["goller"] == composed("goller")["settings"]
    # The online detections use one of the settings that are compared on the same tracks.
    assert vision["matching"]["adapted"] == vision["system"]["match"]
    assert view["matching"][view["main"]] == {name: view["system"][name] for name in ("reads", "match")}
    complete = from_mapping(MatchSettings, view["system"]["match"])
    for name, change in (("no_rssi", {"mu": 0.0}), ("camera_origin", {"origin": "principal"})):
        assert from_mapping(MatchSettings, view["matching"][name]["match"]) == dataclasses.replace(complete, **change)
    assert systems["tagattention"] == composed("train")["tracer"]


def test_frames_are_scored_alike_everywhere() -> None:
    scores = [composed(name)["scores"] for name in ("train", "compare")]
    assert scores[0] == scores[1] == composed("evaluate", "scores=default")["scores"]
    assert from_mapping(ScoreSettings, scores[0]) == ScoreSettings()


def test_an_evaluation_takes_a_tracer_to_compare_with() -> None:
    beside = composed("evaluate", "tracer=tagattention", "tracer@baselines.published=tagattention_published")
    assert beside["baselines"]["published"] == composed("train")["baselines"]["published"]
    assert composed("evaluate")["baselines"] is None  # those of the run
    assert composed("evaluate", "baselines={}")["baselines"] == {}


@pytest.mark.parametrize(
    ("command", "override", "known"),
    [
        ("simulate", "suite=planar_trcks", "planar_tracks"),
        ("tagvision", "suite=planar_trcks", "planar_tracks"),
        ("evaluate", "suite=multi_5", "multi_4"),
        ("evaluate", "tracer=tagvision", "tagattention_published"),
        ("evaluate", "tracer@baselines.published=magic", "tagattention_published"),
        ("evaluate", "scores=as_traind", "as_trained"),
        ("train", "suite=multi_5", "multi_4"),
        ("train", "experiment=contrast", "contrast_only"),
        ("train", "joint=pyramids", "pyramid"),
        ("train", "debug=on", "default"),
        ("train", "hparams_search=optun", "optuna"),
        ("train_flow", "recipe=rafft", "raft"),
    ],
)
def test_a_misspelt_choice_is_refused_with_the_known_ones(command: str, override: str, known: str) -> None:
    with pytest.raises(MissingConfigException, match=rf"(?s)Available options.*{known}"):
        composed(command, override)


def test_a_misspelt_key_is_refused() -> None:
    with pytest.raises(ConfigCompositionException):
        composed("train", "loop.num_step=3")


def test_no_group_is_optional() -> None:
    """Hydra ignores a misspelt choice of an optional group."""
    assert not [path for path in CONF.rglob("*.yaml") if re.search(r"^\s*- optional", path.read_text(), re.MULTILINE)]


def test_recordings_lie_in_one_place() -> None:
    """`paths.recordings_dir` moves all of them: no other file names the folder."""
    for path in CONF.rglob("*.yaml"):
        if path != CONF / "paths" / "default.yaml":
            assert not re.search(r"^[^#\n]*: *(recordings|outputs)(/|\s|$)", path.read_text(), re.MULTILINE), path
    assert composed("simulate", "paths.recordings_dir=elsewhere")["recordings_dir"] == "elsewhere"
    assert composed("train", "paths.recordings_dir=elsewhere")["recordings_dir"] == "elsewhere"
    assert composed("goller", "paths.recordings_dir=elsewhere")["scenarios"] == "elsewhere/shop_exit"


def test_the_tracer_file_names_every_setting() -> None:
    given = set(composed("train")["tracer"]) - {"_target_", "clips"}
    assert given == set(inspect.signature(TagAttention).parameters)


def test_every_file_of_a_group_is_a_choice_of_some_command() -> None:
    folders = {path.parent.relative_to(CONF).as_posix() for path in CONF.rglob("*.yaml")} - {"."}
    text = "".join(path.read_text() for path in CONF.rglob("*.yaml"))
    for folder in folders - {"paths", "hydra"}:
        assert re.search(rf"^  - (override )?/?{folder}(@[\w.]+)?: ", text, re.MULTILINE), folder
    assert all("hydra: default" in Path(path).read_text() for path in CONF.glob("*.yaml"))


def test_suites_have_the_names_of_their_files() -> None:
    for path in (CONF / "suite").glob("*.yaml"):
        assert OmegaConf.load(path).name == path.stem
