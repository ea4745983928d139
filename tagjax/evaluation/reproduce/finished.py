"""What has been measured already, in files by the hash of what determines it, with which an interrupted command resumes."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

from ...core.results import write_json

T = TypeVar("T")


def hash_of(values: Mapping[str, Any]) -> str:
    """A hash of plain values, whatever the order of their names."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:24]


def stored(folder: Path, follows_from: Mapping[str, Any], read: Callable[[Any], T]) -> T | None:
    """What was stored for this, as `read` makes it of JSON; None where there is nothing or the file is damaged."""
    try:
        content = json.loads(_path(folder, follows_from).read_text(encoding="utf-8"))
        return read(content["result"]) if content["follows_from"] == follows_from else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def store(folder: Path, follows_from: Mapping[str, Any], result: Any) -> None:
    """Store a result as JSON."""
    write_json(_path(folder, follows_from), {"follows_from": follows_from, "result": result})


def _path(folder: Path, follows_from: Mapping[str, Any]) -> Path:
    return folder / f"{hash_of(follows_from)}.json"
