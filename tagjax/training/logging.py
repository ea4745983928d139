"""Logged metrics of a training run: metrics.jsonl always, Weights & Biases if enabled.

A run is complete without Weights & Biases, and none of its errors ends a run.
"""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import secrets
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from ..core.files import make_folder, write_atomic, writing
from .processes import is_first

_FINISH_S = 600.0
"""Time limit of wandb's upload at the end; what is not uploaded stays in the run folder for `wandb sync`."""


@dataclasses.dataclass(frozen=True)
class LoggerSettings:
    """`mode` of Weights & Biases: offline writes into the run folder only; WANDB_MODE in the environment wins."""

    mode: Literal["disabled", "offline", "online"] = "offline"
    project: str = "tagjax"
    name: str | None = None


class MetricsFile:
    """Appends one JSON object per line. Lines of steps that a resumed run repeats are dropped first."""

    def __init__(self, path: Path, *, resume_step: int = 0):
        self.path = path
        make_folder(path.parent)
        if path.exists():
            kept = [line for line in path.read_text(encoding="utf-8").splitlines() if _line_step(line) <= resume_step]
            write_atomic(path, "".join(f"{line}\n" for line in kept))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        with writing(self.path), self.path.open("a", encoding="utf-8") as file:
            # JSON has no NaN; null stands for it.
            finite = {
                name: value if value == value and abs(value) != float("inf") else None for name, value in values.items()
            }
            file.write(json.dumps({"step": step, **finite}) + "\n")


def _line_step(line: str) -> float:
    """The step of a line; infinite for an incomplete line, so that it is dropped."""
    try:
        return float(json.loads(line)["step"])
    except (ValueError, KeyError, TypeError):
        return float("inf")


class Logger:
    """metrics.jsonl, and a Weights & Biases run that never asks for a login. Only the first process writes."""

    def __init__(
        self, folder: Path, settings: LoggerSettings, *, config: Mapping[str, Any] | None = None, resume_step: int = 0
    ):
        self._file, self._run = None, None
        if is_first():
            self._file = MetricsFile(folder / "metrics.jsonl", resume_step=resume_step)
            self._run = _open_wandb(folder, settings, config or {}, resumed=resume_step > 0)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        if self._file is not None:
            self._file.write(step, values)
        if self._run is not None:
            with self._errors_as_warnings("a step's numbers"):
                self._run.log(dict(values), step=step)

    def report(self, folder: Path, scores: Mapping[str, float], *, tracer: str) -> None:
        """Final scores, the report's curves, and overlay pictures of one tracer, which `folder` holds."""
        if self._run is not None:
            with self._errors_as_warnings("the report"):
                _report(self._run, folder, scores, tracer)

    def close(self) -> None:
        if self._run is not None:
            with self._errors_as_warnings("the end of the run"):
                self._run.finish()

    @contextmanager
    def _errors_as_warnings(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # of many types: wandb's own, and those of its service process
            warnings.warn(f"Weights & Biases could not log {what}: {_one_line(error)} The run continues.", stacklevel=4)


def _report(run: Any, folder: Path, scores: Mapping[str, float], tracer: str) -> None:
    run.summary.update({name: value for name, value in scores.items() if value is not None})
    if importlib.util.find_spec("PIL") is None:
        warnings.warn("Pillow is not installed: Weights & Biases gets no pictures.", stacklevel=2)
        return
    import wandb

    groups: dict[str, list[Path]] = {"curves": sorted((folder / "curves").glob("*.png"))}
    for overlays in sorted((folder / "overlays").glob(f"*/{tracer}")):
        groups[f"overlays/{overlays.parent.name}"] = sorted(overlays.glob("*.png"))
    pictures = {
        f"report/{name}": [wandb.Image(str(path), caption=path.stem) for path in paths]
        for name, paths in groups.items()
        if paths
    }
    if pictures:
        run.log(pictures)


def _one_line(error: Exception) -> str:
    """An error in one line that ends in a full stop."""
    lines = f"{type(error).__name__}: {error}".strip().splitlines()
    return lines[0].rstrip(":. ") + "."


def _run_id(folder: Path, resumed: bool) -> str:
    """The run's id in wandb, kept in its folder, so that a resumed run stays one run, also when uploaded later."""
    path = folder / "wandb_id"
    if not (resumed and path.exists()):
        write_atomic(path, secrets.token_hex(4) + "\n")
    return path.read_text(encoding="utf-8").strip()


def _open_wandb(folder: Path, settings: LoggerSettings, config: Mapping[str, Any], *, resumed: bool) -> Any:
    mode = os.environ.get("WANDB_MODE", settings.mode)
    if mode not in ("disabled", "offline", "online"):
        raise ValueError(f"Weights & Biases: found mode {mode!r}; expected disabled, offline or online.")
    if mode == "disabled":
        return None
    try:
        import wandb
    except ImportError:
        warnings.warn("wandb is not installed: only metrics.jsonl is written.", stacklevel=3)
        return None
    run_id = _run_id(folder, resumed)
    quiet: dict[str, Any] = {"silent": True, "console": "off", "x_disable_stats": True}
    quiet |= {"disable_git": True, "disable_code": True}
    if "finish_timeout" in wandb.Settings.model_fields:  # in newer releases only
        quiet["finish_timeout"] = _FINISH_S

    def start(mode: Literal["offline", "online"]) -> Any:
        return wandb.init(
            project=settings.project,
            name=settings.name or folder.name,
            id=run_id,
            resume="allow" if mode == "online" else None,  # offline mode cannot look the run up
            dir=str(folder),
            mode=mode,
            config=dict(config),
            settings=wandb.Settings(**quiet),
        )

    try:
        if mode == "online":
            # Without a key the online mode would stop and ask for one.
            if wandb.api.api_key:
                return start("online")
            warnings.warn("No Weights & Biases key: logging offline. Upload later with `wandb sync`.", stacklevel=3)
    except Exception as error:  # wandb's errors are of many types
        warnings.warn(
            f"Weights & Biases cannot be reached: {_one_line(error)} Logging offline; upload later with `wandb sync`.",
            stacklevel=3,
        )
        with suppress(Exception):
            wandb.teardown()  # its service process still holds the id as in use
    try:
        return start("offline")
    except Exception as error:
        warnings.warn(f"Weights & Biases cannot start: {_one_line(error)} Only metrics.jsonl is written.", stacklevel=3)
        return None
