"""The configuration in a run's folder: what it was begun with is what it goes on with."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

_FREE = (
    "loop",
    "logger",
    "distributed",
    "resume",
    "retune",
    "scores",
    "baselines",
    "baseline_estimators",
    "matmul_precision",
)
_FREE_ENDS = ("workers", "decay_steps")  # the latter follows loop.num_steps
_RETUNED = ("clip_norm", "optimizer", "joint.clip_norm", "joint.optimizer")


def keep_configuration(folder: Path, values: Mapping[str, Any]) -> None:
    """Write `config.yaml`, where the run is new or goes on as it was configured.

    Length, logs, scores and processes may change when a run goes on, with `retune` the optimiser's numbers as well (not its
    kind, whose state would have another shape). Raises `ValueError`, naming what differs, where anything else does, and
    leaves the file as it was; also where the run may not go on, which the run itself refuses.
    """
    path = folder / "config.yaml"
    if checkpoint_steps(folder) and path.is_file():
        if not values.get("resume", True):
            return
        before = OmegaConf.to_container(OmegaConf.load(path), resolve=True)
        differ = _differences(before, dict(values), retune=bool(values.get("retune", False)))
        if differ:
            raise ValueError(
                f"{folder} holds a run that was configured otherwise: {'; '.join(differ)}. Give the same settings to go on "
                "with it (retune=true lets clip_norm and numbers of the optimiser change), or another folder."
            )
    beside = path.with_name(f".{path.name}.{os.getpid()}")
    OmegaConf.save(OmegaConf.create(dict(values)), beside)
    os.replace(beside, path)


def checkpoint_steps(folder: Path) -> list[int]:
    """The steps after which a run has checkpoints, without a look into them."""
    return [int(path.name) for path in (folder / "checkpoints").glob("*") if path.name.isdigit()]


def _differences(before: Any, now: Any, where: str = "", *, retune: bool) -> list[str]:
    if where in _FREE or where.rpartition(".")[2] in _FREE_ENDS:
        return []
    retuned = retune and any(where == name or where.startswith(f"{name}.") for name in _RETUNED)
    if retuned and all(isinstance(value, int | float) for value in (before, now)):
        return []
    if isinstance(before, dict) and isinstance(now, dict):
        names = [*now, *(name for name in before if name not in now)]
        return [
            text
            for name in names
            for text in _differences(before.get(name), now.get(name), f"{where}.{name}".lstrip("."), retune=retune)
        ]
    return [] if before == now else [f"{where} was {before!r} and is {now!r}"]
