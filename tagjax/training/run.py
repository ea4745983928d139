"""A whole training run in a folder: recordings in, checkpoints, logs, and a report on the held-out recordings out."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
import optax
from rich.console import Console
from rich.progress import track

from ..core.build import build
from ..core.results import to_json_values, write_json
from ..core.settings import ConfigError
from ..metrics.recordings import RecordingResult, ScoreSettings, evaluate_recording
from ..recording import Recording
from ..report.report import score_table, write_report
from ..tagattention import TagAttention
from ..tagattention.learned import save_parameters
from ..tagattention.tracer_settings import make_tracer
from ..tracing.clips import Antennas, Clip, ClipSettings, clip_loader
from ..tracing.tracer import AbstractTracer
from .checkpoint import Checkpoints
from .clip_dataset import clip_dataset
from .config import TrainConfig
from .flow_run import initial_network
from .joint import JointModel, save_network
from .logging import Logger
from .loop import Trained, resumed, train
from .processes import is_first, joined, share_of
from .sources import training_recordings
from .state import TrainState
from .step import clip_loss, make_joint_optimizer, make_optimizer, train_step

VALIDATION_CLIPS = 2


def make_model(config: TrainConfig) -> AbstractTracer | JointModel:
    """What a run trains, before its first step: the tracer, with a flow network if `config.joint` asks for one."""
    tracer = make_tracer(config.tracer, config.weights)
    if config.joint is None:
        return tracer
    network = initial_network(config.joint.flow, config.joint.init)
    return JointModel(tracer, network, config.joint.weight, config.joint.loss)


def initial_state(config: TrainConfig) -> tuple[TrainState, optax.GradientTransformation]:
    """The state before the first step, and the optimiser."""
    optimizer = make_optimizer(build(config.optimizer, where="optimizer"), config.clip_norm)
    if config.joint is not None:
        of_network = make_optimizer(build(config.joint.optimizer, where="joint.optimizer"), config.joint.clip_norm)
        optimizer = make_joint_optimizer(optimizer, of_network)
    return TrainState.create(make_model(config), optimizer, seed=config.seed), optimizer


def own_flow(model: AbstractTracer | JointModel, config: TrainConfig, path: Path) -> str:
    """The name of the flow that a run's model is evaluated with; a network's weights are written to `path` for it."""
    if isinstance(model, JointModel) and config.joint is not None:
        save_network(path, model, config.joint.flow)
        return str(path)
    return config.data.clips.flow


def run_training(config: TrainConfig, folder: Path, *, console: Console | None = None) -> float:
    """Train as configured, evaluate on the held-out recordings, and return the number a sweep should maximise.

    That number is the mean box IoU on the held-out recordings if they are labelled, else the coherence of the held-out
    tags' reads with their masks' motion; NaN without any. `folder` then holds checkpoints, metrics.jsonl, what was
    learned (weights.json, parameters.json, flow.safetensors), and where anything was held out metrics.json and report/. An
    interrupted run leaves a checkpoint, goes on from it when started again in the same folder, and returns NaN. Of
    several processes (`config.distributed`) the first writes and evaluates; the others return NaN.
    """
    console = console or Console()
    with joined(config.distributed):  # before anything asks JAX for its devices
        smoothed({"learned": make_tracer(config.tracer)}, config.scores)
        console.quiet = console.quiet or not is_first()
        training, validation = training_recordings(config.data)
        _describe(console, training, validation)
        trained, logger = _train(config, folder, training, validation, console)
        first = is_first()
    try:
        if not first:
            return float("nan")
        if trained.interrupted:
            console.print(
                f"Stopped at step {int(trained.state.step)}; go on with the same command and hydra.run.dir={folder}"
            )
            return float("nan")
        tracers, flows = _keep_learned(config, folder, trained.state)
        if not validation:
            console.print("No held-out recording: nothing to evaluate (data.validation is empty).")
            return float("nan")
        summary = _report(config, folder, tracers, flows, validation)
        first_name, found = next(iter(summary.items()))  # the learned tracer's, smoothed or not
        logger.report(folder / "report", found["all"], tracer=first_name)
    finally:
        logger.close()
    console.print(score_table(summary, title="held-out recordings"))
    iou = found["all"].get("iou")
    if iou is not None:
        return float(iou)
    return held_out_numbers(trained.state, held_out_clips(config, validation), config).get(
        "own_coherence", float("nan")
    )


def _train(
    config: TrainConfig,
    folder: Path,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    console: Console,
) -> tuple[Trained[TrainState], Logger]:
    """The trained state, and the logger, which is left open for the report."""
    clips, batch_size = config.data.clips, config.loop.batch_size
    state, optimizer = initial_state(config)
    source = iter(
        clip_dataset(
            training,
            clip_length=clips.length,
            seed=config.seed,
            epcs=clips.epcs,
            min_motion=clips.min_motion,
            max_tags=clips.max_tags,
            workers=clips.workers,
            share=(jax.process_index(), jax.process_count()),
            colour=config.joint is not None,
            **clips.arguments(),
        )
    )
    idle = jax.local_device_count() - share_of(batch_size)
    if idle > 0:
        console.print(
            f"loop.batch_size={batch_size} leaves {idle} of {jax.local_device_count()} devices without a clip."
        )
    # Every process looks at all of them: none has to wait for another that does.
    held_out = held_out_clips(config, validation)
    with Checkpoints(folder / "checkpoints") as checkpoints:
        state = resumed(state, source, checkpoints, allowed=config.resume)
        if int(state.step):
            console.print(f"Resumed at step {int(state.step)} of {config.loop.num_steps}.")
        logger = Logger(folder, config.logger, config=dataclasses.asdict(config), resume_step=int(state.step))

        def validate(state: TrainState) -> dict[str, float]:
            return held_out_numbers(state, held_out, config)

        try:
            trained = train(
                state,
                source,
                update=lambda state, clips: train_step(state, clips, optimizer, config.objective),
                settings=config.loop,
                logger=logger,
                checkpoints=checkpoints,
                validate=validate if held_out else None,
            )
        except BaseException:
            logger.close()
            raise
        finally:
            source.close()
    return trained, logger


def _keep_learned(
    config: TrainConfig, folder: Path, state: TrainState
) -> tuple[dict[str, AbstractTracer], dict[str, str]]:
    """Write what was learned; the learned tracer, that before the first step and the baselines; flows of their own.

    Where a flow network was learned with it, each of the two sees with its own, kept as flow.safetensors and
    flow_untrained.safetensors (flow_initial.safetensors, where it began from learned parameters).
    The learned parameters are kept as weights.json, and all tracers' as parameters.json.
    """
    before = "untrained" if config.weights is None else "initial"
    models = {"learned": state.model, before: make_model(config)}
    files = {"learned": folder / "flow.safetensors", before: folder / f"flow_{before}.safetensors"}
    flows = {name: own_flow(model, config, files[name]) for name, model in models.items()}
    tracers = {name: model.tracer if isinstance(model, JointModel) else model for name, model in models.items()}
    tracers |= {name: make_tracer(settings) for name, settings in config.baselines.items()}
    if isinstance(tracers["learned"], TagAttention):
        recipe = dataclasses.asdict(config) | {"steps": int(state.step)}
        clips = dataclasses.asdict(config.data.clips) | {"flow": flows["learned"]}
        about = to_json_values({"recipe": recipe})
        save_parameters(folder / "weights.json", tracers["learned"], config.tracer, to_json_values(clips), about)
    write_json(folder / "parameters.json", {name: parameters(tracer) for name, tracer in tracers.items()})
    return tracers, flows


def _report(
    config: TrainConfig,
    folder: Path,
    tracers: Mapping[str, AbstractTracer],
    flows: Mapping[str, str],
    validation: Sequence[Recording],
) -> dict[str, Any]:
    """Evaluate the tracers on what was held out; the report's summary."""
    summary = evaluate_tracers(
        tracers,
        validation,
        folder / "report",
        clips=config.data.clips,
        estimators=config.baseline_estimators,
        flows=flows,
        settings=config.scores,
        epcs=config.data.clips.epcs,
        progress=config.loop.progress,
    )
    write_json(folder / "metrics.json", summary)
    return summary


