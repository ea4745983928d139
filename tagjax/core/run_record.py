"""How a run was made: its command, the versions of what it ran with, the machine and the date."""

from __future__ import annotations

import datetime
import importlib.metadata
import json
import platform
import subprocess
from pathlib import Path
from typing import Any

from .machine import machine
from .results import write_json

RUN_RECORD = "run.json"
"""File name, in the run folder."""

_PACKAGES = ("tagjax", "jax", "jaxlib", "equinox", "numpy", "optax", "opencv-python-headless")


def write_run_record(folder: Path, command: str) -> None:
    """Write `run.json`: the command, the date, versions, the Git revision where there is one, and the machine."""
    record = {
        "command": command,
        "date_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        "revision": _revision(),
        "machine": machine(),
    }
    write_json(folder / RUN_RECORD, record)


def read_run_record(folder: Path) -> dict[str, Any]:
    """The content of `run.json`; empty where there is none. Raises `ValueError` for a file that is no JSON object."""
    path = folder / RUN_RECORD
    if not path.is_file():
        return {}
    try:
        record = json.loads(path.read_bytes())
    except ValueError as error:
        raise ValueError(f"{path}: found {error}; expected JSON as the commands write it. Remove the file.") from error
    if not isinstance(record, dict):
        raise ValueError(f"{path}: found {type(record).__name__}; expected a JSON object. Remove the file.")
    return record


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _revision() -> str | None:
    """The Git commit of the code, with `+` where tracked files differ from it; None for an installed package."""
    root = Path(__file__).resolve().parents[2]
    commit = _git(root, "rev-parse", "HEAD") if (root / ".git").exists() else None
    if commit is None:
        return None
    return commit.strip() + ("+" if _git(root, "status", "--porcelain", "--untracked-files=no") else "")


def _git(root: Path, *words: str) -> str | None:
    """The output of a Git command; None without Git."""
    try:
        done = subprocess.run(["git", "-C", str(root), *words], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return None
    return done.stdout if done.returncode == 0 else None
