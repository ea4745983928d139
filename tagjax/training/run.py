"""A whole training run in a folder: its inputs are recordings, its outputs checkpoints, logs, and a report on validation."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import optax
from rich.console import Console

from ..core.folder_lock import locked_folder
from ..core.interruption import interruption
from ..core.progress import progress_lines
from ..core.results import to_json_values, write_json
from ..recording import Recording
from ..report.page import PAGE, write_page
from ..report.report import score_table
from ..tagattention import TagAttention
from ..tagattention.learned import LearnableTracer, read_learned, save_parameters
from ..tagattention.tracer_settings import baseline_clips, make_tracer
from ..tracing.tracer import AbstractTracer
from .checkpoint import Checkpoints
from .config import TrainConfig
from .data import TrainingData, training_data
from .evaluate import evaluate_tracers, parameters, smoothing_tracers
from .flow_run import initial_network
from .hindsight import HindsightSettings
from .joint import JointModel, save_network
from .logging import Logger
from .loop import TrainingResult, resume_state, train
from .optimizers import build_optimizer
from .processes import distributed_runtime, is_first, local_batch_size
from .sources import training_recordings
from .state import TrainState
from .step import ClipLike, clip_loss, make_joint_optimizer, make_optimizer, mean_logs, train_step


def make_model(config: TrainConfig) -> AbstractTracer | JointModel:
    """The untrained model of a run: the tracer, with a flow network if `config.joint` is set."""
    tracer = make_tracer(config.tracer, config.weights)
    if isinstance(config.learned, HindsightSettings) and isinstance(tracer, TagAttention):
        config.learned.learning(tracer)  # a wrong name is refused before the work starts
    if config.joint is None:
        return tracer
    network = initial_network(config.joint.flow, config.joint.init)
    return JointModel(tracer, network, config.joint.weight, config.joint.loss)


def initial_state(config: TrainConfig) -> tuple[TrainState, optax.GradientTransformation]:
    """The state before the first step, and the optimiser."""
    optimizer = make_optimizer(build_optimizer(config.optimizer), config.clip_norm)
    if config.joint is not None:
        network_optimizer = make_optimizer(
            build_optimizer(config.joint.optimizer, where="joint.optimizer"), config.joint.clip_norm
        )
        optimizer = make_joint_optimizer(optimizer, network_optimizer)
    return TrainState.create(make_model(config), optimizer, seed=config.seed), optimizer


def evaluation_flow(model: AbstractTracer | JointModel, config: TrainConfig, path: Path) -> str:
    """The name of the flow that a run's model is evaluated with: of a joint model its own network, written to `path`."""
    if isinstance(model, JointModel) and config.joint is not None:
        save_network(path, model, config.joint.flow)
        return str(path)
    return config.data.clips.flow


def run_training(
    config: TrainConfig,
    folder: Path,
    *,
    console: Console | None = None,
    on_start: Callable[[], None] | None = None,
) -> float:
    """Train as configured, evaluate on the validation recordings, and return the objective of a sweep, to be maximised.

    The objective is the mean box IoU on the validation recordings if they are labelled. Else it is, with hindsight, the masks'
    overlap with the teacher's (with `learn=reads` the nats of a read), and without it the coherence of the reads with the masks'
    motion; NaN without validation recordings. `folder` then holds checkpoints, metrics.jsonl, the learned parameters (weights.json, parameters.json,
    flow.safetensors), and with validation recordings metrics.json, report/ and the page report.html.
    Ctrl-C and SIGTERM make it write a checkpoint and raise `KeyboardInterrupt` or `Terminated`; the run resumes when it is
    started again in the same folder. With several processes (`config.distributed`) process 0 writes and evaluates; the
    others return NaN. The process that writes holds the folder's lock from before `on_start`, which writes what the caller
    adds to the folder. Raises `FolderLockedError` if another process holds it.
    """
    with contextlib.ExitStack() as lock:
        return _run(config, folder, console or Console(markup=False), on_start, lock)


def _run(
    config: TrainConfig,
    folder: Path,
    console: Console,
    on_start: Callable[[], None] | None,
    lock: contextlib.ExitStack,
) -> float:
    with distributed_runtime(config.distributed):  # before JAX's devices are used for the first time
        smoothing_tracers({"learned": make_tracer(config.tracer)}, config.scores)
        first = is_first()
        console.quiet = console.quiet or not first
        if first:
            lock.enter_context(locked_folder(folder))
            if on_start is not None:
                on_start()
        training, validation = training_recordings(config.data)
        _describe(console, training, validation)
        trained, data, logger = _train(config, folder, training, validation, console)
    try:
        if trained.stopped_by:
            console.print(f"Stopped at step {int(trained.state.step)}, which is saved.")
            raise interruption(trained.stopped_by)
        if not first:
            return float("nan")
        tracers, flows = _save_learned(config, folder, trained.state)
        if not validation:
            console.print("No validation recordings (data.validation is empty): no evaluation.")
            data.remove()
            return float("nan")
        summary = _report(config, folder, tracers, flows, validation)
        name, learned = next(iter(summary.items()))  # the learned tracer comes first
        logger.report(folder / "report", learned["all"], tracer=name)
    finally:
        logger.close()
    console.print(score_table(summary, title="validation recordings"))
    console.print(f"report: {folder / PAGE}", soft_wrap=True, highlight=False)
    iou = learned["all"].get("iou")
    if iou is None:
        iou = validation_metrics(trained.state, data.held_out, config).get(data.score, float("nan"))
    data.remove()
    return float(iou)


