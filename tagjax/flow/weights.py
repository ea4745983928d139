"""Weights of flow networks as plain arrays: one .npz file with the settings and the recipe that made them, as text.

Nothing in a file is executed: arrays are read as numbers, and the only class that its settings can name is a flow
network of this package.
"""

from __future__ import annotations

import importlib
import inspect
import io
import json
import math
import os
import re
import uuid
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from .network import AbstractFlowNetwork

PACKAGED = Path(__file__).parent / "weights"
"""Where the weights that come with the package lie, as <name>.npz."""

_ABOUT = "about.json"
_FORMAT = "tagjax-flow-weights"
_VERSION = 1
_LONGEST_TEXT = 4_000_000
_TARGET = re.compile(r"tagjax\.flow\.([a-z][a-z0-9_]*)\.([A-Z]\w*)")
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}

Network = TypeVar("Network", bound=AbstractFlowNetwork)


def packaged_weights() -> tuple[str, ...]:
    """Names of the weights that come with the package."""
    return tuple(sorted(path.stem for path in PACKAGED.glob("*.npz")))


def find_weights(source: str | Path) -> Path:
    """The file of packaged weights of that name, or at that path. Raises `ValueError` where there is none."""
    packaged = PACKAGED / f"{source}.npz"
    if str(source) in packaged_weights():
        return packaged
    if str(source).endswith(".npz") and Path(source).is_file():
        return Path(source)
    there = ", ".join(packaged_weights()) or "none"
    raise ValueError(
        f"No weights at {str(source)!r}; expected the path of an .npz file, or the name of packaged weights ({there}). "
        "`python -m experiments.train_flow` makes some."
    )


def save_weights(
    path: str | Path, network: AbstractFlowNetwork, about: Mapping[str, Any], *, half: bool = False
) -> None:
    """Write a network's arrays, named by their place in it, with `about` as JSON; in half precision if `half`.

    `about["flow"]` are the settings that build the network: `_target_` and arguments, as under conf/flow. The rest is
    the writer's: recipe, seed, data, scores. The same content gives the same bytes. Raises `ValueError` for settings
    that build another network.
    """
    settings = about.get("flow")
    if not isinstance(settings, Mapping):
        raise ValueError(f"about holds {sorted(about)}; expected `flow`, the settings that build the network.")
    text = json.dumps({**about, "format": _FORMAT, "version": _VERSION}, indent=1, default=_plain)
    told = _outline(json.loads(text)["flow"], str(path))
    if jax.tree.structure(told) != jax.tree.structure(network) or _shapes(told) != _shapes(network):
        raise ValueError(f"{path}: the settings {dict(settings)} build another network than the one to be saved.")
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
    try:
        with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
            # A ZipInfo of its own: without one, the time of writing would be in the file.
            archive.writestr(zipfile.ZipInfo(_ABOUT), text, zipfile.ZIP_DEFLATED)
            for name, leaf in _named(network).items():
                array = np.asarray(leaf, np.float16 if half else np.float32)
                if not np.all(np.isfinite(array)):
                    raise ValueError(f"{path}: {name} is not finite (as {array.dtype}); such weights are of no use.")
                held = io.BytesIO()
                np.lib.format.write_array(held, array, allow_pickle=False)
                archive.writestr(zipfile.ZipInfo(f"{name}.npy"), held.getvalue(), zipfile.ZIP_DEFLATED)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def load_weights(network: Network, source: str | Path = "default") -> Network:
    """The network with the weights of a file, of packaged weights by name, or (`default`) of those packaged for it.

    Raises `ValueError` for a file that is missing, damaged or foreign, and for one whose arrays do not fit.
    """
    if str(source) == "default":
        source = _packaged_for(network)
    return _filled(network, find_weights(source))


def load_network(source: str | Path, **changes: Any) -> AbstractFlowNetwork:
    """The network that a file of weights describes, with these weights; errors as of `load_weights`.

    `changes` take the place of settings of the file that no weight depends on.
    """
    path = find_weights(source)
    return _filled(_outline({**weights_about(path)["flow"], **changes}, str(path)), path)


def weights_about(source: str | Path) -> dict[str, Any]:
    """What a file of weights says of itself: `flow` (settings), recipe, seed, data, scores."""
    path = find_weights(source)
    try:
        with zipfile.ZipFile(path) as archive:
            text = archive.read(_ABOUT) if archive.getinfo(_ABOUT).file_size <= _LONGEST_TEXT else b""
        about = json.loads(text)
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError, zlib.error) as error:
        raise ValueError(
            f"{path}: no weights of a flow network ({type(error).__name__}: {error}). Is it a file of experiments.train_flow, "
            "and whole?"
        ) from error
    if not isinstance(about, dict) or about.get("format") != _FORMAT or not isinstance(about.get("flow"), dict):
        raise ValueError(f"{path}: an archive, but no weights of a flow network ({_FORMAT}).")
    if about.get("version") != _VERSION:
        raise ValueError(f"{path}: version {about.get('version')!r}; this release reads {_VERSION}. Train again.")
    return about


