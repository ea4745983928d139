"""The configuration in a run folder: how it is read, and that a run resumes only with the one that it was started with."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from .command import write_config

_MAX_BYTES = 64_000
_MAX_DEPTH = 32
"""Of the configurations of this package the largest has 7 kB and 5 levels."""

_MAY_DIFFER = (
    "loop",
    "logger",
    "distributed",
    "resume",
    "retune",
    "scores",
    "baselines",
    "matmul_precision",
)
_MAY_DIFFER_SUFFIXES = ("workers", "decay_steps")  # decay_steps follows loop.num_steps
_RETUNABLE = ("clip_norm", "optimizer", "joint.clip_norm", "joint.optimizer")


def check_configuration(folder: Path, values: Mapping[str, Any]) -> None:
    """Raise `ValueError`, naming the differences, if the folder holds a run that cannot resume with these values.

    A resumed run may have another length, logger, scores and processes. With `retune` it may also have other numbers of the
    optimiser, but no other kind, because its state would have another shape. With `resume=false` nothing is compared: the
    run itself then refuses to overwrite a checkpoint.
    """
    path = folder / "config.yaml"
    if not checkpoint_steps(folder) or not path.is_file() or not values.get("resume", True):
        return
    before = read_configuration(path)
    differences = _differences(before, dict(values), retune=bool(values.get("retune", False)))
    if differences:
        raise ValueError(
            f"{folder} holds a run with another configuration: {'; '.join(differences)}. Give the same settings to resume it "
            "(retune=true allows another clip_norm and other numbers of the optimiser), or another folder."
        )


def keep_configuration(folder: Path, values: Mapping[str, Any]) -> None:
    """Write `config.yaml` if the run is new, or resumes (`check_configuration`). The caller holds the folder's lock."""
    check_configuration(folder, values)
    if values.get("resume", True) or not checkpoint_steps(folder) or not (folder / "config.yaml").is_file():
        write_config(values, folder)


def read_configuration(path: Path) -> dict[str, Any]:
    """The plain values of a run folder's config.yaml, which may come from elsewhere: nothing in it is interpreted.

    Raises `ValueError` for a file that is missing, too large, too deeply nested or no YAML mapping, and for interpolations
    (`${...}`), YAML aliases and YAML tags (`!!set`), which the commands never write.
    """
    expected = "expected the config.yaml of a run folder, as `python -m experiments.train` writes it."
    try:
        with path.open("rb") as file:
            text = file.read(_MAX_BYTES + 1)
        if len(text) > _MAX_BYTES:
            raise ValueError(f"more than {_MAX_BYTES} bytes")
        _check_events(text)
        values = yaml.safe_load(text)
    # PyYAML raises whatever the conversion of a text raises: `0b_` as an integer, 2001-99-99 as a date.
    except (OSError, ArithmeticError, AttributeError, LookupError, TypeError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{path}: found {' '.join(str(error).split())}; {expected}") from error
    if not isinstance(values, dict) or not all(isinstance(key, str) for key in values):
        raise ValueError(f"{path}: found {type(values).__name__} that is no mapping of names; {expected}")
    return values


def _check_events(text: bytes) -> None:
    """Raise `ValueError` for what no command writes, as soon as it is met: the parser's time grows with the depth."""
    depth = 0
    for event in yaml.parse(text, Loader=yaml.CSafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError(f"the alias *{event.anchor}")
        if isinstance(event, yaml.ScalarEvent) and "${" in event.value:
            raise ValueError(f"the interpolation {event.value[:60]!r}")
        if isinstance(event, yaml.NodeEvent) and getattr(event, "tag", None) is not None:
            raise ValueError(f"the tag {event.tag[:60]!r}")  # type: ignore[attr-defined]
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _MAX_DEPTH:
            raise ValueError(f"more than {_MAX_DEPTH} levels")


def checkpoint_steps(folder: Path) -> list[int]:
    """The steps of a run's checkpoints, by the names of their folders."""
    return [int(path.name) for path in (folder / "checkpoints").glob("*") if path.name.isdigit()]


def _differences(before: Any, now: Any, where: str = "", *, retune: bool) -> list[str]:
    if where in _MAY_DIFFER or where.rpartition(".")[2] in _MAY_DIFFER_SUFFIXES:
        return []
    retuned = retune and any(where == name or where.startswith(f"{name}.") for name in _RETUNABLE)
    if retuned and all(isinstance(value, int | float) for value in (before, now)):
        return []
    if isinstance(before, dict) and isinstance(now, dict):
        names = [*now, *(name for name in before if name not in now)]
        return [
            text
            for name in names
            for text in _differences(before.get(name), now.get(name), f"{where}.{name}".lstrip("."), retune=retune)
        ]
    return [] if before == now else [f"{where} was {before!r} and is now {now!r}"]
