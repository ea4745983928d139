"""How far the distance that a tag's object has travelled may be wrong, as the tracer assumes it."""

from __future__ import annotations

from typing import Any

import numpy as np
from jaxtyping import Float

from ..tracing.tracer import Trace


class MotionError:
    """How well the camera knows what the distance of each tag's object to the antenna has changed by.

    The variance, m^2, is the tracer's own for a motion (`ReaderModel`): `drift_m` (z / 1 m)^2 for each metre that the distance
    has changed by, either way, forgotten with the time constant `memory_s`, as the tracer forgets its reads.
    """

    def __init__(self, drift_m: float, memory_s: float) -> None:
        """Nothing has moved yet."""
        self.drift_m, self.memory_s = drift_m, memory_s
        self._variance_m2: Any = 0.0
        self._time_s = 0.0

    def after(self, time_s: float, trace: Trace) -> Float[np.ndarray, " tag"]:
        """The standard deviation of each tag at this frame, which is later than that of the last call."""
        way_m = np.abs(np.asarray(trace.step_m)[:, 0])
        added = self.drift_m * np.square(np.asarray(trace.centre_m)[:, 2]) * way_m
        kept = np.exp(-max(time_s - self._time_s, 0.0) / self.memory_s)
        self._variance_m2 = kept * self._variance_m2 + np.where(np.isfinite(added), added, 0.0)
        self._time_s = time_s
        return np.sqrt(self._variance_m2)
