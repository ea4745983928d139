"""Worker processes: they end with the process that started them, and leave signals to it."""

from __future__ import annotations

import contextlib
import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Iterator
from multiprocessing import resource_tracker


def end_with_parent() -> None:
    """End this worker process at once when its parent ends, however that ends: it has no other use."""
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()


@contextlib.contextmanager
def signals_blocked() -> Iterator[None]:
    """Processes that are started in the block never get Ctrl-C, and SIGTERM only from `unblock_sigterm` on.

    A terminal sends Ctrl-C to all processes of a command, and a scheduler SIGTERM. While a worker imports, either would end
    it with a traceback. This process gets a signal of that time at the end of the block.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    resource_tracker.ensure_running()  # its start, by the first worker, would unblock both signals
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def unblock_sigterm() -> None:
    """In a worker, after it has set its handler if it has one: SIGTERM is delivered from now on, also one that came before."""
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
