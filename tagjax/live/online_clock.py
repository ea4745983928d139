"""Times of a sensor on the host's clock while they come in: from the smallest delays so far, in memory that does not grow."""

from __future__ import annotations

import collections

import numpy as np

_GROUP_NS = 500_000_000
_NUM_GROUPS = 60
_MIN_GROUPS = 8  # for a drift; before, the smallest delay counts
_MAX_DRIFT = 5e-4  # of a quartz
_EARLY_NS = 100_000_000
_BACK_NS = 1_000_000_000
_LATE_NS = 10_000_000_000


class OnlineClock:
    """The delay from a sensor's clock to its arrival at the host, as a line under the smallest delay of each half second.

    What is on the way is never early, so the smallest delays are those of an idle network, and their slope is the clock's
    drift. A clock that was set anew is learnt anew: a sample is early by more than a tenth of a second, or late by more than ten
    seconds, or the sensor's time goes back by more than a second. A busy host takes samples a second late, and sets no clock.
    """

    def __init__(self) -> None:
        self._origin: tuple[int, int] | None = None  # the sensor's and the host's time of the first sample
        self._groups: collections.deque[tuple[int, int]] = collections.deque(maxlen=_NUM_GROUPS)
        self._group_end_ns = 0
        self._slope, self._base_ns = 0.0, 0.0  # of the line, over the sensor's time since the first sample
        self._latest_ns = 0  # of the sensor's times
        self.num_jumps = 0

    def host_ns(self, sensor_ns: int, arrival_ns: int) -> int:
        """The host's time of a sample with this time of the sensor, which arrived now; never later than the arrival."""
        if self._origin is not None and self._jumped(sensor_ns, arrival_ns):
            self._groups.clear()
            self._origin, self.num_jumps = None, self.num_jumps + 1
        if self._origin is None:
            self._origin = (sensor_ns, arrival_ns)
            self._group_end_ns, self._slope, self._base_ns, self._latest_ns = 0, 0.0, 0.0, sensor_ns
        self._latest_ns = max(self._latest_ns, sensor_ns)
        at_ns, delay_ns = self._of(sensor_ns, arrival_ns)
        self._add(at_ns, delay_ns)
        return min(self._origin[1] + at_ns + round(self._base_ns + self._slope * at_ns), arrival_ns)

    def _of(self, sensor_ns: int, arrival_ns: int) -> tuple[int, int]:
        """The sensor's time since the first sample, and how much later than the first one it arrived."""
        assert self._origin is not None
        at_ns = sensor_ns - self._origin[0]
        return at_ns, arrival_ns - self._origin[1] - at_ns

    def _jumped(self, sensor_ns: int, arrival_ns: int) -> bool:
        at_ns, delay_ns = self._of(sensor_ns, arrival_ns)
        late_ns = delay_ns - (self._base_ns + self._slope * at_ns)
        return late_ns > _LATE_NS or late_ns < -_EARLY_NS or sensor_ns < self._latest_ns - _BACK_NS

    def _add(self, at_ns: int, delay_ns: int) -> None:
        if not self._groups or at_ns >= self._group_end_ns:
            self._groups.append((at_ns, delay_ns))
            self._group_end_ns = at_ns + _GROUP_NS
            self._fit()
        elif delay_ns < self._groups[-1][1]:
            self._groups[-1] = (at_ns, delay_ns)
            if delay_ns < self._base_ns + self._slope * at_ns:
                self._fit()

    def _fit(self) -> None:
        """The line under all groups that is nearest to them on average: the edge of their lower hull at their mean time."""
        at, delay = np.array(self._groups, np.float64).T
        slope = 0.0
        if len(at) >= _MIN_GROUPS:
            hull: list[int] = []
            for new in range(len(at)):
                while len(hull) > 1 and _is_above(at, delay, hull[-2], hull[-1], new):
                    hull.pop()
                hull.append(new)
            right = min(max(int(np.searchsorted(at[hull], at.mean())), 1), len(hull) - 1)
            first, second = hull[right - 1], hull[right]
            slope = (delay[second] - delay[first]) / (at[second] - at[first])
            slope = float(np.clip(slope, -_MAX_DRIFT, _MAX_DRIFT))
        self._slope, self._base_ns = slope, float(np.min(delay - slope * at))


def _is_above(at: np.ndarray, delay: np.ndarray, first: int, middle: int, last: int) -> bool:
    """Whether the middle group lies on or above the line through the other two."""
    across = (at[middle] - at[first]) * (delay[last] - delay[first]) - (delay[middle] - delay[first]) * (
        at[last] - at[first]
    )
    return bool(across <= 0)
