"""PyTrees of arrays in safetensors files, with JSON metadata about the arrays and their origin.

Nothing in a file is executed. Names, shapes and dtypes are compared with the expected tree before any value is read. One
checksum covers arrays and metadata.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import reprlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from .files import write_atomic
from .json_text import json_checksum, parse_json

_METADATA = "tagjax"
"""The one entry of the header's metadata, a JSON text. Of several entries safetensors does not keep the order, and the
same content would not give the same bytes."""

_MAX_HEADER_BYTES = 4_000_000
_DTYPES = {"F16": "float16", "F32": "float32"}

Tree = TypeVar("Tree")


@dataclasses.dataclass(frozen=True)
class ArrayFile:
    """One kind of safetensors file: its format and version, its content, and the command that makes such files."""

    format: str
    version: int
    content: str  # "weights of a flow network"
    made_by: str  # "python -m experiments.train_flow"

    def write(self, path: str | Path, tree: Any, metadata: Mapping[str, Any], *, half: bool = False) -> None:
        """Write the arrays of a tree by name (`named_arrays`) as float32, or as float16 if `half`.

        `metadata` is stored as JSON. The same content gives the same bytes; the file appears whole or not at all.
        Raises `ValueError` for values that are not finite and for metadata that JSON does not have.
        """
        dtype = np.float16 if half else np.float32
        arrays = {name: np.ascontiguousarray(leaf, dtype) for name, leaf in named_arrays(tree).items()}
        for name, array in arrays.items():
            if not np.all(np.isfinite(array)):
                raise ValueError(
                    f"{path}: {name} is not finite (as {array.dtype}); expected finite values. Train again."
                )
        header = {**metadata, "format": self.format, "version": self.version}
        header = json.loads(json.dumps(header, default=_plain))
        text = json.dumps({**header, "sha256": _digest(arrays, header)}, indent=1)
        write_atomic(path, safetensors.numpy.save(arrays, {_METADATA: text}))

    def metadata(self, path: Path) -> dict[str, Any]:
        """The metadata of a file. Raises `ValueError` for a file that is missing, damaged or of another kind."""
        with self._open(path) as file:
            return self._metadata(file, path)

    def read(self, path: Path, like: Tree) -> Tree:
        """A tree like `like`, with the arrays of a file in the dtypes of `like`, of which only shapes are used.

        Raises `ValueError` for a file that is missing, damaged or of another kind, and for one whose arrays have other
        names, shapes or dtypes, are not finite (also in the dtypes of `like`) or do not have the checksum.
        """
        expected = named_arrays(like)
        with self._open(path) as file:
            metadata = self._metadata(file, path)
            found = set(file.keys())
            if found != set(expected):
                missing, unknown = sorted(set(expected) - found), sorted(found - set(expected))
                raise ValueError(
                    f"{path}: {self.content} that do not fit this network: "
                    f"{len(missing)} arrays are missing ({', '.join(missing[:3])}), {len(unknown)} are unknown "
                    f"({', '.join(unknown[:3])}). Build the network that the file's settings describe."
                )
            for name, leaf in expected.items():
                header, shape = file.get_slice(name), tuple(leaf.shape)
                dtype, found_shape = header.get_dtype(), tuple(header.get_shape())
                if dtype not in _DTYPES or found_shape != shape:
                    raise ValueError(
                        f"{path}: {name} is {_DTYPES.get(dtype, dtype)} of shape {found_shape}; this network has floats of "
                        f"shape {shape}. Build the network that the file's settings describe."
                    )
            arrays = {name: file.get_tensor(name) for name in expected}
        for name, array in arrays.items():
            if not np.all(np.isfinite(array)):
                raise ValueError(
                    f"{path}: {name} holds values that are not finite. Copy the file again, or train again."
                )
        if _digest(arrays, metadata) != metadata.get("sha256"):
            raise ValueError(
                f"{path}: arrays and metadata do not have the checksum of the header. Copy the file again."
            )
        with np.errstate(over="ignore"):
            leaves = [jnp.asarray(arrays[name].astype(leaf.dtype)) for name, leaf in expected.items()]
        for name, leaf in zip(expected, leaves, strict=True):
            if not bool(jnp.all(jnp.isfinite(leaf))):
                raise ValueError(f"{path}: {name} is not finite as {leaf.dtype}, this network's dtype. Train again.")
        return jax.tree.unflatten(jax.tree.structure(like), leaves)

    @contextlib.contextmanager
    def _open(self, path: Path) -> Iterator[Any]:
        """The file, its header read and checked against its size by safetensors."""
        try:
            with path.open("rb") as file:
                length = int.from_bytes(file.read(8), "little")
            if length > _MAX_HEADER_BYTES:
                raise ValueError(f"a header of {length} bytes; expected at most {_MAX_HEADER_BYTES}")
            file = safetensors.safe_open(path, framework="numpy")
        except (OSError, ValueError, safetensors.SafetensorError) as error:
            raise ValueError(
                f"{path}: no readable {self.content} ({type(error).__name__}: {error}); expected a whole safetensors file "
                f"of `{self.made_by}`. Copy the file again."
            ) from error
        with file as opened:
            yield opened

    def _metadata(self, file: Any, path: Path) -> dict[str, Any]:
        try:
            metadata = parse_json((file.metadata() or {})[_METADATA])
        except KeyError:
            metadata = None
        except ValueError as error:
            raise ValueError(
                f"{path}: the metadata of the header are no valid JSON ({error}). Copy the file again."
            ) from error
        if not isinstance(metadata, dict) or metadata.get("format") != self.format:
            raise ValueError(f"{path}: a safetensors file, but no {self.content} (format {self.format}).")
        if metadata.get("version") != self.version:
            raise ValueError(
                f"{path}: version {reprlib.repr(metadata.get('version'))}; this release reads version {self.version}. Make the file "
                f"again: `{self.made_by}`."
            )
        return metadata


def named_arrays(tree: Any) -> dict[str, Any]:
    """The arrays of a tree by their path in it: `encoders.0.1.weight`."""
    leaves = jax.tree_util.tree_flatten_with_path(tree)[0]
    return {jax.tree_util.keystr(path, simple=True, separator="."): leaf for path, leaf in leaves}


def _digest(arrays: Mapping[str, np.ndarray], metadata: Mapping[str, Any]) -> str:
    """SHA-256 of metadata, names and values: safetensors itself has no checksum."""
    described = json_checksum({name: value for name, value in metadata.items() if name != "sha256"})
    digest = hashlib.sha256(described.encode())
    for name in sorted(arrays):
        digest.update(name.encode() + np.ascontiguousarray(arrays[name]).tobytes())
    return digest.hexdigest()


def _plain(value: Any) -> Any:
    """NumPy's and JAX's numbers and arrays as JSON has them."""
    if isinstance(value, np.generic | np.ndarray | jax.Array):
        return value.tolist()
    raise ValueError(
        f"metadata holds {value!r} ({type(value).__name__}); expected numbers, strings, lists and mappings."
    )
