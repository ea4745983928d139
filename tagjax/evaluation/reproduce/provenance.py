"""The files that determine a table, their revision, and whether they have changed since."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any


def blob_id(content: bytes) -> str:
    """Git's id of a file with this content (`git hash-object`)."""
    return hashlib.sha1(b"blob %d\0" % len(content) + content, usedforsecurity=False).hexdigest()


def dependencies(root: Path, patterns: Iterable[str]) -> dict[str, str]:
    """The blob ids of the files that the patterns match below `root`, by path from there.

    Raises `ValueError` for a pattern that matches none: otherwise a change of that file would not be detected.
    """
    files: dict[str, str] = {}
    for pattern in patterns:
        paths = [path for path in root.glob(pattern) if path.is_file() and "__pycache__" not in path.parts]
        if not paths:
            raise ValueError(
                f"depends: {pattern!r} matches no file in {root}; correct it or take it out of the recipe."
            )
        files |= {path.relative_to(root).as_posix(): blob_id(path.read_bytes()) for path in paths}
    return dict(sorted(files.items()))


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Why a table is stale: each file with another blob id, and each added or removed file."""
    words = {(True, True): "changed", (True, False): "removed", (False, True): "added"}
    return [
        f"{path} ({words[path in before, path in now]})"
        for path in sorted({*before, *now})
        if before.get(path) != now.get(path)
    ]


def revision(root: Path, files: Mapping[str, str]) -> dict[str, Any]:
    """The current Git commit, and which of the files differ from it (None outside of a repository).

    Other files are ignored, so that a table written before does not count as a change.
    """
    commit = _git(root, "rev-parse", "HEAD")
    listed = None if commit is None else _git(root, "ls-tree", "-r", "-z", "--full-tree", "HEAD")
    if commit is None or listed is None:
        return {"commit": None, "dirty": None, "modified": []}
    lines = (line.partition("\t") for line in listed.split("\0") if line)
    committed = {path: about.split()[2] for about, _, path in lines}
    modified = [path for path, content in files.items() if committed.get(path) != content]
    return {"commit": commit.strip(), "dirty": bool(modified), "modified": modified}


def _git(root: Path, *words: str) -> str | None:
    """The output of a Git command; None without Git or a repository."""
    try:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None
