"""Progress of work that takes long: a line a stage, with count, rate and remaining time, on a terminal and nowhere else.

Work that can be observed calls an `OnProgress`; a command shows the calls by `progress_lines`.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import threading
from collections.abc import Iterable, Iterator, Sized
from typing import Protocol, TypeVar, runtime_checkable

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, ProgressColumn, Task, TimeElapsedColumn
from rich.table import Column
from rich.text import Text

T = TypeVar("T")

_BAR_WIDTH = 16
_SAMPLES_S = 1e9
"""Time over which a rate is the mean, s: all of it (`rich` keeps the last thousand samples)."""

_lock = threading.Lock()
_active: Progress | None = None
"""What is shown now. Only one display can be on a terminal, so work within shown work adds its lines to it."""


@runtime_checkable
class OnProgress(Protocol):
    """Is called with a stage of the work, how much of it is done, and its total; `now` says what is done at the moment.

    The first call of a stage gives what was there before: a rate does not count it.
    """

    def __call__(self, stage: str, done: int, total: int, now: str = "") -> None: ...


def unobserved(stage: str, done: int, total: int, now: str = "") -> None:
    """The `OnProgress` of work that nobody watches."""
    del stage, done, total, now


@contextlib.contextmanager
def progress_lines(*, shown: bool = True, console: Console | None = None, kept: bool = True) -> Iterator[OnProgress]:
    """Within the block each stage that is reported has a line: bar, count, rate, elapsed and remaining time.

    Nothing is written unless `shown` and unless the output is a terminal: the output of a program that another reads, or
    that goes to a file, has results and messages only. The lines stay on the terminal if they are `kept`.
    """
    global _active
    console = console or Console(markup=False)
    if not (shown and _on_terminal(console)):
        yield unobserved
        return
    with _lock:
        around, own = _active, _bars(console, transient=not kept)
        if around is None:
            _active = own
    if around is not None:
        with _stages(around, kept=False) as report:
            yield report
        return
    try:
        with own, _stages(own, kept=True) as report:
            yield report
    finally:
        _active = None


def _on_terminal(console: Console) -> bool:
    """Whether a person reads the output as it comes. Worker processes share a terminal with the one that shows lines."""
    # FORCE_COLOR makes `is_interactive` true for a file.
    return console.is_interactive and console.file.isatty() and multiprocessing.parent_process() is None


def tracked(items: Iterable[T], stage: str, total: int | None = None, *, shown: bool = True) -> Iterator[T]:
    """The same items; on a terminal a line counts them while they are used. `total` is their number, if they have no `len`."""
    number = len(items) if total is None and isinstance(items, Sized) else total or 0
    done = 0
    with progress_lines(shown=shown, kept=False) as report:
        for item in items:
            report(stage, done, number)
            yield item
            done += 1
        report(stage, done, done)


def rate_text(per_s: float | None) -> str:
    """A rate in words: a number a second from 1/s on, or else the time that one takes; nothing where it is not known."""
    if not per_s:
        return ""
    if per_s >= 1.0:
        return f"{per_s:.0f}/s" if per_s >= 100.0 else f"{per_s:.1f}/s"
    each_s = 1.0 / per_s
    return f"{each_s:.1f} s each" if each_s < 100.0 else f"{each_s / 60.0:.1f} min each"


def time_text(seconds: float | None) -> str:
    """A duration as minutes and seconds, with hours in front where there are any."""
    if seconds is None:
        return "-:--"
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


@contextlib.contextmanager
def _stages(bars: Progress, *, kept: bool) -> Iterator[OnProgress]:
    """An `OnProgress` with a line of `bars` for each stage; the lines are removed at the end unless they are `kept`."""
    tasks = {}

    def report(stage: str, done: int, total: int, now: str = "") -> None:
        known = total if total > 0 else None
        if stage not in tasks:
            tasks[stage] = bars.add_task(stage, total=known, completed=done, first=done, stage=stage, now=now)
        bars.update(tasks[stage], completed=done, total=known, now=now)

    try:
        yield report
    finally:
        for task in () if kept else tasks.values():
            bars.remove_task(task)


def _bars(console: Console, *, transient: bool) -> Progress:
    return Progress(
        _Words("stage"),
        BarColumn(_BAR_WIDTH),
        MofNCompleteColumn(table_column=Column(no_wrap=True)),
        _Rate(table_column=Column(no_wrap=True)),
        TimeElapsedColumn(table_column=Column(no_wrap=True)),
        _Left(table_column=Column(no_wrap=True)),
        _Words("now"),
        console=console,
        transient=transient,
        speed_estimate_period=_SAMPLES_S,
    )


def _rate_per_s(task: Task) -> float | None:
    """The rate after the first unit, which includes compilation; before there is another, of all time. None: not known."""
    if task.speed:
        return task.speed
    done = task.completed - task.fields["first"]
    return done / task.elapsed if done > 0 and task.elapsed else None


class _Words(ProgressColumn):
    """A field of the task, which is cut where the line has no room; the numbers beside it are not."""

    def __init__(self, field: str):
        super().__init__(Column(min_width=6))
        self._field = field

    def render(self, task: Task) -> Text:
        return Text(task.fields[self._field], no_wrap=True, overflow="ellipsis")


class _Rate(ProgressColumn):
    def render(self, task: Task) -> Text:
        return Text(rate_text(_rate_per_s(task)), style="progress.data.speed")


class _Left(ProgressColumn):
    def render(self, task: Task) -> Text:
        rate = _rate_per_s(task)
        left_s = (task.remaining or 0) / rate if rate and task.remaining is not None else None
        return Text("" if task.finished else f"left {time_text(left_s)}", style="progress.remaining")
