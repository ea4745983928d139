"""How Ctrl-C and SIGTERM end a command: with the exit status 130 or 143, which a shell expects of them.

The module imports only the standard library, because a command sets its signal handlers before it imports anything else.
"""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
from collections.abc import Iterator
from typing import Any

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
_TEXTS = {signal.SIGINT: "interrupted by Ctrl-C.", signal.SIGTERM: "ended by SIGTERM."}
_AGAIN_S = 0.05

_last_signal: int | None = None


class Terminated(KeyboardInterrupt):
    """SIGTERM asks the program to end. Code that handles Ctrl-C handles it as well."""


def interruption(number: int) -> KeyboardInterrupt:
    """The exception that stands for a signal: `KeyboardInterrupt` for SIGINT, `Terminated` for SIGTERM."""
    return Terminated() if number == signal.SIGTERM else KeyboardInterrupt()


def signal_number(error: KeyboardInterrupt) -> int:
    """The signal that an exception stands for."""
    return signal.SIGTERM if isinstance(error, Terminated) else signal.SIGINT


def exit_status(number: int) -> int:
    """The exit status of a command that a signal has ended: 130 for SIGINT, 143 for SIGTERM."""
    return 128 + number


def message(number: int) -> str:
    """What ended the command, in a few words."""
    return _TEXTS[signal.Signals(number)]


def last_signal() -> int | None:
    """The last SIGINT or SIGTERM within `raise_on_signals`; None if there was none.

    An import may replace the exception of a signal by an `ImportError` of its own; the command ends as interrupted anyway.
    """
    return _last_signal


def exit_on_signals() -> None:
    """From now on Ctrl-C and SIGTERM end the process at once, with one line and the signal's exit status.

    This is for the time of imports: nothing is being written, and there is no place to catch an exception. Inside of
    `raise_on_signals` they raise an exception instead.
    """

    def end(number: int, frame: Any) -> None:
        del frame
        text = message(number)
        os.write(2, f"\n{text[0].upper()}{text[1:]}\n".encode())
        os._exit(exit_status(number))

    _set_handlers(end)


@contextlib.contextmanager
def raise_on_signals() -> Iterator[None]:
    """Within the block SIGTERM raises `Terminated`, and Ctrl-C `KeyboardInterrupt`, so that partial files are removed.

    Python ignores an exception that is raised in a callback of the garbage collector; it is raised again a moment later.
    """
    global _last_signal
    _last_signal = None

    def interrupt(number: int, frame: Any) -> None:
        global _last_signal
        del frame
        _last_signal = number
        raise interruption(number)

    def raise_again(ignored: sys.UnraisableHookArgs) -> None:
        if isinstance(ignored.exc_value, KeyboardInterrupt):
            threading.Timer(_AGAIN_S, os.kill, [os.getpid(), signal_number(ignored.exc_value)]).start()
        else:
            hook(ignored)

    hook = sys.unraisablehook
    sys.unraisablehook = raise_again
    try:
        with signals_handled(interrupt):
            yield
    finally:
        sys.unraisablehook = hook


@contextlib.contextmanager
def signals_handled(handler: Any) -> Iterator[None]:
    """Within the block `handler` is called at Ctrl-C and SIGTERM, unless they are ignored; nothing changes in other threads."""
    before = _set_handlers(handler)
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def _set_handlers(handler: Any) -> dict[int, Any]:
    """Set the handler of both signals; the handlers before it. SIGINT stays ignored where it is, as in a shell's background."""
    if threading.current_thread() is not threading.main_thread():
        return {}
    before = {number: signal.getsignal(number) for number in _SIGNALS}
    changed = {number: old for number, old in before.items() if old is not signal.SIG_IGN}
    for number in changed:
        signal.signal(number, handler)
    # None: the handler was not set by Python (but by JAX's distributed runtime) and cannot be restored.
    return {number: signal.SIG_DFL if old is None else old for number, old in changed.items()}
