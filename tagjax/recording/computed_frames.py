"""Frames that are decoded or computed when they are indexed."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class ComputedFrames:
    """Frames that are computed when indexed; usable as an array of a Recording."""

    def __init__(self, shape: tuple[int, ...], dtype: Any, compute: Callable[[int], np.ndarray]):
        self.shape, self.dtype, self._compute = shape, np.dtype(dtype), compute

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def __getitem__(self, index: Any, /) -> np.ndarray:
        if isinstance(index, slice):
            frames = [self._compute(frame) for frame in range(*index.indices(len(self)))]
            return np.stack(frames) if frames else np.empty((0, *self.shape[1:]), self.dtype)
        frame = int(index)
        if not -len(self) <= frame < len(self):
            raise IndexError(f"Frame {frame} of {len(self)}.")
        return self._compute(frame % len(self))
