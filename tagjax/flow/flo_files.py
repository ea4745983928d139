"""Middlebury's .flo files: dense flow as little-endian float32 (Baker et al., IJCV 2011)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..core.files import write_atomic
from ..recording import RecordingError

_MAGIC = np.float32(202021.25)
_UNKNOWN_PX = 1e9
"""A component of this size or more marks a pixel of unknown flow."""

_UNKNOWN_VALUE_PX = np.float32(1e10)
_MAX_SIDE_PX = 99_999


def read_flo(path: str | Path) -> Float[np.ndarray, "height width 2"]:
    """The flow of a .flo file, pixels; NaN where it is unknown. Raises `RecordingError` for other and truncated files."""
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; expected a .flo file.")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12 or np.frombuffer(head[:4], "<f4")[0] != _MAGIC:
            raise RecordingError(f"{path} does not begin with {_MAGIC} (PIEH); expected a .flo file.")
        width, height = (int(side) for side in np.frombuffer(head[4:], "<i4"))
        if not (1 <= width <= _MAX_SIDE_PX and 1 <= height <= _MAX_SIDE_PX):
            raise RecordingError(
                f"{path} states {width} x {height} pixels; expected 1 to {_MAX_SIDE_PX}. Copy it again."
            )
        expected = 12 + 8 * width * height
        if size != expected:
            raise RecordingError(
                f"{path} holds {size} bytes; {width} x {height} pixels need {expected}. Copy it again."
            )
        flow = np.frombuffer(file.read(), "<f4").reshape(height, width, 2)
    known = np.all(np.abs(flow) < _UNKNOWN_PX, axis=-1, keepdims=True)
    return np.where(known, flow, np.nan).astype(np.float32)


def write_flo(path: str | Path, flow_px: Float[np.ndarray, "height width 2"]) -> None:
    """Write a flow, pixels; values that are not finite are marked as unknown."""
    height, width, _ = flow_px.shape
    known = np.all(np.isfinite(flow_px), axis=-1, keepdims=True)
    values = np.where(known, flow_px, _UNKNOWN_VALUE_PX).astype("<f4")
    header = _MAGIC.astype("<f4").tobytes() + np.array([width, height], "<i4").tobytes()
    write_atomic(path, header + values.tobytes())
