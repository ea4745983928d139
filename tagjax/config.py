"""Schemas of every configuration of training, evaluation and simulation.

One rule for defaults: YAML under conf/ is the home of every value of a command, and a schema's own defaults, which serve
users of the library, repeat the values of that schema's file under conf/. One test compares the two
(tests/test_config.py), so they cannot drift apart. Values that a command sets for itself (`loop.num_steps` of
conf/train.yaml and of conf/train_flow.yaml) stand in that command's file.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

from .build import build as build
from .data.clips import Antennas, Estimator, check_clip
from .evaluation.evaluate import ScoreSettings
from .flow.losses import FlowLossSettings
from .settings import ConfigError as ConfigError
from .settings import changed as changed
from .settings import from_mapping as from_mapping
from .training.flow_sources import FlowDataSettings
from .training.logging import LoggerSettings
from .training.loop import LoopSettings
from .training.loss import ObjectiveSettings
from .training.processes import DistributedSettings


@dataclasses.dataclass(frozen=True)
class ClipSettings:
    """How recordings become clips."""

    stride: int = 4  # every n-th pixel in both directions
    window: int = 5  # frames in a motion vector (k)
    max_reads: int = 64  # reads of one tag in a window
    flow: str = "dis"
    estimator: Estimator = "robust"  # of the tags' distances
    antennas: Antennas = None  # distances are to these: `all`, numbers from 1, or the one with the most reads if None
    length: int = 24  # frames of a training clip
    epcs: tuple[str, ...] | None = None  # all that were read
    min_motion: float = 0.1  # training clips without a tag whose reads show so much motion are not drawn; 0 draws all
    max_tags: int | None = None  # of a training clip: the tag that moves most, others at random; all if None
    workers: int = 0  # processes that load training clips; with 0 a thread does

    def __post_init__(self) -> None:
        check_clip(stride=self.stride, window=self.window, max_reads=self.max_reads)
        if self.length < self.window:
            raise ConfigError(f"length is {self.length}; expected at least the window's {self.window} frames.")
        if not 0 <= self.min_motion < 1:
            raise ConfigError(f"min_motion is {self.min_motion}; expected a loss of coherence, from 0 to less than 1.")
        if self.max_tags is not None and self.max_tags < 1:
            raise ConfigError(f"max_tags is {self.max_tags}; expected at least 1 tag, or null for all.")

    def arguments(self) -> dict[str, Any]:
        """The arguments that `load_clip` and `clip_dataset` both have, by name."""
        names = ("stride", "flow", "window", "max_reads", "estimator", "antennas")
        return {name: getattr(self, name) for name in names}


@dataclasses.dataclass(frozen=True)
class SimulateSettings:
    """The simulated recordings used where none are named; made once and kept under `folder`."""

    num_recordings: int = 3
    num_frames: int = 90
    width: int = 320
    height: int = 240
    frame_rate_hz: float = 10.0
    num_people: int = 3
    seed: int = 0
    validation_seed: int = 1000
    folder: str = "recordings"


@dataclasses.dataclass(frozen=True)
class VirtualTagSettings:
    """Virtual tags for recordings with known tracks: one tag on each label, each simulated alone at the full read rate."""

    tracks: str | None = None  # CSV: frame,person,x_m,y_m,z_m,range_m,visible
    labels: str | None = None  # folder of label masks NNNNNNNN.png
    seeds: tuple[int, ...] = (0,)
    reader: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields of the reader's settings

    def __post_init__(self) -> None:
        if not self.seeds:
            raise ConfigError("seeds is empty; expected at least one: a reader and its noise are drawn for each.")
        if self.tracks is None and (self.labels, self.seeds, dict(self.reader)) != (None, (0,), {}):
            raise ConfigError(
                "tracks is null, so there is no virtual tag; give tracks (a CSV file), or leave out labels, seeds and reader."
            )


@dataclasses.dataclass(frozen=True)
class DataSettings:
    """Recordings for training and held-out ones. Without any, simulated ones are made."""

    recordings: tuple[str, ...] = ()
    validation: tuple[str, ...] = ()
    clips: ClipSettings = dataclasses.field(default_factory=ClipSettings)
    simulate: SimulateSettings = dataclasses.field(default_factory=SimulateSettings)
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)


@dataclasses.dataclass(frozen=True)
class JointSettings:
    """A flow network that is learned with the tracer."""

    flow: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    init: str | None = "default"  # weights to begin with: `default` or a file; random ones if None
    clip_norm: float = 1.0
    weight: float = 1.0  # of the network's own loss beside the tracer's objective
    loss: FlowLossSettings = dataclasses.field(default_factory=lambda: FlowLossSettings(occlusion_after=0))

    def __post_init__(self) -> None:
        if self.weight < 0:
            raise ConfigError(f"weight is {self.weight}; expected 0 or more.")
        if self.loss.self_supervision > 0:
            raise ConfigError(
                "loss.self_supervision is above 0, which only experiments.train_flow supports; expected 0."
            )


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """All settings of a training run."""

    tracer: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    weights: str | None = None  # learned parameters to begin with: `default`, a name, or a file (tagjax.learned)
    baselines: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)  # evaluated beside it
    baseline_estimators: Mapping[str, str] = dataclasses.field(
        default_factory=dict
    )  # of a baseline, where not the clips'
    seed: int = 0
    clip_norm: float = 1.0
    resume: bool = True  # from the run folder's newest checkpoint, if it holds one
    retune: bool = False  # a resumed run may have another clip_norm and other numbers of its optimiser
    joint: JointSettings | None = None  # without it flow is `data.clips.flow`, computed once
    data: DataSettings = dataclasses.field(default_factory=DataSettings)
    objective: ObjectiveSettings = dataclasses.field(default_factory=ObjectiveSettings)
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)


@dataclasses.dataclass(frozen=True)
class TrainFlowConfig:
    """All settings of a training run of a flow network."""

    flow: Mapping[str, Any]
    optimizer: Mapping[str, Any]
    weights: str | None = None  # to begin with: `default` or a file; random ones if None
    seed: int = 0
    clip_norm: float = 1.0
    average_over: int = 500  # steps that the kept weights are a running average of
    matmul_precision: Literal["bfloat16", "tensorfloat32", "float32"] | None = (
        None  # of products; None is JAX's default
    )
    resume: bool = True
    retune: bool = False
    data: FlowDataSettings = dataclasses.field(default_factory=FlowDataSettings)
    loss: FlowLossSettings = dataclasses.field(default_factory=FlowLossSettings)
    loop: LoopSettings = dataclasses.field(default_factory=LoopSettings)
    logger: LoggerSettings = dataclasses.field(default_factory=LoggerSettings)
    distributed: DistributedSettings = dataclasses.field(default_factory=DistributedSettings)

    def __post_init__(self) -> None:
        if self.average_over < 1:
            raise ConfigError(f"average_over is {self.average_over}; expected at least 1 step.")


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """All settings of an evaluation. What is None is taken from the run, the weights, or the tracer's configuration."""

    run: str | None = None  # a run folder of experiments.train
    checkpoint: int | None = None  # step; the newest if None
    tracer: Mapping[str, Any] | None = None
    weights: str | None = (
        None  # learned parameters: `default`, a name, or a file; they name their tracer if `tracer` is None
    )
    recordings: tuple[str, ...] = ()
    epcs: tuple[str, ...] | None = None
    frames: tuple[int, int] | None = None
    clips: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # in place of the run's, the weights' or the tracer's
    baselines: Mapping[str, Mapping[str, Any]] | None = None
    baseline_estimators: Mapping[str, str] | None = None
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
    scores: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # in place of the run's
    progress: bool = True

    def __post_init__(self) -> None:
        changed(ClipSettings(), self.clips, where="clips")
        changed(ScoreSettings(), self.scores, where="scores")
        for name, other in (("tracer", self.tracer), ("weights", self.weights)):
            if self.run is not None and other is not None:
                raise ConfigError(
                    f"found both run={self.run} and {name}=; expected one of them, because a run has its own tracer and parameters."
                )
        if self.run is None and self.checkpoint is not None:
            raise ConfigError(
                f"found checkpoint={self.checkpoint} without run; expected run=<folder of experiments.train> with it."
            )


@dataclasses.dataclass(frozen=True)
class SimulateConfig:
    """The suite that is simulated (settings of `tagjax.sim.suites.Suite`), and the folder for its recordings."""

    suite: Mapping[str, Any]
    recordings_dir: str = "recordings"
    smoke: bool = False
    workers: int | None = None  # processes; as many as there are cores if None
    progress: bool = True
    sheet: str | None = None  # a folder for a contact sheet; no recordings are then made

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise ConfigError(f"workers is {self.workers}; expected at least 1 process.")
