"""Middlebury's .flo files: dense flow as little-endian float32 (Baker et al., IJCV 2011)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..recording import RecordingError

_MAGIC = np.float32(202021.25)
_UNKNOWN_PX = 1e9
"""A component of this size or more says that the flow of a pixel is unknown."""

_WRITTEN_PX = np.float32(1e10)
_LONGEST_SIDE = 99_999


def read_flo(path: str | Path) -> Float[np.ndarray, "height width 2"]:
    """The flow of a .flo file, pixels; NaN where it is unknown. Raises `RecordingError` for any other or cut file."""
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; expected a .flo file.")
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(12)
        if len(head) < 12 or np.frombuffer(head[:4], "<f4")[0] != _MAGIC:
            raise RecordingError(f"{path} does not begin with {_MAGIC} (PIEH); it is no .flo file.")
        width, height = (int(side) for side in np.frombuffer(head[4:], "<i4"))
        if not (1 <= width <= _LONGEST_SIDE and 1 <= height <= _LONGEST_SIDE):
            raise RecordingError(
                f"{path} says {width} x {height} pixels; expected 1 to {_LONGEST_SIDE}. It is damaged."
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
    """Write a flow; what is not finite is marked as unknown."""
    height, width, _ = flow_px.shape
    known = np.all(np.isfinite(flow_px), axis=-1, keepdims=True)
    values = np.where(known, flow_px, _WRITTEN_PX).astype("<f4")
    with Path(path).open("wb") as file:
        file.write(_MAGIC.astype("<f4").tobytes() + np.array([width, height], "<i4").tobytes() + values.tobytes())
