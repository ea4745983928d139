"""The pinhole camera."""

from __future__ import annotations

import dataclasses
import math
import numbers
from typing import Any

import numpy as np

from .errors import RecordingError

MAX_SIDE_PX = 16384
"""Longest side of an image that a recording may have."""

WORKING_WIDTH_PX = 256
"""Columns of the working resolution, about: as many pixels as the tracers' settings were found for."""

_NUM_COEFFICIENTS = (0, 4, 5, 8, 12, 14)


def working_stride(width: int, stride: int | None = None) -> int:
    """Every n-th pixel of pictures of this width is used: `stride`, or where it is None the n that leaves about 256 columns.

    512 and 640 pixels give 2, 1280 gives 5, 320 and fewer give 1. Raises `ValueError` for a stride below 1.
    """
    if stride is None:
        return max(1, round(width / WORKING_WIDTH_PX))
    if stride < 1:
        raise ValueError(f"stride is {stride}; expected at least 1 (every n-th pixel is kept).")
    return stride


def check_rotation(rotation: Any, where: str, meaning: str, *, max_skew: float) -> None:
    """Raise `RecordingError` for what is no rotation (3, 3), orthogonal within `max_skew`.

    The error names `where` it comes from, and `meaning`, what is expected.
    """
    matrix = np.asarray(rotation, float)
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        raise RecordingError(f"{where}: rotation is {matrix.tolist()}; expected 3 rows of 3 finite numbers.")
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > max_skew or np.linalg.det(matrix) < 0:
        raise RecordingError(f"{where}: rotation {matrix.tolist()} is no rotation; expected {meaning}.")


def _finite(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(float(value))


@dataclasses.dataclass(frozen=True)
class Intrinsics:
    """Pinhole camera: focal lengths and principal point in pixels; distortion in OpenCV's order (k1 k2 p1 p2 k3)."""

    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    width: int
    height: int
    distortion: tuple[float, ...] = ()

    def scaled(self, stride: int) -> Intrinsics:
        """Intrinsics of every `stride`-th pixel, the first kept: pixel i of the result is pixel i * stride."""
        return dataclasses.replace(
            self,
            fx_px=self.fx_px / stride,
            fy_px=self.fy_px / stride,
            cx_px=self.cx_px / stride,
            cy_px=self.cy_px / stride,
            width=-(-self.width // stride),
            height=-(-self.height // stride),
        )

    def matrix(self) -> np.ndarray:
        """The 3x3 camera matrix."""
        return np.array([[self.fx_px, 0, self.cx_px], [0, self.fy_px, self.cy_px], [0, 0, 1]], dtype=np.float64)

    def check(self) -> None:
        """Raise `RecordingError` for values that no camera has."""
        if not all(isinstance(side, numbers.Integral) and side > 0 for side in (self.width, self.height)):
            raise RecordingError(f"Intrinsics: {self.width} x {self.height}; expected positive integers.")
        for name in ("fx_px", "fy_px", "cx_px", "cy_px"):
            value = getattr(self, name)
            if not _finite(value) or (name in ("fx_px", "fy_px") and value <= 0):
                kind = "positive" if name in ("fx_px", "fy_px") else "finite"
                raise RecordingError(f"Intrinsics: {name} is {value!r}; expected a {kind} number of pixels.")
        longest = max(self.width, self.height)
        if longest > MAX_SIDE_PX:
            raise RecordingError(
                f"Intrinsics: {self.width} x {self.height}; expected at most {MAX_SIDE_PX} pixels a side."
            )
        for name in ("fx_px", "fy_px"):
            value = getattr(self, name)
            if not 0.1 * longest <= value <= 1000 * longest:
                raise RecordingError(
                    f"Intrinsics: {name} is {value:.4g} for images of {self.width} x {self.height}; expected pixels, 0.1 to 1000 "
                    "times the longer side. Millimetres, or intrinsics of another resolution, must be converted first."
                )
        if len(self.distortion) not in _NUM_COEFFICIENTS or not all(map(_finite, self.distortion)):
            raise RecordingError(
                f"Intrinsics: distortion is {self.distortion!r}; expected finite k1 k2 p1 p2 k3, in a number that OpenCV takes "
                f"({', '.join(map(str, _NUM_COEFFICIENTS))})."
            )
