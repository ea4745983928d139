"""The result of a trial of faults, and what a trial does with each fault."""

from __future__ import annotations

import contextlib
import dataclasses
import signal
import threading
from collections.abc import Iterable, Iterator
from typing import Any

MAX_EXAMPLES = 5
_MAX_LENGTH = 300
_MAX_ERROR_LENGTH = 2000


@dataclasses.dataclass(frozen=True)
class Outcome:
    """How many faults of a kind were tried, how many of them failed, and the first failures."""

    kind: str
    tried: int
    failed: int
    examples: tuple[str, ...] = ()

    def __add__(self, other: Outcome) -> Outcome:
        examples = (*self.examples, *other.examples)[:MAX_EXAMPLES]
        return Outcome(self.kind, self.tried + other.tried, self.failed + other.failed, examples)


def joined(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """One outcome for each kind, in the order of the first of each."""
    by_kind: dict[str, Outcome] = {}
    for one in outcomes:
        by_kind[one.kind] = by_kind[one.kind] + one if one.kind in by_kind else one
    return list(by_kind.values())


def outcome(kind: str, faults: Iterable[str | None]) -> Outcome:
    """The outcome of faults of one kind, each None or, for a failure, its text."""
    texts = list(faults)
    failures = [escaped(text) for text in texts if text is not None]
    return Outcome(kind, len(texts), len(failures), tuple(failures[:MAX_EXAMPLES]))


def escaped(text: str) -> str:
    """A text of limited length in printable ASCII, without what has a meaning in Markdown, HTML or a terminal."""
    shown = text[:_MAX_LENGTH].encode("ascii", "backslashreplace").decode()
    return "".join(char if char.isprintable() and char not in "|<>`[]" else f"\\x{ord(char):02x}" for char in shown)


def unclear(error: BaseException, expected: type[Exception]) -> str | None:
    """None for an error of the expected class with a message in one line; else what is wrong with it."""
    text = str(error)
    if not isinstance(error, expected):
        return f"{type(error).__name__}: {text}"
    if "\n" in text or "\r" in text or len(text) > _MAX_ERROR_LENGTH:
        return f"a message of {len(text)} characters, {len(text.splitlines())} lines: {text}"
    return None


class TimeLimitError(BaseException):
    """A call took longer than its limit. It is no `Exception`, so that the code under trial does not catch it."""


@contextlib.contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise `TimeLimitError` in the block after so many seconds; without an effect outside of the main thread."""
    if threading.current_thread() is not threading.main_thread() or not hasattr(signal, "setitimer"):
        yield
        return

    def stop(number: int, frame: Any) -> None:
        raise TimeLimitError(f"longer than {seconds:g} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)
