"""Where numbers go while training: metrics.jsonl always, Weights & Biases if asked for.

A run is whole without Weights & Biases: none of its errors ends one.
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

from ..core.files import write_atomic
from .processes import is_first

_FINISH_S = 600.0
"""At the end wandb may upload for so long; what is left lies in the run folder for `wandb sync`."""


@dataclasses.dataclass(frozen=True)
class LoggerSettings:
    """`mode` of Weights & Biases: offline writes into the run folder only; WANDB_MODE in the environment wins."""

    mode: Literal["disabled", "offline", "online"] = "offline"
    project: str = "tagjax"
    name: str | None = None


class MetricsFile:
    """Appends one JSON object a line. Lines of steps that a resumed run does again are dropped first."""

    def __init__(self, path: Path, *, resume_step: int = 0):
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists():
            kept = [line for line in path.read_text(encoding="utf-8").splitlines() if _step_of(line) <= resume_step]
            write_atomic(path, "".join(f"{line}\n" for line in kept))

    def write(self, step: int, values: Mapping[str, float]) -> None:
        with self.path.open("a", encoding="utf-8") as file:
            # NaN is no JSON; null is.
            finite = {
                name: value if value == value and abs(value) != float("inf") else None for name, value in values.items()
            }
            file.write(json.dumps({"step": step, **finite}) + "\n")


def _step_of(line: str) -> float:
    """Step of a line; infinite for one cut short by a kill, so that it is dropped."""
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
            self._run = _open_wandb(folder, settings, config or {}, going_on=resume_step > 0)

    def write(self, step: int, values: Mapping[str, float]) -> None:
        if self._file is not None:
            self._file.write(step, values)
        if self._run is not None:
            with self._unharmed("a step's numbers"):
                self._run.log(dict(values), step=step)

    def report(self, folder: Path, scores: Mapping[str, float], *, tracer: str) -> None:
        """Final scores, the report's curves, and overlay pictures of one tracer; they lie in `folder` in any case."""
        if self._run is not None:
            with self._unharmed("the report"):
                _report(self._run, folder, scores, tracer)

    def close(self) -> None:
        if self._run is not None:
            with self._unharmed("the end of the run"):
                self._run.finish()

    @contextmanager
    def _unharmed(self, what: str) -> Iterator[None]:
        try:
            yield
        except Exception as error:  # wandb's own, and those of the process that it talks to, are of many kinds
            warnings.warn(f"Weights & Biases did not take {what}: {_said(error)} The run goes on.", stacklevel=4)


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


def _said(error: Exception) -> str:
    """An error in one line that ends in a full stop."""
    lines = f"{type(error).__name__}: {error}".strip().splitlines()
    return lines[0].rstrip(":. ") + "."


def _run_id(folder: Path, going_on: bool) -> str:
    """What wandb knows the run by, kept in its folder: a run that is gone on with stays one run, also when uploaded later."""
    path = folder / "wandb_id"
    if not (going_on and path.exists()):
        path.write_text(secrets.token_hex(4) + "\n", encoding="utf-8")
    return path.read_text(encoding="utf-8").strip()


def _open_wandb(folder: Path, settings: LoggerSettings, config: Mapping[str, Any], *, going_on: bool) -> Any:
    mode = os.environ.get("WANDB_MODE", settings.mode)
    if mode not in ("disabled", "offline", "online"):
        raise ValueError(f"Weights & Biases mode {mode!r}; expected disabled, offline or online.")
    if mode == "disabled":
        return None
    try:
        import wandb
    except ImportError:
        warnings.warn("wandb is not installed: only metrics.jsonl is written.", stacklevel=3)
        return None
    named = _run_id(folder, going_on)
    quiet: dict[str, Any] = {"silent": True, "console": "off", "x_disable_stats": True}
    quiet |= {"disable_git": True, "disable_code": True}
    if "finish_timeout" in wandb.Settings.model_fields:  # of newer releases
        quiet["finish_timeout"] = _FINISH_S

    def begin(mode: Literal["offline", "online"]) -> Any:
        return wandb.init(
            project=settings.project,
            name=settings.name or folder.name,
            id=named,
            resume="allow" if mode == "online" else None,  # offline there is nothing to ask
            dir=str(folder),
            mode=mode,
            config=dict(config),
            settings=wandb.Settings(**quiet),
        )

    try:
        if mode == "online":
            # Without a key the online mode would stop and ask for one.
            if wandb.api.api_key:
                return begin("online")
            warnings.warn("No Weights & Biases key: logging offline. Upload later with `wandb sync`.", stacklevel=3)
    except Exception as error:  # wandb's own are of many kinds
        warnings.warn(
            f"Weights & Biases cannot be reached: {_said(error)} Logging offline; upload later with `wandb sync`.",
            stacklevel=3,
        )
        with suppress(Exception):
            wandb.teardown()  # its process holds the id as one in use
    try:
        return begin("offline")
    except Exception as error:
        warnings.warn(f"Weights & Biases does not begin: {_said(error)} Only metrics.jsonl is written.", stacklevel=3)
        return None
