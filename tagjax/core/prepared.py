"""Arrays that take long to make: made once, by one process at a time, and gone on with after an interruption.

The maker of `name` works in `.name.partial/` beside it: `made` is the array, `done` says how many of its rows are whole,
and whoever has locked `lock` is at work there. A lock ends with its process, however that ends.
"""

from __future__ import annotations

import contextlib
import glob
import os
import shutil
import sys
import time
import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, cast

import numpy as np
import zarr
from rich.progress import Progress

from .types import LazyArray

try:
    import fcntl
except ImportError:  # Windows has other locks
    fcntl = None  # type: ignore[assignment]

_MADE, _DONE, _LOCK = "made", "done", "lock"

_ABANDONED_S = 3600.0
"""A folder without a lock that nothing was added to for so long is of a process that was killed."""


def made_once(target: Path, make: Callable[[Path], None]) -> LazyArray:
    """The array at `target`, which `make` writes at the path that it is given, where it is not there yet.

    Of several processes one makes it, and the others wait. After an error, Ctrl-C or a kill the rows that `write_rows` has
    finished stay, and the next maker goes on after them; anything else unfinished is removed, by the next maker at the
    latest. Where files cannot be locked, each process makes its own from the start, and the first one's stays.
    """
    if not target.exists():
        target.parent.mkdir(parents=True, exist_ok=True)
        with _workplace(target) as folder:
            # Another process may have been faster, here and below: what it made is the same.
            if not target.exists():
                make(folder / _MADE)
                try:
                    os.replace(folder / _MADE, target)
                except OSError:
                    if not target.exists():
                        raise
    return cast(LazyArray, zarr.open_array(str(target), mode="r"))


def write_rows(
    path: Path,
    rows: Callable[[int], Iterable[np.ndarray]],
    *,
    shape: tuple[int, ...],
    dtype: str,
    shard: int,
    attributes: Mapping[str, Any],
    description: str,
    progress: bool = True,
) -> None:
    """Write an array row by row for `made_once`; one chunk a row, `shard` rows a file.

    `rows(first)` gives the rows from `first` on, in blocks whose lengths divide `shard`. `first` is not 0 where an earlier
    maker was cut short. Raises `ValueError` for another number of rows than `shape` has.
    """
    kept, done = _begun(path, shape, dtype, shard) or (None, 0)
    if kept is None:
        path.with_name(_DONE).unlink(missing_ok=True)
        shutil.rmtree(path, ignore_errors=True)
        kept = zarr.create_array(
            str(path),
            shape=shape,
            dtype=dtype,
            chunks=(1, *shape[1:]),
            shards=(shard, *shape[1:]),
            attributes=dict(attributes),
        )
    held: list[np.ndarray] = []
    with Progress(disable=not progress, transient=True) as bar:
        task = bar.add_task(description, total=shape[0], completed=done)
        for block in rows(done):
            held.append(block)
            count = sum(map(len, held))
            if count >= shard or done + count >= shape[0]:
                kept[done : done + count] = np.concatenate(held)
                done, held = done + count, []
                _tell_done(path, done)
            bar.advance(task, len(block))
    if done != shape[0] or held:
        raise ValueError(f"{done + sum(map(len, held))} rows for an array of {shape[0]}.")


def _begun(path: Path, shape: tuple[int, ...], dtype: str, shard: int) -> tuple[zarr.Array, int] | None:
    """The array that an earlier maker began, and how many of its rows are whole; None for nothing of use."""
    try:
        done = int(path.with_name(_DONE).read_text())
        kept = zarr.open_array(str(path), mode="r+")
        found = kept.shape, kept.dtype, kept.shards
        if found != (shape, np.dtype(dtype), (shard, *shape[1:])) or not 0 < done <= shape[0]:
            return None
        # A file that was being written may be half of one.
        for file in (path / "c").iterdir():
            if int(file.name) >= -(-done // shard):
                shutil.rmtree(file)
    # All of it can be made again, so any damage is as good as its absence.
    except Exception:
        return None
    return kept, done


def _tell_done(path: Path, done: int) -> None:
    beside = path.with_name(f"{_DONE}.part")
    beside.write_text(str(done))
    os.replace(beside, path.with_name(_DONE))


@contextlib.contextmanager
def _workplace(target: Path) -> Iterator[Path]:
    """A folder beside `target` that nobody else works in, with what was finished there before."""
    folder = target.with_name(f".{target.name}.partial")
    lock = _locked(folder)
    if lock is None:
        folder = target.with_name(f".{target.name}.{uuid.uuid4().hex}.partial")
        folder.mkdir()
    try:
        # What killed processes left under names of their own: without locks, or by earlier releases.
        remove_abandoned(target.parent.glob(f".{glob.escape(target.name)}.*.partial"))
        if not (folder / _DONE).exists():
            shutil.rmtree(folder / _MADE, ignore_errors=True)
        yield folder
    finally:
        if lock is None or target.exists() or not (folder / _DONE).exists():
            _remove(folder)
        if lock is not None:
            lock.close()


def _locked(folder: Path) -> IO[bytes] | None:
    """The lock of a folder, which is made, once nobody else holds it; None where files cannot be locked."""
    while fcntl is not None:
        # With exist_ok an error of its own, where the folder goes between the attempt and the look at it.
        with contextlib.suppress(FileExistsError):
            folder.mkdir()
        try:
            lock = (folder / _LOCK).open("ab")
        except FileNotFoundError:  # who was at work here has just finished, and removed the folder
            continue
        with contextlib.ExitStack() as on_failure:
            on_failure.enter_context(lock)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                print(f"{folder}: another process is at work there; waiting for it.", file=sys.stderr)
                fcntl.flock(lock, fcntl.LOCK_EX)
            except OSError:
                if not (folder / _MADE).exists():
                    _remove(folder)
                return None
            # It may be that of a folder which was removed meanwhile.
            with contextlib.suppress(FileNotFoundError):
                if os.path.samestat(os.fstat(lock.fileno()), (folder / _LOCK).stat()):
                    on_failure.pop_all()
                    return lock
    return None


def _remove(folder: Path) -> None:
    """Take a folder away. Its lock goes last: until then nobody else begins there."""
    for name in (_DONE, f"{_DONE}.part"):
        (folder / name).unlink(missing_ok=True)
    shutil.rmtree(folder / _MADE, ignore_errors=True)
    (folder / _LOCK).unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # from here on another process may be at work there
        folder.rmdir()


def remove_abandoned(folders: Iterable[Path]) -> None:
    """Take away those of these folders, in which arrays were made, that nothing was added to for an hour."""
    for left in folders:
        with contextlib.suppress(OSError):
            newest = max(path.stat().st_mtime for path in (left, *left.glob("c"), *left.glob("*/c")))
            if time.time() - newest > _ABANDONED_S:
                shutil.rmtree(left, ignore_errors=True)
