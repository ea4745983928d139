"""Weights of the detector as plain arrays: one safetensors file, with the settings of its training as JSON text in it."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from ...core.array_file import ArrayFile
from .network import BoxNetwork

_MAX_WIDTH, _MAX_DEPTH = 1024, 32

PACKAGED = Path(__file__).parent / "detector.safetensors"
"""The weights that come with the package."""

_FILE = ArrayFile(
    "tagjax-tagview-detector", 3, "weights of a Tagview detector", "python -m experiments.tagview command=train"
)


def save_weights(path: str | Path, network: BoxNetwork, about: Mapping[str, Any]) -> None:
    """Write a network in half precision; `about` holds `network` (its settings), and may hold training settings and
    scores.
    """
    if not isinstance(about.get("network"), Mapping):
        raise ValueError(f"about holds {sorted(about)}; expected `network`, the settings of the network.")
    _FILE.write(path, network, about, half=True)


def load_weights(path: str | Path | None = None) -> tuple[BoxNetwork, dict[str, Any]]:
    """The network of a file (the packaged one if None), and the file's `about`.

    Nothing in a file is executed. Raises `ValueError` for a file that is missing, damaged or of another kind.
    """
    path = PACKAGED if path is None else Path(path)
    about = _FILE.metadata(path)
    network: Any = about.get("network")
    network = network if isinstance(network, Mapping) else {}
    widths, depth = network.get("widths"), network.get("depth")
    complete = isinstance(widths, list) and len(widths) == 3 and all(_within(width, _MAX_WIDTH) for width in widths)
    if not complete or not _within(depth, _MAX_DEPTH):
        found = ", ".join(f"{key}: {reprlib.repr(value)}" for key, value in (("widths", widths), ("depth", depth)))
        raise ValueError(
            f"{path}: no valid settings of its network: found {found}; expected 3 integer widths of 1 to {_MAX_WIDTH} and a "
            f"depth of 1 to {_MAX_DEPTH}. Train again, or copy the file again."
        )
    empty = eqx.filter_eval_shape(lambda: BoxNetwork((widths[0], widths[1], widths[2]), depth, key=jax.random.key(0)))
    return _FILE.read(path, empty), about


def _within(value: Any, largest: int) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value <= largest
