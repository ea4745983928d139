"""Where numbers go while training: metrics.jsonl always, Weights & Biases if asked for."""

from __future__ import annotations

import dataclasses
import importlib.util
import json
import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from .processes import is_first


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
            beside = path.with_name(path.name + ".part")
            beside.write_text("".join(f"{line}\n" for line in kept), encoding="utf-8")
            os.replace(beside, path)

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
            self._run = _open_wandb(folder, settings, config or {})

    def write(self, step: int, values: Mapping[str, float]) -> None:
        if self._file is not None:
            self._file.write(step, values)
        if self._run is not None:
            self._run.log(dict(values), step=step)

    def report(self, folder: Path, scores: Mapping[str, float], *, tracer: str) -> None:
        """Final scores, the report's curves, and overlay pictures of one tracer; they lie in `folder` in any case."""
        if self._run is None:
            return
        self._run.summary.update({name: value for name, value in scores.items() if value is not None})
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
            self._run.log(pictures)

    def close(self) -> None:
        if self._run is not None:
            self._run.finish()


def _open_wandb(folder: Path, settings: LoggerSettings, config: Mapping[str, Any]) -> Any:
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
    if mode == "online" and not wandb.api.api_key:
        # Without a key the online mode would stop and ask for one.
        warnings.warn("No Weights & Biases key: logging offline. Upload later with `wandb sync`.", stacklevel=3)
        mode = "offline"
    return wandb.init(
        project=settings.project,
        name=settings.name or folder.name,
        dir=str(folder),
        mode=mode,
        config=dict(config),
        settings=wandb.Settings(silent=True, console="off", x_disable_stats=True, disable_git=True, disable_code=True),
    )
