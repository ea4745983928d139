"""Trees of arrays on disk as plain numbers: one .npz file, with a JSON text that says what they are and how they were made.

Nothing in a file is executed: arrays are read as numbers, each held against what is expected before a number is read.
"""

from __future__ import annotations

import dataclasses
import io
import json
import math
import os
import uuid
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

_ABOUT = "about.json"
_LONGEST_TEXT = 4_000_000
_HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
_DAMAGE = (zipfile.BadZipFile, KeyError, ValueError, OSError, EOFError, zlib.error)

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True)
class ArraysFile:
    """One kind of file: what stands in it, under which format and version, and which command makes some."""

    format: str
    version: int
    content: str  # "weights of a flow network"
    made_by: str  # "python -m experiments.train_flow"

    def write(self, path: str | Path, tree: Any, about: Mapping[str, Any], *, half: bool = False) -> None:
        """Write a tree's arrays, named by their place in it, with `about` as JSON; in half precision if `half`.

        The same content gives the same bytes; a file is there whole or not at all. Raises `ValueError` for numbers that
        are not finite.
        """
        text = json.dumps({**about, "format": self.format, "version": self.version}, indent=1, default=_plain)
        path = Path(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}.partial")
        try:
            with zipfile.ZipFile(partial, "w", zipfile.ZIP_DEFLATED) as archive:
                # A ZipInfo of its own: without one, the time of writing would be in the file.
                archive.writestr(zipfile.ZipInfo(_ABOUT), text, zipfile.ZIP_DEFLATED)
                for name, leaf in named_arrays(tree).items():
                    array = np.asarray(leaf, np.float16 if half else np.float32)
                    if not np.all(np.isfinite(array)):
                        raise ValueError(
                            f"{path}: {name} is not finite (as {array.dtype}); such weights are of no use."
                        )
                    held = io.BytesIO()
                    np.lib.format.write_array(held, array, allow_pickle=False)
                    archive.writestr(zipfile.ZipInfo(f"{name}.npy"), held.getvalue(), zipfile.ZIP_DEFLATED)
            os.replace(partial, path)
        finally:
            partial.unlink(missing_ok=True)

    def about(self, path: Path) -> dict[str, Any]:
        """What a file says of itself. Raises `ValueError` for one that is missing, damaged or foreign."""
        try:
            with zipfile.ZipFile(path) as archive:
                text = archive.read(_ABOUT) if archive.getinfo(_ABOUT).file_size <= _LONGEST_TEXT else b""
            about = json.loads(text)
        except _DAMAGE as error:
            raise ValueError(
                f"{path}: no {self.content} ({type(error).__name__}: {error}). Is it a file of `{self.made_by}`, and whole?"
            ) from error
        if not isinstance(about, dict) or about.get("format") != self.format:
            raise ValueError(f"{path}: an archive, but no {self.content} ({self.format}).")
        if about.get("version") != self.version:
            raise ValueError(
                f"{path}: version {about.get('version')!r}; this release reads {self.version}. Make it again: `{self.made_by}`."
            )
        return about

    def fill(self, tree: Tree, path: Path) -> Tree:
        """The tree with the arrays of a file in place of its own, in its types; of its own only shapes are read.

        Raises `ValueError` for a file whose arrays do not fit, are damaged, or not finite.
        """
        self.about(path)
        leaves = named_arrays(tree)
        with zipfile.ZipFile(path) as archive:
            there = {name.removesuffix(".npy") for name in archive.namelist()} - {_ABOUT}
            if there != set(leaves):
                lacking, surplus = sorted(set(leaves) - there), sorted(there - set(leaves))
                raise ValueError(
                    f"{path}: {self.content} that do not fit this one: "
                    f"{len(lacking)} arrays are missing ({', '.join(lacking[:3])}), {len(surplus)} are unknown "
                    f"({', '.join(surplus[:3])}). Build the network that the file's settings describe."
                )
            arrays = [_array(archive, name, leaf, path) for name, leaf in leaves.items()]
        return jax.tree.unflatten(jax.tree.structure(tree), arrays)


def named_arrays(tree: Any) -> dict[str, Any]:
    """Arrays of a tree by their place in it: `encoders.0.1.weight`."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(place, simple=True, separator="."): leaf for place, leaf in leaves}


def _array(archive: zipfile.ZipFile, name: str, leaf: Any, path: Path) -> jax.Array:
    """One array, of the shape that the tree has; its header is held against that before any number is read."""
    shape = tuple(leaf.shape)
    try:
        with archive.open(f"{name}.npy") as file:
            found, by_columns, dtype = _HEADERS[np.lib.format.read_magic(file)](file)
            fits = found == shape and dtype.kind == "f"
            size = math.prod(shape) * dtype.itemsize
            data = file.read(size + 1) if fits else b""
    except _DAMAGE as error:
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


def _plain(value: Any) -> Any:
    """NumPy's and JAX's numbers and arrays as JSON has them."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return value.tolist()
    raise ValueError(f"about holds {value!r} ({type(value).__name__}); expected numbers, texts, lists and mappings.")
