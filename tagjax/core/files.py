"""Files and folders that appear whole or not at all, and errors of the file system that state what was being written."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
import shutil
import socket
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

_FREE_SPACE = "Free some space and start the command again: what was complete before is kept"
_OTHER_FOLDER = "Choose a folder that can be written to, or change its permissions"
_MAX_STEM_BYTES = 200
"""Of a file's name, within the name of its partial file: most file systems allow 255 bytes in all."""

_ADVICE = {
    errno.ENOSPC: _FREE_SPACE,
    errno.EDQUOT: _FREE_SPACE,
    errno.EFBIG: "Raise the limit on file sizes (ulimit -f) and start the command again: what was complete before is kept",
    errno.EIO: "Check the disk and start the command again: what was complete before is kept",
    errno.EROFS: _OTHER_FOLDER,
    errno.EACCES: _OTHER_FOLDER,
    errno.EPERM: _OTHER_FOLDER,
    errno.ENAMETOOLONG: "Choose a shorter name or a folder with a shorter path",
    errno.ENOTDIR: "A part of this path is a file: choose another folder",
}


class WriteError(OSError):
    """A file or folder that the file system refused to write: which one, the reason, what to do."""

    def __init__(self, path: str | Path, number: int):
        super().__init__(f"{path} could not be written: {os.strerror(number)}. {_ADVICE[number]}.")
        self.path, self.number, self.errno = path, number, number

    def __reduce__(self) -> tuple[type[WriteError], tuple[str | Path, int]]:
        return WriteError, (self.path, self.number)  # worker processes send it to their parent


@contextlib.contextmanager
def writing(path: str | Path) -> Iterator[None]:
    """Errors of the file system in the block are raised as `WriteError`: a full or read-only disk, missing permissions.

    Other errors, and errors about files outside of `path` and its folder, are raised unchanged.
    """
    try:
        yield
    except WriteError:
        raise
    except Exception as error:
        number = refusal(error)
        if number is None or not _concerns(error, Path(path)):
            raise
        raise WriteError(path, number) from error


def refusal(error: BaseException) -> int | None:
    """The error number if the file system refused to write; None for other errors.

    TensorStore, which writes checkpoints, raises a `ValueError` that has the number in its text.
    """
    number = error.errno if isinstance(error, OSError) else None
    if found := re.search(r"os_error_code='(\d+)'", str(error)):
        number = int(found[1])
    return number if number in _ADVICE else None


def _concerns(error: Exception, path: Path) -> bool:
    """Whether an error is about `path`, a file beside or in it, or one of its parents; an error may state no file."""
    stated = getattr(error, "filename", None)
    if not isinstance(stated, str | bytes | os.PathLike):
        return True
    file, path = Path(os.fsdecode(stated)).absolute(), path.absolute()
    return path.parent in (file, *file.parents) or file in path.parents


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new path beside `path`, at which the block writes a file or a folder; it is renamed to `path` at the end.

    An existing file at `path` is replaced; an existing folder that is not empty raises `OSError`. If the block raises,
    whatever it wrote is removed and `path` stays as it was. A killed process leaves
    `.<name>.<machine>-<pid>-<random>.partial` behind, which no reader opens; the next process on that machine that writes the
    same path removes it, unless the machine was started again meanwhile. Parent folders are created. Raises `WriteError`
    where the file system refuses to write.
    """
    path = Path(path)
    with writing(path):
        make_folder(path.parent)
        _remove_abandoned(path)
        partial = path.with_name(f"{_partial_start(path)}{os.getpid()}-{uuid.uuid4().hex[:8]}.partial")
        try:
            yield partial
            os.replace(partial, path)
        except BaseException:
            _remove_while_written(partial)
            raise


def write_atomic(path: str | Path, content: str | bytes) -> None:
    """Write a file that appears whole or not at all (`atomic_path`); text is encoded as UTF-8."""
    with atomic_path(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def make_folder(path: Path) -> None:
    """Create a folder and its parents where they are missing. Raises `WriteError` where the file system refuses that."""
    with writing(path):
        path.mkdir(parents=True, exist_ok=True)


def remove(path: Path) -> None:
    """Remove a file or a folder with all its content; nothing happens where there is none."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _remove_while_written(path: Path) -> None:
    """Remove a folder to which threads, such as Zarr's, may still be writing: they would make it anew."""
    for _ in range(5):
        remove(path)
        time.sleep(0.05)
        if not path.exists():
            return


def _remove_abandoned(path: Path) -> None:
    """Remove what killed processes of this machine left of `path`."""
    start = _partial_start(path)
    with os.scandir(path.parent) as entries:
        names = [entry.name for entry in entries if entry.name.startswith(start) and entry.name.endswith(".partial")]
    for name in names:
        process = name.removeprefix(start).split("-")[0]
        if process.isascii() and process.isdigit() and not _runs(int(process)):
            remove(path.with_name(name))


def _partial_start(path: Path) -> str:
    """How the names of a path's partial files begin that processes of this machine write."""
    stem = os.fsencode(path.name)
    name = path.name if len(stem) <= _MAX_STEM_BYTES else stem[:_MAX_STEM_BYTES].decode(errors="ignore")
    return f".{name}.{_machine()}-"


@functools.cache
def _machine() -> str:
    """A digest of what process numbers refer to: the machine's name, its current boot, the container's numbering."""
    parts = [socket.gethostname()]
    with contextlib.suppress(OSError):
        parts.append(Path("/proc/sys/kernel/random/boot_id").read_text().strip())
    with contextlib.suppress(OSError):
        parts.append(os.readlink("/proc/self/ns/pid"))
    return hashlib.sha256("\n".join(parts).encode("utf-8", "surrogatepass")).hexdigest()[:12]


def _runs(process: int) -> bool:
    """Whether a process of this machine runs; also true where that cannot be found out."""
    if os.name == "nt":  # there, signal 0 would end the process
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True
