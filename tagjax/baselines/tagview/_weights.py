"""Weights of the detector as plain arrays: one .npz file, with the recipe that made them as JSON text in it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax

from ...arrays_file import ArraysFile
from ._network import BoxNetwork

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
    try:
        settings = {"widths": tuple(about["network"]["widths"]), "depth": int(about["network"]["depth"])}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: does not say which network it is of ({type(error).__name__}: {error}).") from error
    network = eqx.filter_eval_shape(lambda: BoxNetwork(**settings, key=jax.random.key(0)))
    return _FILE.fill(network, path), about
