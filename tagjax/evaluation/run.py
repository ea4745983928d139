"""A whole evaluation: a trained run (or an untrained tracer) on named recordings, with a report."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ..config import ConfigError, EvaluateConfig, TrainConfig, from_mapping
from ..data.store import open_recording
from ..training.checkpoint import Checkpoints
from ..training.run import evaluate_tracers, initial_state, make_tracer, own_flow
from ..training.sources import training_recordings, with_virtual_tags
from ..training.state import TrainState


def restore_state(run: Path, config: TrainConfig, *, step: int | None = None) -> TrainState:
    """The state of a run's checkpoint (the newest if `step` is None), built as the run's own configuration says."""
    fresh, _ = initial_state(config)
    with Checkpoints(run / "checkpoints", create=False) as checkpoints:
        state, _ = checkpoints.restore(fresh, step)
    return state


def run_evaluation(
    config: EvaluateConfig, folder: Path, *, run_values: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Evaluate and return the report's summary, which is also written to `folder`.

    `run_values` is the configuration found in the run folder; what `config` leaves open is taken from it. Without
    recordings the run's own held-out ones are used.
    """
    clips, baselines, recordings = config.clips, dict(config.baselines or {}), []
    estimators = dict(config.baseline_estimators or {})
    flows: dict[str, str] = {}
    if config.run is not None:
        if config.weights is not None:
            raise ConfigError(
                f"run={config.run} has parameters of its own; weights={config.weights} goes with tracer=."
            )
        if run_values is None:
            raise ConfigError(f"run={config.run}: its configuration was not given.")
        trained = from_mapping(TrainConfig, run_values)
        state = restore_state(Path(config.run), trained, step=config.checkpoint)
        tracers = {"learned": state.tracer}
        flows = {"learned": own_flow(state.model, trained, folder / "flow.npz")}
        clips = trained.data.clips
        baselines = dict(trained.baselines) if config.baselines is None else baselines
        estimators = dict(trained.baseline_estimators) | estimators
        if not config.recordings:
            recordings = training_recordings(trained.data)[1]
    elif config.tracer is not None:
        name = "untrained" if config.weights is None else "learned"
        tracers = {name: make_tracer(config.tracer, config.weights)}
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
        flows=flows,
        settings=config.scores,
        epcs=config.epcs,
        frames=config.frames,
        progress=config.progress,
    )
