"""The training loop: plain Python around one update, with progress, logs, checkpoints and a clean stop."""

from __future__ import annotations

import dataclasses
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import jax

from ..core.interruption import signals_handled
from ..core.progress import progress_lines
from .checkpoint import CheckpointError, Checkpoints
from .logging import Logger
from .processes import is_first, local_batch_size, max_over_processes
from .state import HasStep

StateT = TypeVar("StateT", bound=HasStep)


@runtime_checkable
class DataIterator(Protocol):
    """An endless iterator over samples whose position can be saved and restored, as Grain's iterators have it."""

    def __next__(self) -> Any: ...

    def get_state(self) -> Any: ...

    def set_state(self, state: Any) -> None: ...


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """The number of steps, and how often logs, checkpoints and validation are written."""

    num_steps: int = 8
    batch_size: int | None = None  # samples whose gradients are averaged in a step, over all devices and processes
    checkpoint_every: int = 1
    validate_every: int = 1
    log_every: int = 1
    stop_after_skipped: int = 5  # steps in a row without a finite gradient
    progress: bool = True

    def __post_init__(self) -> None:
        for name in (
            "num_steps",
            "batch_size",
            "checkpoint_every",
            "validate_every",
            "log_every",
            "stop_after_skipped",
        ):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"loop.{name} is {value}; expected at least 1.")


class DivergedError(RuntimeError):
    """Training was stopped: several steps in a row had no finite loss or gradient."""


@dataclasses.dataclass(frozen=True)
class TrainingResult(Generic[StateT]):
    """The last state of a call of `train`, and the signal that stopped it: SIGINT (Ctrl-C), SIGTERM, or 0."""

    state: StateT
    stopped_by: int = 0


@contextmanager
def _stop_on_signals() -> Iterator[Callable[[], int]]:
    """Turns Ctrl-C and SIGTERM into a number, 0 before either, so that the step in progress is finished.

    A second Ctrl-C stops at once. Schedulers send SIGTERM before they kill a job, sometimes repeatedly; it never stops at
    once.
    """
    received = 0

    def handler(number: int, frame: Any) -> None:
        nonlocal received
        if received and number == signal.SIGINT:
            raise KeyboardInterrupt
        received = max(received, number)

    with signals_handled(handler):
        yield lambda: received


def resume_state(state: StateT, samples: DataIterator, checkpoints: Checkpoints, *, allowed: bool) -> StateT:
    """The newest checkpoint's state, with `samples` moved to its position; `state` itself where there is no checkpoint.

    Raises `CheckpointError` if there is one and resuming is not `allowed`, and for one with another position in the data.
    """
    if not checkpoints.steps():
        return state
    if not allowed:
        raise CheckpointError(
            f"{checkpoints.folder.parent} already holds a run; set resume=true or choose another folder."
        )
    state, data_state = checkpoints.restore(state)
    try:
        samples.set_state(data_state)
    except ValueError as error:
        raise CheckpointError(
            f"{checkpoints.folder / str(int(state.step))}: {error} Resume with this run's data."
        ) from error
    return state


def train(
    state: StateT,
    samples: DataIterator,
    *,
    update: Callable[[StateT, Sequence[Any]], tuple[StateT, dict[str, float]]],
    settings: LoopSettings,
    logger: Logger,
    checkpoints: Checkpoints,
    validate: Callable[[StateT], Mapping[str, float]] | None = None,
    after_step: Callable[[StateT], None] | None = None,
    displayed: Sequence[str] = ("loss", "own_coherence"),
) -> TrainingResult[StateT]:
    """Train from `state.step` to `num_steps`; a checkpoint is written at the end, and on Ctrl-C, SIGTERM or an error of `samples`.

    `update` does one step on this process's part of `batch_size` samples and returns metrics to log, which are the same
    in all processes; `displayed` lists those beside the progress. `validate` returns metrics that are logged under
    `validation/`; `after_step` is called after every step.

    A step with `skipped` = 1 leaves the parameters unchanged, and no periodic checkpoint is written after it. Raises
    `DivergedError` after `stop_after_skipped` of them in a row; its message gives the last checkpoint before them.
    """
    first_step, skipped, batch_size = int(state.step), 0, local_batch_size(settings.batch_size)
    done = first_step
    shown = settings.progress and is_first()
    with _stop_on_signals() as received, progress_lines(shown=shown) as report:
        report("train", done, settings.num_steps, "compiling")
        stopped_by = max_over_processes(received())
        while done < settings.num_steps and not stopped_by:
            place = samples.get_state()
            try:
                batch = [next(samples) for _ in range(batch_size)]
            except Exception as error:
                # Whatever the source raises, the steps done so far are valid; the batch is drawn again on resuming.
                if done > first_step:
                    checkpoints.save(state, place)
                    error.add_note(
                        f"The run is saved at step {done} in {checkpoints.folder}; it can be resumed from there."
                    )
                raise
            state, numbers = update(state, batch)
            done += 1
            skipped = skipped + 1 if numbers.get("skipped", 0.0) > 0 else 0
            if skipped == settings.stop_after_skipped:
                logger.write(done, numbers)
                raise DivergedError(_diverged(checkpoints, done, skipped))
            if done % settings.log_every == 0 or done == settings.num_steps:
                logger.write(done, numbers)
            if validate is not None and (done % settings.validate_every == 0 or done == settings.num_steps):
                logger.write(done, {f"validation/{name}": value for name, value in validate(state).items()})
            # No checkpoint is written while steps are skipped: it would displace the last good one.
            if (done % settings.checkpoint_every == 0 and not skipped) or done == settings.num_steps:
                checkpoints.save(state, samples.get_state())
            if after_step is not None:
                after_step(state)
            text = "  ".join(f"{name} {numbers[name]:.3f}" for name in displayed if name in numbers)
            report("train", done, settings.num_steps, text)
            stopped_by = max_over_processes(received())
        if stopped_by:
            jax.block_until_ready(state.step)
            checkpoints.save(state, samples.get_state())
    return TrainingResult(state, stopped_by)


def _diverged(checkpoints: Checkpoints, done: int, skipped: int) -> str:
    before = [step for step in checkpoints.steps() if step <= done - skipped]
    advice = (
        f"the last good checkpoint is step {before[-1]} in {checkpoints.folder}. Resume from it by retune=true"
        if before
        else f"no checkpoint was written before them in {checkpoints.folder}. Start again"
    )
    return (
        f"The loss or its gradient was not finite in {skipped} steps in a row, up to step {done}; {advice} "
        "with a smaller learning rate or clip_norm, and look at the data of these steps."
    )