def _train(
    config: TrainConfig,
    folder: Path,
    training: Sequence[Recording],
    validation: Sequence[Recording],
    console: Console,
) -> tuple[TrainingResult[TrainState], TrainingData, Logger]:
    """The trained state, its data, and the logger, which stays open for the report."""
    state, optimizer = initial_state(config)
    data = training_data(config, folder, training, validation, console)
    loop = dataclasses.replace(config.loop, batch_size=data.batch_size)
    source = iter(data.samples)
    idle = jax.local_device_count() - local_batch_size(data.batch_size)
    if idle > 0:
        console.print(f"loop.batch_size={data.batch_size} leaves {idle} of {jax.local_device_count()} devices idle.")
    with Checkpoints(folder / "checkpoints") as checkpoints:
        state = resume_state(state, source, checkpoints, allowed=config.resume)
        if int(state.step):
            console.print(f"Resumed at step {int(state.step)} of {config.loop.num_steps}.")
        logger = Logger(folder, config.logger, config=dataclasses.asdict(config), resume_step=int(state.step))

        def update(state: TrainState, clips: Sequence[ClipLike]) -> tuple[TrainState, dict[str, float]]:
            state, numbers = train_step(state, clips, optimizer, config.learned)
            values = {f"parameter/{name}": value for name, value in parameters(state.tracer).items()}
            return state, numbers | values

        def validate(state: TrainState) -> dict[str, float]:
            return validation_metrics(state, data.held_out, config)

        try:
            trained = train(
                state,
                source,
                update=update,
                settings=loop,
                logger=logger,
                checkpoints=checkpoints,
                validate=validate if data.held_out else None,
            )
        except BaseException:
            logger.close()
            raise
        finally:
            source.close()
    return trained, data, logger


def _save_learned(
    config: TrainConfig, folder: Path, state: TrainState
) -> tuple[dict[str, AbstractTracer], dict[str, str]]:
    """Write the learned parameters. Returns the tracers (learned, before training, baselines) and the flow of the first two.

    The learned parameters are written to weights.json, those of all tracers to parameters.json. Where a flow network was
    trained jointly, the learned and the untrained tracer each use their own, written to flow.safetensors and
    flow_untrained.safetensors (flow_initial.safetensors, where training started from learned parameters).
    """
    before = "untrained" if config.weights is None else "initial"
    models = {"learned": state.model, before: make_model(config)}
    files = {"learned": folder / "flow.safetensors", before: folder / f"flow_{before}.safetensors"}
    flows = {name: evaluation_flow(model, config, files[name]) for name, model in models.items()}
    tracers = {name: model.tracer if isinstance(model, JointModel) else model for name, model in models.items()}
    tracers |= {name: make_tracer(settings) for name, settings in config.baselines.items()}
    if isinstance(learned := tracers["learned"], LearnableTracer):
        recipe = dataclasses.asdict(config) | {"steps": int(state.step)}
        clips = dataclasses.asdict(config.data.clips) | {"flow": flows["learned"]}
        about = to_json_values({"recipe": recipe})
        if config.weights is not None:
            about["began_with"] = read_learned(config.weights, config.tracer).about
        save_parameters(folder / "weights.json", learned, config.tracer, to_json_values(clips), about)
    write_json(folder / "parameters.json", {name: parameters(tracer) for name, tracer in tracers.items()})
    return tracers, flows


def _report(
    config: TrainConfig,
    folder: Path,
    tracers: Mapping[str, AbstractTracer],
    flows: Mapping[str, str],
    validation: Sequence[Recording],
) -> dict[str, Any]:
    """Evaluate the tracers on the validation recordings; the report's summary."""
    summary = evaluate_tracers(
        tracers,
        validation,
        folder / "report",
        clips=config.data.clips,
        own_clips=baseline_clips(config.baselines) | {name: {"flow": flow} for name, flow in flows.items()},
        settings=config.scores,
        epcs=config.data.clips.epcs,
        progress=config.loop.progress,
    )
    write_json(folder / "metrics.json", summary)
    with progress_lines(shown=config.loop.progress) as report:
        write_page(folder, on_progress=report)
    return summary


def validation_metrics(state: TrainState, held_out: Iterable[ClipLike], config: TrainConfig) -> dict[str, float]:
    """Mean of every term and diagnostic over the held-out samples that have it, always with the same random numbers; empty
    without samples.
    """
    key = jax.random.PRNGKey(config.seed)
    values = [clip_loss(state.model, sample.camera, sample.frames, key, config.learned) for sample in held_out]
    return {name: float(value) for name, value in mean_logs(values).items()} if values else {}


def _describe(console: Console, training: Sequence[Recording], validation: Sequence[Recording]) -> None:
    for kind, recordings in (("train", training), ("validation", validation)):
        for recording in recordings:
            tags = len(recording.reads.epcs)
            console.print(
                f"{kind}: {recording.name}, {recording.num_frames} frames at {recording.frame_rate_hz:.1f}/s, "
                f"{recording.reads.num_reads} reads of {tags} tags"
            )
