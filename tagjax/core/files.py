"""Files and folders that appear whole or not at all."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A new path beside `path`, at which the block writes a file or a folder; it is renamed to `path` at the end.

    An existing file at `path` is replaced; an existing folder that is not empty raises `OSError`. If the block raises,
    whatever it wrote is removed and `path` stays as it was. A killed process leaves `.<name>.<random>.partial` behind,
    which no reader opens. Parent folders are created.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        yield partial
        os.replace(partial, path)
    finally:
        remove(partial)


def write_atomic(path: str | Path, content: str | bytes) -> None:
    """Write a file that appears whole or not at all (`atomic_path`); text is encoded as UTF-8."""
    with atomic_path(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


def remove(path: Path) -> None:
    """Remove a file or a folder with all its content; nothing happens where there is none."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