def parameters(tracer: AbstractTracer) -> dict[str, float]:
    """The tracer's scalar parameters by name, in physical units where it can tell them (`physical`)."""
    physical = getattr(tracer, "physical", None)
    if physical is not None:
        return dict(physical())
    return {name: float(leaf) for name, leaf in vars(tracer).items() if isinstance(leaf, jax.Array) and leaf.ndim == 0}


def held_out_numbers(state: TrainState, clips: Sequence[Clip], config: TrainConfig) -> dict[str, float]:
    """Mean of every term and diagnostic over held-out clips, always with the same random shifts."""
    key = jax.random.PRNGKey(config.seed)
    ones = [clip_loss(state.model, clip.camera, clip.frames, key, config.objective) for clip in clips]
    return {name: float(np.mean([float(one[name]) for one in ones])) for name in ones[0]}


def held_out_clips(config: TrainConfig, recordings: Sequence[Recording]) -> list[Clip]:
    """A few clips spread over each recording, of the training clips' length (or shorter, if the recording is)."""
    settings = config.data.clips
    load = clip_loader(settings, colour=config.joint is not None)
    clips = []
    for recording in recordings:
        length = min(settings.length, recording.num_frames)
        starts = np.linspace(0, recording.num_frames - length, VALIDATION_CLIPS).astype(int)
        clips += [load(recording, int(start), int(start) + length) for start in sorted(set(starts.tolist()))]
    return clips


