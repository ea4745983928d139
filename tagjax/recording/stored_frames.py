"""Arrays in a Zarr group, read frame by frame; a missing or damaged frame is an error that names it."""

from __future__ import annotations

from typing import Any

import numpy as np
import zarr
from zarr.codecs import ZstdCodec
from zarr.core.sync import collect_aiterator, sync

from ..core.errors import RecordingError

ZSTD_LEVEL = 3
"""Of the compression of all arrays."""


class StoredFrames:
    """A stored array, read when indexed. Raises `RecordingError` that names a frame which is missing or cannot be read."""

    def __init__(self, array: zarr.Array, location: str, name: str):
        self.array, self.name = array, name
        self._location = location
        self.shape: tuple[int, ...] = tuple(array.shape)
        self.dtype = np.dtype(array.dtype)

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[...], dtype)

    def __getitem__(self, index: Any, /) -> np.ndarray:
        try:
            values = np.asarray(self.array[index])
        except (IndexError, MemoryError):
            raise
        # Codecs, file system and network raise various errors; the message names the cause.
        except Exception as error:
            raise RecordingError(
                f"{self._location}: array {self.name!r}{self._unreadable(index)} cannot be read ({type(error).__name__}: "
                f"{error}); its file is damaged or not accessible. Copy the recording again, or check the connection."
            ) from error
        # Zarr reads a missing chunk as zeros, so the chunk of a frame of zeros must exist.
        frames = self._frames(index)
        if values.size:
            for frame, part in zip(frames, values.reshape(len(frames), -1), strict=True):
                if not part.any() and not self._present(frame // self.array.chunks[0]):
                    raise RecordingError(
                        f"{self._location}: array {self.name!r}, frame {frame} is missing; the recording is truncated. "
                        "Copy it again."
                    )
        return values

    def _frames(self, index: Any) -> list[int]:
        first = index[0] if isinstance(index, tuple) and index else index
        return np.atleast_1d(np.arange(len(self))[first]).tolist()

    def _unreadable(self, index: Any) -> str:
        """The first frame that cannot be read, as part of a message."""
        frames = self._frames(index)
        if self.array.nchunks == 1:
            return ""
        for frame in frames[:-1]:
            try:
                self.array[frame]
            except Exception:
                return f", frame {frame}"
        return f", frame {frames[-1]}"

    def _present(self, chunk: int) -> bool:
        key = self.array.metadata.encode_chunk_key((chunk, *(0 for _ in self.shape[1:])))
        try:
            return bool(sync((self.array.store_path / key).exists()))
        except Exception as error:
            raise RecordingError(
                f"{self._location}: array {self.name!r} is not accessible ({type(error).__name__}: {error}). Try again."
            ) from error


def num_chunks_present(array: zarr.Array) -> int:
    """How many of an array's chunks are stored. The time that Zarr's own count takes grows with the square of their number."""
    if array.shards is not None:
        return array.nchunks_initialized
    path = array.store_path.path
    stored = set(collect_aiterator(array.store_path.store.list_prefix(path)))
    start = f"{path}/" if path else ""
    return sum(f"{start}{array.metadata.encode_chunk_key(place)}" in stored for place in np.ndindex(array.cdata_shape))


def create_array(root: zarr.Group, name: str, shape: tuple[int, ...], dtype: Any, *, per_frame: bool) -> zarr.Array:
    """A new array in a group, with one chunk per frame or one for all. Compressed by zstd, with checksums."""
    chunks = (1, *shape[1:]) if per_frame else tuple(max(1, size) for size in shape)
    # Empty chunks are written too, so that a missing chunk is always a lost chunk.
    return root.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=dtype,
        compressors=[ZstdCodec(level=ZSTD_LEVEL, checksum=True)],
        config={"write_empty_chunks": True},
    )
