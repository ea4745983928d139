"""Arrays on disk that take long to compute: computed once, by one process at a time, and resumed after an interruption.

The process that computes `name` holds the lock of `.name.lock` and writes to `.name.partial/`, both beside `name`: the
array is `array`, and `num_rows` holds the number of its complete rows. The lock ends with its process.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, cast

import filelock
import numpy as np
import zarr

from .files import make_folder, write_atomic, writing
from .progress import progress_lines
from .types import LazyArray

_ARRAY, _NUM_ROWS = "array", "num_rows"


def cached_array(target: Path, compute: Callable[[Path], None]) -> LazyArray:
    """The Zarr array at `target`; `compute` writes it at the path that it is given, if there is none (`compute_once`)."""
    compute_once(target, compute)
    return cast(LazyArray, zarr.open_array(str(target), mode="r"))


def compute_once(
    target: Path, compute: Callable[[Path], None], *, is_complete: Callable[[Path], bool] = Path.exists
) -> None:
    """Make `compute` write the folder `target`, at the path that it is given, unless `is_complete(target)`.

    Of several processes one computes, and the others wait for it. A `target` that is not complete is removed first.
    After an error, Ctrl-C or a kill the rows that `write_rows` has finished stay, and the next process resumes after
    them; other partial results are removed, at the latest by the next process. Raises `WriteError` where the file system
    refuses to write.
    """
    if is_complete(target):
        return
    make_folder(target.parent)
    with writing(target), _lock(target.with_name(f".{target.name}.lock")):
        # Another process may have computed it while this one waited.
        if is_complete(target):
            return
        folder = target.with_name(f".{target.name}.partial")
        try:
            if not (folder / _NUM_ROWS).exists():
                shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(exist_ok=True)
            _remove_incomplete(target)
            compute(folder / _ARRAY)
            os.replace(folder / _ARRAY, target)
        finally:
            if target.exists() or not (folder / _NUM_ROWS).exists():
                shutil.rmtree(folder, ignore_errors=True)


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
    """Write an array row by row for `cached_array`: one chunk a row, `shard` rows a file.

    `rows(first)` yields the rows from `first` on, in blocks whose lengths divide `shard`. `first` is above 0 where an
    earlier process was interrupted. Raises `ValueError` where `rows` yields another number of rows than `shape` has.
    """
    array, num_rows = _resumable(path, shape, dtype, shard) or (None, 0)
    if array is None:
        path.with_name(_NUM_ROWS).unlink(missing_ok=True)
        shutil.rmtree(path, ignore_errors=True)
        array = zarr.create_array(
            str(path),
            shape=shape,
            dtype=dtype,
            chunks=(1, *shape[1:]),
            shards=(shard, *shape[1:]),
            attributes=dict(attributes),
        )
    pending: list[np.ndarray] = []
    with progress_lines(shown=progress, kept=False) as report:
        done = num_rows
        report(description, done, shape[0])
        for block in rows(num_rows):
            pending.append(block)
            count = sum(map(len, pending))
            if count >= shard or num_rows + count >= shape[0]:
                array[num_rows : num_rows + count] = np.concatenate(pending)
                num_rows, pending = num_rows + count, []
                write_atomic(path.with_name(_NUM_ROWS), str(num_rows))
            done += len(block)
            report(description, done, shape[0])
    if num_rows != shape[0] or pending:
        raise ValueError(f"{num_rows + sum(map(len, pending))} rows for an array of {shape[0]}.")


def _resumable(path: Path, shape: tuple[int, ...], dtype: str, shard: int) -> tuple[zarr.Array, int] | None:
    """The array that an earlier process began, and the number of its complete rows; None if it cannot be used."""
    try:
        num_rows = int(path.with_name(_NUM_ROWS).read_text())
        array = zarr.open_array(str(path), mode="r+")
        found = array.shape, array.dtype, array.shards
        if found != (shape, np.dtype(dtype), (shard, *shape[1:])) or not 0 < num_rows <= shape[0]:
            return None
        # A file that was being written may be incomplete.
        for file in (path / "c").iterdir():
            if int(file.name) >= -(-num_rows // shard):
                shutil.rmtree(file)
    # The array can be computed again, so any damage counts as absence.
    except Exception:
        return None
    return array, num_rows


@contextlib.contextmanager
def _lock(path: Path) -> Iterator[None]:
    """Hold the lock of a file, which is removed at the end; waiting for another process is reported."""
    lock = filelock.FileLock(path)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout:
        print(
            f"{path.parent}: another process computes {path.stem.removeprefix('.')}; waiting for it.", file=sys.stderr
        )
        lock.acquire()
    try:
        yield
    finally:
        # Removed while it is held: a process that waits for the removed file notices that and makes a new one.
        with contextlib.suppress(OSError):  # Windows does not remove an open file
            path.unlink()
        lock.release()


def _remove_incomplete(folder: Path) -> None:
    """Remove a folder; it is renamed first, so that no process reads it while its files are removed."""
    aside = folder.with_name(f".{folder.name}.incomplete")
    shutil.rmtree(aside, ignore_errors=True)
    with contextlib.suppress(FileNotFoundError):
        os.rename(folder, aside)
    shutil.rmtree(aside, ignore_errors=True)
