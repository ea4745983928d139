"""A folder that one process at a time writes to.

The lock is the operating system's lock of `.lock` in the folder, so it ends with its process, however that ends. Beside it,
`.lock_holder.json` states which process holds it.
"""

from __future__ import annotations

import contextlib
import json
import os
import socket
import warnings
from collections.abc import Iterator
from pathlib import Path

import filelock

from .files import make_folder, remove, write_atomic, writing

_LOCK, _HOLDER = ".lock", ".lock_holder.json"


class FolderLockedError(ValueError):
    """Another process writes to the folder."""


@contextlib.contextmanager
def locked_folder(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder, which is created if it is missing.

    Raises `FolderLockedError` at once, with the number and the machine of the process, if another one holds it. Where the
    file system has no locks, there is a `RuntimeWarning` and no lock.
    """
    make_folder(folder)
    lock = filelock.FileLock(folder / _LOCK)
    try:
        with writing(folder / _LOCK):
            lock.acquire(blocking=False)
    except filelock.Timeout:
        raise FolderLockedError(
            f"{folder} is in use: {_holder(folder)} writes to it. Wait for its end or stop it, or choose another folder."
        ) from None
    except NotImplementedError:
        warnings.warn(
            f"{folder}: its file system has no locks. Start no second command that writes to this folder.",
            RuntimeWarning,
            stacklevel=3,
        )
        yield
        return
    try:
        write_atomic(folder / _HOLDER, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}) + "\n")
        yield
    finally:
        remove(folder / _HOLDER)
        lock.release()


def _holder(folder: Path) -> str:
    try:
        holder = json.loads((folder / _HOLDER).read_text(encoding="utf-8"))
        return f"process {int(holder['pid'])} on {holder['host']}"
    except (OSError, ValueError, KeyError, TypeError):  # not written yet, or removed already
        return "another process"
