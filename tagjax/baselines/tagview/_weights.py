"""Weights of the detector as plain arrays: one .npz file, with the recipe that made them as JSON text in it."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ._network import BoxNetwork

PACKAGED = Path(__file__).parent / "detector.npz"
"""The weights that come with the package."""

_ABOUT = "about"
_FORMAT = "tagjax-tagview-detector-1"


def save_detector(path: str | Path, network: BoxNetwork, about: Mapping[str, Any]) -> None:
    """Write a network in half precision; `about` holds `network` (its settings), and recipe and scores as one likes."""
    if not isinstance(about.get("network"), Mapping):
        raise ValueError(f"about holds {sorted(about)}; expected `network`, the settings that build it.")
    text = json.dumps({**about, "format": _FORMAT}, sort_keys=True)
    arrays: dict[str, Any] = {name: np.asarray(leaf, np.float16) for name, leaf in _named(network).items()}
    if not all(np.all(np.isfinite(array)) for array in arrays.values()):
        raise ValueError(f"{path}: weights are not finite (in half precision); such a detector is of no use.")
    held = io.BytesIO()
    np.savez_compressed(held, **{_ABOUT: np.frombuffer(text.encode(), np.uint8)}, **arrays)
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_bytes(held.getvalue())


def load_detector(path: str | Path | None = None) -> tuple[BoxNetwork, dict[str, Any]]:
    """The network of a file (the packaged one if None), and what the file says of itself.

    Nothing in a file is executed. Raises `ValueError` for one that is missing, damaged or foreign.
    """
    path = PACKAGED if path is None else Path(path)
    try:
        with np.load(path, allow_pickle=False) as archive:
            about = json.loads(bytes(archive[_ABOUT]).decode())
            arrays = {name: archive[name] for name in archive.files if name != _ABOUT}
        if about.get("format") != _FORMAT:
            raise ValueError(f"format {about.get('format')!r}")
        settings = {"widths": tuple(about["network"]["widths"]), "depth": int(about["network"]["depth"])}
    except (OSError, EOFError, KeyError, TypeError, AttributeError, ValueError, zipfile.BadZipFile) as error:
        raise ValueError(
            f"{path}: no weights of a Tagview detector ({type(error).__name__}: {error}); expected a file of "
            "`python -m experiments.tagview command=train`."
        ) from error
    network = eqx.filter_eval_shape(lambda: BoxNetwork(**settings, key=jax.random.key(0)))
    named = _named(network)
    wrong = [name for name in named if name not in arrays or arrays[name].shape != tuple(named[name].shape)]
    if wrong or set(arrays) != set(named):
        raise ValueError(f"{path}: arrays do not fit the settings {settings} ({', '.join(wrong) or 'surplus ones'}).")
    if not all(arrays[name].dtype.kind == "f" and np.all(np.isfinite(arrays[name])) for name in named):
        raise ValueError(f"{path}: holds values that are not finite numbers. Train again.")
    leaves = [jnp.asarray(arrays[name], jnp.float32) for name in named]
    return jax.tree.unflatten(jax.tree.structure(network), leaves), about


def _named(network: BoxNetwork) -> dict[str, Any]:
    leaves = jax.tree_util.tree_flatten_with_path(network)[0]
    return {jax.tree_util.keystr(place, simple=True, separator="."): leaf for place, leaf in leaves}