def smoothed(tracers: Mapping[str, AbstractTracer], settings: ScoreSettings) -> set[str]:
    """Names of the tracers that go backwards first: with `settings.smooth` all that can. Raises `ConfigError` if none can."""
    names = {name for name, tracer in tracers.items() if settings.supported_by(tracer).smooth}
    if settings.smooth and not names:
        kinds = ", ".join(type(tracer).__name__ for tracer in tracers.values())
        raise ConfigError(f"scores.smooth: {kinds} goes forwards only; expected TagAttention. Set scores.smooth=false.")
    return names


def antennas_for(tracer: AbstractTracer, antennas: Antennas) -> Antennas:
    """The antennas that a tracer is given: the busiest one (None) where it knows one only and several are asked for."""
    several = antennas == "all" or (antennas is not None and len(antennas) > 1)
    return None if tracer.one_antenna and several else antennas


def evaluate_tracers(
    tracers: Mapping[str, AbstractTracer],
    recordings: Sequence[Recording],
    folder: Path,
    *,
    clips: ClipSettings,
    estimators: Mapping[str, str] | None = None,
    flows: Mapping[str, str] | None = None,
    settings: ScoreSettings,
    epcs: Sequence[str] | None = None,
    frames: tuple[int, int] | None = None,
    progress: bool = True,
) -> dict[str, Any]:
    """Run each tracer over each recording, write the report into `folder` and return its summary.

    `estimators` and `flows` name the radio estimator and the flow of tracers that do not take the clips' own; a tracer that
    knows one antenna gets the busiest one where the clips take several. With
    `settings.smooth` those that can smooth do, which their names tell; the others go forwards only. Raises `ConfigError`
    where none can.
    """
    estimators, flows = estimators or {}, flows or {}
    loaders = {
        name: clip_loader(
            dataclasses.replace(
                clips,
                estimator=estimators.get(name, clips.estimator),
                flow=flows.get(name, clips.flow),
                antennas=antennas_for(tracer, clips.antennas),
            )
        )
        for name, tracer in tracers.items()
    }
    smooth = smoothed(tracers, settings)
    shown = {name: f"{name}_smoothed" if name in smooth else name for name in tracers}
    work = [(name, number) for name in tracers for number in range(len(recordings))]
    results: dict[str, list[RecordingResult]] = {shown[name]: [] for name in tracers}
    for name, number in track(work, description="evaluate", disable=not progress):
        results[shown[name]].append(
            evaluate_recording(
                tracers[name],
                recordings[number],
                loaders[name],
                stride=clips.stride,
                epcs=epcs,
                settings=settings.supported_by(tracers[name]),
                frames=frames,
            )
        )
    return write_report(folder, results)


def _describe(console: Console, training: Sequence[Recording], validation: Sequence[Recording]) -> None:
    for kind, recordings in (("train", training), ("held out", validation)):
        for recording in recordings:
            tags = len(recording.reads.epcs)
            console.print(
                f"{kind}: {recording.name}, {recording.num_frames} frames at {recording.frame_rate_hz:.1f}/s, "
                f"{recording.reads.num_reads} reads of {tags} tags"
            )
