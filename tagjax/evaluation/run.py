"""A whole evaluation: a trained run (or an untrained tracer) on named recordings, with a report."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..config import ConfigError, EvaluateConfig, TrainConfig, build, from_mapping
from ..data.store import open_recording
from ..tracer import AbstractTracer
from ..training.checkpoint import Checkpoints
from ..training.run import evaluate_tracers, make_tracer
from ..training.sources import training_recordings, with_virtual_tags
from ..training.state import TrainState
from ..training.step import make_optimizer


def restore_tracer(run: Path, config: TrainConfig, *, step: int | None = None) -> AbstractTracer:
    """The tracer of a run's checkpoint (the newest if `step` is None), built as the run's own configuration says."""
    optimizer = make_optimizer(build(config.optimizer, where="optimizer"), config.clip_norm)
    fresh = TrainState.create(make_tracer(config.tracer), optimizer, seed=config.seed)
    with Checkpoints(run / "checkpoints", create=False) as checkpoints:
        state, _ = checkpoints.restore(fresh, step)
    return state.tracer


def run_evaluation(
    config: EvaluateConfig, folder: Path, *, run_values: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Evaluate and return the report's summary, which is also written to `folder`.

    `run_values` is the configuration found in the run folder; what `config` leaves open is taken from it. Without
    recordings the run's own held-out ones are used.
    """
    clips, baselines, recordings = config.clips, dict(config.baselines or {}), []
    estimators = dict(config.baseline_estimators or {})
    if config.run is not None:
        if run_values is None:
            raise ConfigError(f"run={config.run}: its configuration was not given.")
        trained = from_mapping(TrainConfig, run_values)
        tracers = {"learned": restore_tracer(Path(config.run), trained, step=config.checkpoint)}
        clips = trained.data.clips
        baselines = dict(trained.baselines) if config.baselines is None else baselines
        estimators = dict(trained.baseline_estimators) | estimators
        if not config.recordings:
            recordings = training_recordings(trained.data)[1]
    elif config.tracer is not None:
        tracers = {"untrained": make_tracer(config.tracer)}
    else:
        raise ConfigError("Nothing to evaluate: give run=<folder of experiments.train>, or tracer=<name> untrained.")
    if config.stride is not None:
        clips = dataclasses.replace(clips, stride=config.stride)
    recordings += [with_virtual_tags(open_recording(path), config.virtual_tag) for path in config.recordings]
    if not recordings:
        raise ConfigError("No recording to evaluate on: give recordings=[a.zarr,...]; the run held none out.")
    tracers |= {name: make_tracer(settings) for name, settings in baselines.items()}
    return evaluate_tracers(
        tracers,
        recordings,
        folder,
        clips=clips,
        estimators=estimators,
        settings=config.scores,
        epcs=config.epcs,
        frames=config.frames,
        progress=config.progress,
    )
