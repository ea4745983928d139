"""Times of a sensor on the host's clock, once a recording is complete; and the drift of its clock while it is recorded.

The host itself has taken the times of arrival, so that samples come in the order in which they were made, and a delay is never
shorter than the smallest latency. It may be long: a host that is busy with other programs takes a sample a second late, and many
at once. Such delays neither set a clock anew nor move the line that the smallest ones lie on.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ...core.errors import RecordingError
from ..importers.clock import MAX_DRIFT_PPM, reader_epoch, rows_in_order
from ..importers.clock_jumps import continuous_pieces
from ..recording import ClockAudit, ClockPiece
from .envelope import envelope

_QUEUE_S = 10.0  # a host holds samples up for so long at most: a larger step of the delay is one of the clock
_MIN_STEP_S = 0.02
_SWAPPED_S = 0.005  # samples that come in another order than they were made are so close in time
_LEVEL = 0.1  # quantile that stands for the smallest delays beside a step
_BESIDE, _BESIDE_S = 200, 10.0  # samples, and seconds, beside a step that show it
_MIN_BESIDE, _MIN_BESIDE_S = 30, 1.0
_UNEVEN_S, _UNEVEN = (
    0.02,
    0.002,
)  # a quarter of the smallest delays is within so much, and so much of the time, of a clock's line

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

    Each piece between two settings of the sensor's clock (a reboot) is fitted by itself. No sample is later than its arrival.
    """
    sensor, arrival = np.asarray(sensor_ns, np.int64), np.asarray(arrival_ns, np.int64)
    time_ns, usable = arrival.copy(), np.zeros(len(arrival), bool)
    pieces, excess_s = [], 0.0
    try:
        if len(arrival) < 2:
            raise RecordingError(f"{len(arrival)} samples; a comparison of clocks needs two.")
        for rows in _pieces(sensor, arrival):
            rows = rows[_not_wrong(sensor[rows], arrival[rows])]
            piece, over_s = _fit(sensor[rows], arrival[rows])
            drift_ns = (sensor[rows] - piece.reference_ns) * (1e-6 * piece.drift_ppm)
            time_ns[rows] = sensor[rows] + round(1e9 * piece.offset_s) + np.rint(drift_ns).astype(np.int64)
            usable[rows] = True
            pieces.append(piece)
            excess_s = max(excess_s, over_s)
    except RecordingError as error:
        return SensorTimes(arrival.copy(), None, f"times of arrival are used: {error}")
    epoch = reader_epoch(sensor[usable])
    audit = ClockAudit(
        pieces=tuple(pieces),
        residual_ms=1e3 * excess_s,
        num_reads=len(arrival),
        num_set_aside=int(np.sum(~usable)),
        reader_epoch=epoch,
        note="" if epoch == "unix" else f"the reader's clock was never set: it started in {epoch}",
    )
    return SensorTimes(np.minimum(time_ns, arrival), audit)


