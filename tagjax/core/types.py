"""Shape aliases and axis conventions shared by the whole package.

Axes: images are ``height width [channel]``; points and flow put x (right) before y (down); pixel centres lie at
integers. SI units, named by the last suffix of a variable: ``depth_m``, ``phase_rad``, ``carrier_hz``, ``time_s``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
from jaxtyping import Array, Bool, Float

DepthMap: TypeAlias = Float[Array, "height width"]
"""Depth z along the optical axis, metres, 0 = missing."""

RangeMap: TypeAlias = Float[Array, "height width"]
"""Distance to the sensor origin, metres, 0 = missing. Not depth."""

FlowField: TypeAlias = Float[Array, "height width 2"]
"""Optical flow, pixels: [..., 0] = dx (right), [..., 1] = dy (down)."""

PointMap: TypeAlias = Float[Array, "height width 3"]
"""Points (x right, y down, z forward), metres, camera frame."""

PixelMask: TypeAlias = Bool[Array, "height width"]

Metadata: TypeAlias = Mapping[str, Any]


@runtime_checkable
class LazyArray(Protocol):
    """What a stored array offers without being read: NumPy and Zarr arrays both do."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> Any: ...

    def __getitem__(self, index: Any, /) -> np.ndarray: ...
