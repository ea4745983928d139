"""Weights of the detector as plain arrays: one .npz file, with the recipe that made them as JSON text in it."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from ...core.arrays_file import ArraysFile
from ._network import BoxNetwork

_WIDEST, _DEEPEST = 1024, 32

PACKAGED = Path(__file__).parent / "detector.npz"
"""The weights that come with the package."""

_FILE = ArraysFile(
    "tagjax-tagview-detector", 2, "weights of a Tagview detector", "python -m experiments.tagview command=train"
)


def save_detector(path: str | Path, network: BoxNetwork, about: Mapping[str, Any]) -> None:
    """Write a network in half precision; `about` holds `network` (its settings), and recipe and scores as one likes."""
    if not isinstance(about.get("network"), Mapping):
        raise ValueError(f"about holds {sorted(about)}; expected `network`, the settings that build it.")
    _FILE.write(path, network, about, half=True)


def load_detector(path: str | Path | None = None) -> tuple[BoxNetwork, dict[str, Any]]:
    """The network of a file (the packaged one if None), and what the file says of itself.

    Nothing in a file is executed. Raises `ValueError` for one that is missing, damaged or foreign.
    """
    path = PACKAGED if path is None else Path(path)
    about = _FILE.about(path)
    said: Any = about.get("network")
    said = said if isinstance(said, Mapping) else {}
    widths, depth = said.get("widths"), said.get("depth")
    told = isinstance(widths, list) and len(widths) == 3 and all(_within(width, _WIDEST) for width in widths)
    if not told or not _within(depth, _DEEPEST):
        found = ", ".join(f"{key}: {reprlib.repr(value)}" for key, value in (("widths", widths), ("depth", depth)))
        raise ValueError(
            f"{path}: does not say which network it is of (found {found}; expected 3 whole widths of 1 to {_WIDEST} and a "
            f"depth of 1 to {_DEEPEST}). Train again, or copy the file again."
        )
    network = eqx.filter_eval_shape(lambda: BoxNetwork((widths[0], widths[1], widths[2]), depth, key=jax.random.key(0)))
    return _FILE.fill(network, path), about


def _within(value: Any, most: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= most
