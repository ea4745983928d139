"""Learned tracer parameters as plain numbers: one JSON file with the settings they began from and the recipe.

Nothing in a file is executed: it names numbers, which take the place of parameters that the tracer has already.
"""

from __future__ import annotations

import dataclasses
import inspect
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from . import TagAttention

PACKAGED = Path(__file__).parent / "weights"
"""Where the parameters that come with the package lie, as <name>.json."""

_FORMAT = "tagjax-tracer-parameters"
_VERSION = 1
_LONGEST_TEXT = 1_000_000


def packaged_parameters() -> tuple[str, ...]:
    """Names of the parameters that come with the package."""
    return tuple(sorted(path.stem for path in PACKAGED.glob("*.json")))


def save_parameters(
    path: str | Path, tracer: TagAttention, settings: Mapping[str, Any], about: Mapping[str, Any] | None = None
) -> None:
    """Write a tracer's parameters in physical units.

    `settings` are those that the tracer was built with, as under conf/tracer; `about` is the writer's: recipe, seed,
    data, scores.
    """
    path = Path(path)
    content = {
        "format": _FORMAT,
        "version": _VERSION,
        "settings": dict(settings),
        "parameters": tracer.physical(),
        "about": dict(about or {}),
    }
    beside = path.with_name(path.name + ".part")
    beside.write_text(json.dumps(content, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    os.replace(beside, path)


def load_parameters(tracer: TagAttention, source: str | Path, settings: Mapping[str, Any]) -> TagAttention:
    """The tracer with learned parameters in place of its own.

    `source` is a file of `save_parameters`, the name of packaged parameters, or `default`: those that were learned from
    these very `settings` (of several packaged ones all but one say `"default": false`, and are given by name). Raises `ValueError` where there are none, for a file that is damaged, foreign, or of
    another tracer, and where `settings` ask for other initial values than it was learned from; of a parameter that did
    not move in learning any value may be asked for.
    """
    path = _default_for(settings) if str(source) == "default" else _find(source)
    content = _read(path)
    learned = dict(content["parameters"])
    for name, default in _learnable(tracer).items():
        began, asked = (given.get(name, default) for given in (content["settings"], settings))
        if asked != began and name in _unmoved(content):
            learned[name] = asked
        elif asked != began:
            raise ValueError(
                f"{path}: learned from {name}={began!r}, and what was learned takes its place, but {name}={asked!r} is "
                f"asked for: leave {name} as it was, or weights= out."
            )
    try:
        return tracer.with_physical(learned)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _unmoved(content: Mapping[str, Any]) -> set[str]:
    """Parameters of a file that are what learning began from."""
    began = content["settings"]
    return {name for name, value in content["parameters"].items() if name in began and value == began[name]}


def _learnable(tracer: TagAttention) -> dict[str, Any]:
    """The arguments that a tracer learns, which are not static, with their defaults."""
    static = {field.name for field in dataclasses.fields(tracer) if field.metadata.get("static", False)}
    arguments = inspect.signature(type(tracer)).parameters.values()
    return {argument.name: argument.default for argument in arguments if argument.name not in static}


def _find(source: str | Path) -> Path:
    if str(source) in packaged_parameters():
        return PACKAGED / f"{source}.json"
    if str(source).endswith(".json") and Path(source).is_file():
        return Path(source)
    there = ", ".join(packaged_parameters()) or "none"
    raise ValueError(
        f"No learned parameters at {str(source)!r}; expected the path of a .json file (a run folder's weights.json), "
        f"`default`, or the name of packaged ones ({there})."
    )


def _default_for(settings: Mapping[str, Any]) -> Path:
    for name in packaged_parameters():
        path = PACKAGED / f"{name}.json"
        content = _read(path)
        free = _unmoved(content)
        began, asked = ({k: v for k, v in one.items() if k not in free} for one in (content["settings"], settings))
        if content.get("default", True) and began == asked:
            return path
    there = ", ".join(packaged_parameters()) or "none"
    raise ValueError(
        f"No packaged parameters were learned from these settings of {settings.get('_target_')} (there are: {there}). "
        "Leave the settings as they come, or give the name or a file."
    )


def _read(path: Path) -> dict[str, Any]:
    try:
        if path.stat().st_size > _LONGEST_TEXT:
            raise ValueError(f"{path.stat().st_size} bytes")
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ValueError(f"{path}: no learned parameters ({type(error).__name__}: {error}).") from error
    if not isinstance(content, dict) or content.get("format") != _FORMAT:
        raise ValueError(f"{path}: JSON, but no learned parameters ({_FORMAT}).")
    if content.get("version") != _VERSION:
        raise ValueError(f"{path}: version {content.get('version')!r}; this release reads {_VERSION}. Train again.")
    numbers = content.get("parameters")
    if not isinstance(numbers, dict) or not isinstance(content.get("settings"), dict):
        raise ValueError(f"{path}: holds no parameters or no settings. Copy the file again.")
    wrong = [name for name, value in numbers.items() if not _is_number(value)]
    if wrong:
        raise ValueError(f"{path}: {', '.join(wrong)}: not a finite number. Train again.")
    return content


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