def _fit(sensor: np.ndarray, arrival: np.ndarray) -> tuple[ClockPiece, float]:
    """A piece's offset and drift, and by how much its smallest delays exceed the line. Raises `RecordingError` where there is none."""
    # Integers are subtracted before they become float64 seconds, which resolve 1.7e9 s to 0.2 us only.
    reference = int(sensor[0] + (sensor[-1] - sensor[0]) // 2)
    base = int(np.min(arrival - sensor))
    since_s, delay_s = (sensor - reference) * 1e-9, (arrival - sensor - base) * 1e-9
    line = envelope(since_s, delay_s)
    span_s = float(np.ptp(arrival)) * 1e-9
    if line.excess_s > _UNEVEN_S + _UNEVEN * span_s:
        sensor_s = float(sensor[-1] - sensor[0]) * 1e-9
        raise RecordingError(
            f"the sensor's clock advances by {sensor_s:.6g} s while the host's advances by {span_s:.6g} s; expected a drift of at "
            f"most {MAX_DRIFT_PPM:.0f} ppm. A clock that does not run, or not evenly."
        )
    low_s, high_s = line.level_interval_s
    piece = ClockPiece(
        reference_ns=reference,
        num_reads=len(sensor),
        offset_s=line.level_s + base * 1e-9,
        offset_interval_s=(low_s + base * 1e-9, high_s + base * 1e-9),
        drift_ppm=1e6 * line.slope,
        drift_interval_ppm=(1e6 * line.slope_interval[0], 1e6 * line.slope_interval[1]),
    )
    return piece, line.excess_s


def _not_wrong(sensor: np.ndarray, arrival: np.ndarray) -> np.ndarray:
    """Samples whose time follows that of those before it. Of the first and the last one only their delay shows what is wrong."""
    good = rows_in_order(sensor, _SWAPPED_S)
    inner = np.flatnonzero(good)[1:-1]
    if len(inner) >= _MIN_BESIDE:
        delay_s = (arrival - sensor - np.min((arrival - sensor)[inner])) * 1e-9
        since_s = (arrival - arrival[inner[0]]) * 1e-9
        line = envelope(since_s[inner], delay_s[inner])
        good &= delay_s > line.level_s + line.slope * since_s - _MIN_STEP_S
    return good


def _pieces(sensor: np.ndarray, arrival: np.ndarray) -> list[np.ndarray]:
    """Rows of each piece in which the sensor's clock was not set anew: late samples alone begin no piece."""
    joined: list[np.ndarray] = []
    firsts = sorted(int(rows.min()) for rows in continuous_pieces(sensor, arrival))
    for rows in np.split(np.arange(len(sensor)), firsts[1:]):
        if joined and not _set_anew(sensor, arrival, joined[-1], rows):
            joined[-1] = np.concatenate([joined[-1], rows])
        else:
            joined.append(rows)
    return joined


def _set_anew(sensor: np.ndarray, arrival: np.ndarray, before: np.ndarray, after: np.ndarray) -> bool:
    """Whether the step of the smallest delays between two pieces is one of the sensor's clock."""
    delays_s = [
        (arrival[rows] - sensor[rows] - (arrival[before[-1]] - sensor[before[-1]])) * 1e-9 for rows in (before, after)
    ]
    times_s = [np.abs(arrival[rows] - arrival[after[0]]) * 1e-9 for rows in (before, after)]
    beside = [delay[time <= _BESIDE_S] for delay, time in zip(delays_s, times_s, strict=True)]
    beside = [beside[0][-_BESIDE:], beside[1][:_BESIDE]]
    if not all(len(delay) for delay in beside):
        beside = [delays_s[0][-_BESIDE:], delays_s[1][:_BESIDE]]
    gap_s = float(arrival[after[0]] - arrival[before[-1]]) * 1e-9
    low = [float(np.quantile(delay, _LEVEL)) for delay in beside]
    step_s = abs(low[1] - low[0]) - 1e-6 * MAX_DRIFT_PPM * gap_s
    if step_s > _QUEUE_S:
        return True
    # Samples come in the order in which they were made: a clock that goes back was set.
    back_s = float(np.median(sensor[before[-5:]]) - np.median(sensor[after[:5]])) * 1e-9
    if back_s > _MIN_STEP_S:
        return True
    # A host that is held up takes samples early and late: they come at once. Behind a clock that was set they have one delay.
    even = [
        np.mean(delay <= lowest + max(2e-3, step_s / 10)) >= 0.5 and len(delay) >= _MIN_BESIDE
        for delay, lowest in zip(beside, low, strict=True)
    ]
    long = all(float(np.ptp(time)) >= _MIN_BESIDE_S for time in times_s)
    return step_s > _MIN_STEP_S and all(even) and long


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
        if not delay_s + 1e-3 * at_s > -1.0 or delay_s > _QUEUE_S + 1e-3 * at_s:  # the clock was set anew
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
