"""A whole evaluation: a training run, learned weights or an untrained tracer on recordings, with a report."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from ..core.progress import progress_lines
from ..core.settings import ConfigError, changed, from_mapping
from ..flow.nominal_depth import NominalDepth, without_depth
from ..metrics.recordings import ScoreSettings
from ..recording import Recording
from ..recording.controls import Control, with_control
from ..recording.loading import VirtualTagSettings, open_recordings
from ..report.page import write_page
from ..tagattention.tracer_settings import baseline_clips, learned_tracer, make_tracer, tracer_clips
from ..tracing.clips import ClipSettings
from ..training.checkpoint import Checkpoints
from ..training.config import TrainConfig, check_baselines
from ..training.evaluate import evaluate_tracers
from ..training.run import evaluation_flow, initial_state
from ..training.sources import DataSettings, training_recordings
from ..training.state import TrainState


def restore_state(run: Path, config: TrainConfig, *, step: int | None = None) -> TrainState:
    """The state of a run's checkpoint (the newest if `step` is None), built from the run's own configuration."""
    # The initial weights are overwritten by the checkpoint, and their files may no longer exist.
    joint = None if config.joint is None else dataclasses.replace(config.joint, init=None)
    fresh, _ = initial_state(dataclasses.replace(config, weights=None, joint=joint))
    with Checkpoints(run / "checkpoints", create=False) as checkpoints:
        state, _ = checkpoints.restore(fresh, step)
    return state


def validation_recordings(data: DataSettings) -> list[Recording]:
    """The validation recordings of a run; its training recordings are not opened."""
    if not data.recordings:
        return training_recordings(data)[1]
    return open_recordings(data.validation, data.virtual_tag)


def run_evaluation(
    config: EvaluateConfig, folder: Path, *, run_values: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Evaluate and return the report's summary, which is also written to `folder`.

    `run_values` is the configuration in the run folder. Settings that are None in `config` are taken from it, or else from
    the file of learned parameters or the tracer's configuration. Without recordings those of the run's validation are used.
    Raises `ConfigError` where there is no tracer or no recording.
    """
    clips, scores, baselines, recordings = ClipSettings(), ScoreSettings(), dict(config.baselines or {}), []
    flows: dict[str, str] = {}
    if config.run is not None:
        if run_values is None:
            raise ConfigError(f"run={config.run}: its configuration was not given.")
        trained = from_mapping(TrainConfig, run_values)
        state = restore_state(Path(config.run), trained, step=config.checkpoint)
        tracers = {"learned": state.tracer}
        flows = {"learned": evaluation_flow(state.model, trained, folder / "flow.safetensors")}
        clips, scores = trained.data.clips, trained.scores
        baselines = dict(trained.baselines) if config.baselines is None else baselines
        if not config.recordings:
            recordings = validation_recordings(trained.data)
    elif config.weights is not None:
        tracer, clips = learned_tracer(config.weights, config.tracer)
        tracers = {"learned": tracer}
    elif config.tracer is not None:
        tracers, clips = {"untrained": make_tracer(config.tracer)}, tracer_clips(config.tracer)
    else:
        raise ConfigError(
            "Nothing to evaluate: expected run=<folder of experiments.train>, weights=<default, a name or a file>, or "
            "tracer=<name> for an untrained tracer."
        )
    clips = changed(clips, config.clips, where="clips")
    epcs = clips.epcs if config.epcs is None else config.epcs
    recordings = with_control(recordings + open_recordings(config.recordings, config.virtual_tag), config.control)
    if config.depth == "none":
        recordings = [without_depth(one, config.nominal_depth) for one in recordings]
    if not recordings:
        raise ConfigError(
            "No recording to evaluate on: expected recordings=[a.zarr,...] or suite=<name>, or a run with validation recordings."
        )
    tracers |= {name: make_tracer(settings) for name, settings in baselines.items()}
    summary = evaluate_tracers(
        tracers,
        recordings,
        folder,
        clips=clips,
        own_clips=baseline_clips(baselines) | {name: {"flow": flow} for name, flow in flows.items()},
        settings=changed(scores, config.scores, where="scores"),
        epcs=epcs,
        frames=config.frames,
        progress=config.progress,
    )
    with progress_lines(shown=config.progress) as report:
        write_page(folder, on_progress=report)
    return summary


@dataclasses.dataclass(frozen=True)
class EvaluateConfig:
    """All settings of an evaluation. A value of None is taken from the run, the weights, or the tracer's configuration."""

    run: str | None = None  # a run folder of experiments.train
    checkpoint: int | None = None  # step; the newest if None
    tracer: Mapping[str, Any] | None = None
    weights: str | None = None  # learned parameters: `default`, a name, or a file, with its tracer if `tracer` is None
    recordings: tuple[str, ...] = ()
    epcs: tuple[str, ...] | None = None
    frames: tuple[int, int] | None = None
    clips: Mapping[str, Any] = dataclasses.field(
        default_factory=dict
    )  # override those of the run, the weights or the tracer
    baselines: Mapping[str, Mapping[str, Any]] | None = None
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
    control: Control | None = None  # reads that do not belong to what is seen: every detection is a false one
    depth: Literal["none"] | None = None  # none: two planes in place of the depth, as of a recording without any
    nominal_depth: NominalDepth = dataclasses.field(default_factory=NominalDepth)
    scores: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # override those of the run
    progress: bool = True

    def __post_init__(self) -> None:
        check_baselines(self.baselines or ())
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