def _packaged_for(network: AbstractFlowNetwork) -> Path:
    own = f"{type(network).__module__}.{type(network).__name__}"
    for name in packaged_weights():
        if weights_about(name)["flow"].get("_target_") == own:
            return PACKAGED / f"{name}.npz"
    there = ", ".join(packaged_weights()) or "none"
    raise ValueError(f"No weights are packaged for {own} (there are: {there}). Train it, or give a file of weights.")


def _named(network: Any) -> dict[str, Any]:
    """Arrays of a network by name: `encoders.0.1.weight`."""
    leaves = jax.tree_util.tree_flatten_with_path(network)[0]
    return {jax.tree_util.keystr(place, simple=True, separator="."): leaf for place, leaf in leaves}


def _shapes(network: Any) -> dict[str, tuple[int, ...]]:
    return {name: tuple(leaf.shape) for name, leaf in _named(network).items()}


def _plain(value: Any) -> Any:
    """NumPy's and JAX's numbers and arrays as JSON has them."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return value.tolist()
    raise ValueError(f"about holds {value!r} ({type(value).__name__}); expected numbers, texts, lists and mappings.")


def _outline(settings: Mapping[str, Any], where: str) -> AbstractFlowNetwork:
    """The network that settings build, with shapes in place of arrays: nothing of its size is allocated."""
    target = settings.get("_target_")
    named = _TARGET.fullmatch(target) if isinstance(target, str) else None
    network = None
    if named is not None and (Path(__file__).parent / f"{named[1]}.py").is_file():
        network = getattr(importlib.import_module(f"tagjax.flow.{named[1]}"), named[2], None)
    if not inspect.isclass(network) or not issubclass(network, AbstractFlowNetwork) or inspect.isabstract(network):
        raise ValueError(f"{where}: the settings name {target!r}; expected a network of tagjax.flow.")
    arguments = {str(key): value for key, value in settings.items() if key != "_target_"}
    try:
        return eqx.filter_eval_shape(lambda: network(**arguments))
    except (TypeError, ValueError, AttributeError) as error:
        raise ValueError(f"{where}: {target} does not take the settings {arguments}: {error}") from error


def _filled(network: Network, path: Path) -> Network:
    """The network with the arrays of a file in place of its own."""
    about = weights_about(path)
    leaves = _named(network)
    with zipfile.ZipFile(path) as archive:
        there = {name.removesuffix(".npy") for name in archive.namelist()} - {_ABOUT}
        if there != set(leaves):
            lacking, surplus = sorted(set(leaves) - there), sorted(there - set(leaves))
            raise ValueError(
                f"{path}: weights of {about['flow'].get('_target_')} do not fit this network: "
                f"{len(lacking)} arrays are missing ({', '.join(lacking[:3])}), {len(surplus)} are unknown "
                f"({', '.join(surplus[:3])}). Build the network that the file's settings describe."
            )
        arrays = [_array(archive, name, leaf, path) for name, leaf in leaves.items()]
    return jax.tree.unflatten(jax.tree.structure(network), arrays)


def _array(archive: zipfile.ZipFile, name: str, leaf: Any, path: Path) -> jax.Array:
    """One array, of the shape that the network has; its header is held against that before any number is read."""
    shape = tuple(leaf.shape)
    try:
        with archive.open(f"{name}.npy") as file:
            found, by_columns, dtype = _HEADERS[np.lib.format.read_magic(file)](file)
            fits = found == shape and dtype.kind == "f"
            size = math.prod(shape) * dtype.itemsize
            data = file.read(size + 1) if fits else b""
    except (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError, zlib.error) as error:
        raise ValueError(
            f"{path}: {name} cannot be read ({type(error).__name__}: {error}). Copy the file again."
        ) from error
    if not fits:
        raise ValueError(f"{path}: {name} is {dtype} of shape {found}; this network has floats of shape {shape}.")
    if len(data) != size:
        raise ValueError(f"{path}: {name} holds {len(data)} of {size} bytes or more. Copy the file again.")
    array = np.frombuffer(data, dtype).reshape(shape, order="F" if by_columns else "C")
    if not np.all(np.isfinite(array)):
        raise ValueError(f"{path}: {name} holds values that are not finite. Train again.")
    return jnp.asarray(array.astype(leaf.dtype))
