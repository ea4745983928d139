"""Times of a sensor on the host's clock, once a recording is complete; and the drift of its clock while it is recorded."""

from __future__ import annotations

import dataclasses

import numpy as np

from ...core.errors import RecordingError
from ..importers.clock import to_host_clock
from ..recording import ClockAudit

SHORT_DRIFT_ERROR_S = 0.0005
"""A drift of a recording shorter than a minute is fitted where its uncertainty moves no time by more than this."""

_GROUP_S = 1.0
_MAX_GROUPS = 600


@dataclasses.dataclass(frozen=True)
class SensorTimes:
    """Times on the host's clock. `audit` is None, and `time_ns` the times of arrival, where the two clocks have no relation."""

    time_ns: np.ndarray  # (num_samples,) int64
    audit: ClockAudit | None
    note: str = ""


def sensor_times(sensor_ns: np.ndarray, arrival_ns: np.ndarray) -> SensorTimes:
    """Times of a sensor's clock on the host's clock, in the order of arrival; a sample that fits no clock keeps its arrival.

    Each piece between two jumps of the sensor's clock (a reboot) is fitted by itself. No sample is later than its arrival.
    """
    try:
        found = to_host_clock(sensor_ns, arrival_ns, short_drift_error_s=SHORT_DRIFT_ERROR_S)
    except RecordingError as error:
        found_text = str(error).split(" Import with ")[0]  # an importer's advice
        return SensorTimes(np.array(arrival_ns, np.int64), None, f"times of arrival are used: {found_text}")
    return SensorTimes(np.minimum(found.time_ns, arrival_ns), found.audit)


class DriftMeter:
    """The drift of a sensor's clock so far, in memory that does not grow: a line through the smallest delay of each second."""

    def __init__(self) -> None:
        self._groups: list[tuple[float, float]] = []  # host time and smallest delay, s
        self._first: tuple[int, int] | None = None
        self._until_s, self._width_s = 0.0, _GROUP_S

    def add(self, sensor_ns: int, arrival_ns: int) -> None:
        """Count a sample."""
        if self._first is None:
            self._first = (sensor_ns, arrival_ns)
        at_s = (arrival_ns - self._first[1]) * 1e-9
        delay_s = at_s - (sensor_ns - self._first[0]) * 1e-9
        if abs(delay_s) > 1.0 + 1e-3 * at_s:  # the clock was set anew
            self._groups, self._first, self._until_s, self._width_s = [], (sensor_ns, arrival_ns), 0.0, _GROUP_S
            return
        if not self._groups or at_s >= self._until_s:
            self._groups.append((at_s, delay_s))
            self._until_s = at_s + self._width_s
            if len(self._groups) > _MAX_GROUPS:
                pairs = zip(self._groups[::2], self._groups[1::2], strict=False)
                self._groups = [min(pair, key=lambda one: one[1]) for pair in pairs]
                self._width_s *= 2
        elif delay_s < self._groups[-1][1]:
            self._groups[-1] = (at_s, delay_s)

    @property
    def drift_ppm(self) -> float:
        """How much faster than the host's clock the sensor's runs; NaN before five seconds."""
        if len(self._groups) < 6:
            return float("nan")
        at_s, delay_s = np.array(self._groups[:-1]).T
        return float(-1e6 * np.polyfit(at_s - at_s.mean(), delay_s, 1)[0])
