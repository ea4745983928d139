"""The training loop: plain Python around one update, with progress, logs, checkpoints and a clean way out."""

from __future__ import annotations

import dataclasses
import signal
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Generic, Protocol, TypeVar, runtime_checkable

import jax
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .checkpoint import CheckpointError, Checkpoints
from .logging import Logger
from .processes import any_process, is_first, share_of
from .state import Stepped

StateT = TypeVar("StateT", bound=Stepped)


@runtime_checkable
class DataIterator(Protocol):
    """An endless source of samples whose place can be kept: what Grain's iterators are."""

    def __next__(self) -> Any: ...

    def get_state(self) -> Any: ...

    def set_state(self, state: Any) -> None: ...


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """How long, and how often what is written."""

    num_steps: int = 14
    batch_size: int = 1  # samples whose gradients are averaged in a step, over all devices and processes
    checkpoint_every: int = 7
    validate_every: int = 7
    log_every: int = 1
    stop_after_skipped: int = 5  # steps without a finite gradient, one after the other
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
            if getattr(self, name) < 1:
                raise ValueError(f"loop.{name} is {getattr(self, name)}; expected at least 1.")


class DivergedError(RuntimeError):
    """Training was stopped: several steps in a row had no finite loss or gradient."""


@dataclasses.dataclass(frozen=True)
class Trained(Generic[StateT]):
    """How a call of `train` ended."""

    state: StateT
    interrupted: bool


@contextmanager
def _stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C and SIGTERM into a flag, so that the step in progress ends; a second Ctrl-C stops at once.

    SIGTERM is what a scheduler sends before it kills, maybe more than once: it never stops at once.
    """
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def handler(number: int, frame: Any) -> None:
        if asked.is_set() and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked.set()

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield asked.is_set
    finally:
        for number, earlier in before.items():
            # None is one that Python did not set (JAX's runtime of several processes): it cannot be put back.
            signal.signal(number, signal.SIG_DFL if earlier is None else earlier)


def resumed(state: StateT, samples: DataIterator, checkpoints: Checkpoints, *, allowed: bool) -> StateT:
    """The newest checkpoint's state, with the samples at its place; the given state where there is no checkpoint.

    Raises `CheckpointError` if there is one and going on is not `allowed`.
    """
    if not checkpoints.steps():
        return state
    if not allowed:
        raise CheckpointError(
            f"{checkpoints.folder.parent} holds a run already; set resume=true or choose another folder."
        )
    state, data_state = checkpoints.restore(state)
    samples.set_state(data_state)
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
    shown: Sequence[str] = ("loss", "own_coherence"),
) -> Trained[StateT]:
    """Train from `state.step` to `num_steps`; a checkpoint is written at the end, or when Ctrl-C, SIGTERM or the samples end it.

    `update` does one step on this process's share of `batch_size` samples and gives numbers to log, which are the same
    in all processes; `shown` names those beside the progress bar. `validate` gives numbers that are logged under
    `validation/`; `after_step` is called after every step.

    A step whose `skipped` is 1 changed nothing, and no checkpoint is due after it. Raises `DivergedError` after
    `stop_after_skipped` of them in a row; it names the last checkpoint written before the first of them.
    """
    columns = (
        TextColumn("[bold]train"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[numbers]}"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    begun, skipped, share = int(state.step), 0, share_of(settings.batch_size)
    done = begun
    quiet = not settings.progress or not is_first()
    with _stop_on_interrupt() as stop_asked, Progress(*columns, disable=quiet) as progress:
        task = progress.add_task("train", total=settings.num_steps, completed=done, numbers="compiling")
        stopping = any_process(stop_asked())
        while done < settings.num_steps and not stopping:
            place = samples.get_state()
            try:
                batch = [next(samples) for _ in range(share)]
            except Exception as error:
                # Whatever a source raises, the steps done so far are sound; the batch is drawn again when the run goes on.
                if done > begun:
                    checkpoints.save(state, place)
                    error.add_note(f"The run is saved at step {done} in {checkpoints.folder}; it can go on from there.")
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
                found = {f"validation/{name}": value for name, value in validate(state).items()}
                logger.write(done, found)
            # While steps are skipped none is written: those kept would push the last good one out.
            if (done % settings.checkpoint_every == 0 and not skipped) or done == settings.num_steps:
                checkpoints.save(state, samples.get_state())
            if after_step is not None:
                after_step(state)
            told = "  ".join(f"{name} {numbers[name]:.3f}" for name in shown if name in numbers)
            progress.update(task, completed=done, numbers=told)
            stopping = any_process(stop_asked())
        if stopping:
            jax.block_until_ready(state.step)
            checkpoints.save(state, samples.get_state())
    return Trained(state, done < settings.num_steps)


def _diverged(checkpoints: Checkpoints, done: int, skipped: int) -> str:
    good = [step for step in checkpoints.steps() if step <= done - skipped]
    there = (
        f"the last good checkpoint is step {good[-1]} in {checkpoints.folder}. Go on from there by retune=true"
        if good
        else f"no checkpoint was written before them in {checkpoints.folder}. Start again"
    )
    return (
        f"The loss or its gradient was not finite in {skipped} steps in a row, up to step {done}; {there} "
        "with a smaller learning rate or clip_norm, and look at the data of these steps."
    )
