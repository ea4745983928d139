"""The files that determine a table, their revision, and whether they have changed since."""

from __future__ import annotations

import ast
import hashlib
import io
import json
import subprocess
import tokenize
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import yaml


def content_id(path: Path) -> str:
    """SHA-1 of a file. Of Python without comments, docstrings and empty lines, and of what YAML says: figures follow from no prose."""
    content = path.read_bytes()
    if path.suffix == ".py":
        content = _code(content.decode()).encode()
    elif path.suffix == ".yaml":
        content = json.dumps(yaml.safe_load(content), default=str).encode()
    return hashlib.sha1(content, usedforsecurity=False).hexdigest()


def _code(source: str) -> str:
    """The lines of Python that hold code, without comments. The same under every version of Python."""
    lines = source.splitlines()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            row, column = token.start
            lines[row - 1] = lines[row - 1][:column]
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            last = node.end_lineno or node.lineno
            lines[node.lineno - 1 : last] = [""] * (last - node.lineno + 1)
    return "\n".join(line.rstrip() for line in lines if line.strip())


def dependencies(root: Path, patterns: Iterable[str]) -> dict[str, str]:
    """The ids (`content_id`) of the files that the patterns match below `root`, by path from there.

    Raises `ValueError` for a pattern that matches none: otherwise a change of that file would not be detected.
    """
    files: dict[str, str] = {}
    for pattern in patterns:
        paths = [path for path in root.glob(pattern) if path.is_file() and "__pycache__" not in path.parts]
        if not paths:
            raise ValueError(
                f"depends: {pattern!r} matches no file in {root}; correct it or take it out of the recipe."
            )
        files |= {path.relative_to(root).as_posix(): content_id(path) for path in paths}
    return dict(sorted(files.items()))


def changes(before: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Why a table is stale: each file with another id, and each added or removed file."""
    words = {(True, True): "changed", (True, False): "removed", (False, True): "added"}
    return [
        f"{path} ({words[path in before, path in now]})"
        for path in sorted({*before, *now})
        if before.get(path) != now.get(path)
    ]


def revision(root: Path, files: Iterable[str]) -> dict[str, Any]:
    """The current Git commit, and which of the files (paths from `root`) differ from it (None outside of a repository).

    Other files are ignored, so that a table written before does not count as a change.
    """
    commit = _git(root, "rev-parse", "HEAD")
    changed = _git(root, "diff", "--name-only", "--relative", "-z", "HEAD")
    tracked = _git(root, "ls-files", "-z")
    if commit is None or changed is None or tracked is None:
        return {"commit": None, "dirty": None, "modified": []}
    asked = {*files}
    modified = sorted(asked.intersection(changed.split("\0")) | asked.difference(tracked.split("\0")))
    return {"commit": commit.strip(), "dirty": bool(modified), "modified": modified}


def _git(root: Path, *words: str) -> str | None:
    """The output of a Git command; None without Git or a repository."""
    try:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None
