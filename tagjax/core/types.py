"""The type of lazily read arrays, and the axis conventions of the whole package.

Axes: images are ``height width [channel]``; points and flow put x (right) before y (down); pixel centres lie at
integers. SI units, named by the last suffix of a variable: ``depth_m``, ``phase_rad``, ``carrier_hz``, ``time_s``.
"""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import numpy as np


@runtime_checkable
class LazyArray(Protocol):
    """An array whose values are read when it is indexed; NumPy and Zarr arrays are examples."""

    @property
    def shape(self) -> tuple[int, ...]: ...

    @property
    def dtype(self) -> Any: ...

    def __getitem__(self, index: Any, /) -> np.ndarray: ...
