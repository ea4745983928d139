"""The training loop: plain Python around `train_step`, with progress, logs, checkpoints and a clean way out."""

from __future__ import annotations

import dataclasses
import signal
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol, runtime_checkable

import jax
import optax
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .checkpoint import Checkpoints
from .logging import Logger
from .loss import ObjectiveSettings
from .state import TrainState
from .step import ClipLike, train_step


@runtime_checkable
class ClipIterator(Protocol):
    """An endless source of clips whose place can be kept: what Grain's iterators are."""

    def __next__(self) -> ClipLike: ...

    def get_state(self) -> Any: ...

    def set_state(self, state: Any) -> None: ...


@dataclasses.dataclass(frozen=True)
class LoopSettings:
    """How long, and how often what is written."""

    num_steps: int = 14
    batch_size: int = 1  # clips whose gradients are averaged in a step
    checkpoint_every: int = 7
    validate_every: int = 7
    log_every: int = 1
    progress: bool = True


@dataclasses.dataclass(frozen=True)
class Trained:
    """How a call of `train` ended."""

    state: TrainState
    interrupted: bool


@contextmanager
def _stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Turns Ctrl-C into a flag, so that the step in progress ends; a second Ctrl-C stops at once."""
    asked = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield asked.is_set
        return

    def handler(number: int, frame: Any) -> None:
        if asked.is_set():
            raise KeyboardInterrupt
        asked.set()

    before = signal.signal(signal.SIGINT, handler)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)


def train(
    state: TrainState,
    clips: ClipIterator,
    *,
    optimizer: optax.GradientTransformation,
    objective: ObjectiveSettings,
    settings: LoopSettings,
    logger: Logger,
    checkpoints: Checkpoints,
    validate: Callable[[TrainState], Mapping[str, float]] | None = None,
    after_step: Callable[[TrainState], None] | None = None,
) -> Trained:
    """Train from `state.step` to `num_steps`; a checkpoint is written at the end whatever ends it.

    `validate` gives numbers that are logged under `validation/`; `after_step` is called after every step.
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
    done = int(state.step)
    with _stop_on_interrupt() as stop_asked, Progress(*columns, disable=not settings.progress) as progress:
        task = progress.add_task("train", total=settings.num_steps, completed=done, numbers="compiling")
        while done < settings.num_steps and not stop_asked():
            batch = [next(clips) for _ in range(settings.batch_size)]
            state, numbers = train_step(state, batch, optimizer, objective)
            done += 1
            if done % settings.log_every == 0 or done == settings.num_steps:
                logger.write(done, numbers)
            if validate is not None and (done % settings.validate_every == 0 or done == settings.num_steps):
                found = {f"validation/{name}": value for name, value in validate(state).items()}
                logger.write(done, found)
            if done % settings.checkpoint_every == 0 or done == settings.num_steps:
                checkpoints.save(state, clips.get_state())
            if after_step is not None:
                after_step(state)
            shown = "  ".join(f"{name} {numbers[name]:.3f}" for name in ("loss", "own_coherence") if name in numbers)
            progress.update(task, completed=done, numbers=shown)
        if stop_asked():
            jax.block_until_ready(state.step)
            checkpoints.save(state, clips.get_state())
    return Trained(state, done < settings.num_steps)
