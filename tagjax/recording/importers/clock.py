"""A reader's times on the host's clock, by times of arrival: offset and drift of each piece between jumps of a clock.

A read arrives some milliseconds to seconds after it was made, and never sooner than the smallest latency. The lower
envelope of this delay therefore shows the relation of the two clocks (Moon, Skelly and Towsley, "Estimation and removal
of clock skew from network delay measurements", INFOCOM 1999).
"""

from __future__ import annotations

import dataclasses
import datetime as dt

import numpy as np
import scipy.ndimage
import scipy.stats

from ...core.errors import RecordingError
from ..recording import ClockAudit, ClockPiece
from .clock_jumps import continuous_pieces

MAX_DRIFT_PPM = 1000.0
"""A larger drift is no quartz: the times have a wrong unit, or one of the clocks does not run."""

MIN_DRIFT_SPAN_S = 60.0
"""A shorter piece gets no drift: 50 ppm (a plain quartz) are 3 ms there, less than the envelope's uncertainty."""

MAX_SET_ASIDE = 0.1
"""A table in which a larger fraction of the reader's times fits no clock is refused."""

MAX_UNCERTAINTY_S = 0.005
"""A piece of few reads that do not give its offset to so many seconds is set aside."""

_EARLY_S = 0.1  # a read that arrived so long before it was made has a wrong time
_LATE_S = 1.0  # a read that arrived so much later than its neighbours has a wrong time
_QUEUE_S = 0.1  # a change of the delay over a piece without drift that queues explain
_MANY_READS = 300  # so many have a quantile of 1 %
_BIN_READS = 50  # the smallest delay of so many reads is one point of the envelope
_MIN_BINS, _MAX_BINS = 12, 60
_NORMAL = 1.4826  # standard deviation of a normal distribution in median absolute deviations

_YEAR_2010_NS = int(dt.datetime(2010, 1, 1, tzinfo=dt.UTC).timestamp()) * 10**9
_YEAR_2000_NS = int(dt.datetime(2000, 1, 1, tzinfo=dt.UTC).timestamp()) * 10**9


@dataclasses.dataclass(frozen=True)
class HostTimes:
    """The reader's times on the host's clock, for each row of a table in the table's order."""

    time_ns: np.ndarray  # (num_rows,) int64; the time of arrival where the row is not usable
    usable: np.ndarray  # (num_rows,) bool: False for a row whose reader time fits no clock
    audit: ClockAudit


def reader_epoch(reader_ns: np.ndarray) -> str:
    """ "unix" for a clock that was set; "1970" or "2000" for one that started there."""
    first = int(np.min(reader_ns))
    if first >= _YEAR_2010_NS:
        return "unix"
    return "2000" if first >= _YEAR_2000_NS else "1970"


def to_host_clock(reader_ns: np.ndarray, arrival_ns: np.ndarray) -> HostTimes:
    """The reader's times on the host's clock, without the jitter of the times of arrival.

    Both are int64 nanoseconds, one for each row. The smallest latency remains in the result. Raises `RecordingError` for
    fewer than two rows, different numbers of them, a clock that stands still, runs backwards or drifts by more than
    `MAX_DRIFT_PPM`, and if more than `MAX_SET_ASIDE` of the rows fit no clock.
    """
    if len(reader_ns) != len(arrival_ns) or len(reader_ns) < 2:
        raise RecordingError(
            f"{len(reader_ns)} reader times and {len(arrival_ns)} times of arrival; a comparison of clocks needs two of each."
        )
    reader, arrival = np.asarray(reader_ns, np.int64), np.asarray(arrival_ns, np.int64)
    order = np.arange(len(reader))
    if np.mean(np.diff(arrival) < 0) > 0.05:  # the table is sorted by something else, by EPC for example
        order = np.argsort(arrival, kind="stable")
    reader, arrival = reader[order], arrival[order]
    repeats = _repeats(reader, arrival)
    time_ns, usable = arrival.copy(), np.zeros(len(reader), bool)
    fits = []
    for rows in continuous_pieces(reader, arrival):
        fit = _fit(reader[rows], arrival[rows])
        time_ns[rows], usable[rows] = fit.to_host(reader[rows]), fit.usable
        fits.append(fit)
    usable &= ~repeats
    num_set_aside = int(np.sum(~usable))
    if num_set_aside > max(1.0, MAX_SET_ASIDE * len(reader)):
        raise RecordingError(
            f"{num_set_aside} of {len(reader)} reader times fit no clock that runs beside the times of arrival, or are too few "
            f"to know its offset to {1e3 * MAX_UNCERTAINTY_S:.0f} ms; expected at most {MAX_SET_ASIDE:.0%}. Import with "
            "clock=arrival."
        )
    epoch = reader_epoch(reader[usable])
    audit = ClockAudit(
        pieces=tuple(fit.piece for fit in fits),
        residual_ms=1e3 * max(fit.spread_s for fit in fits),
        num_reads=len(reader),
        num_set_aside=num_set_aside,
        reader_epoch=epoch,
        note="" if epoch == "unix" else f"the reader's clock was never set: it started in {epoch}",
    )
    back = np.argsort(order)
    return HostTimes(np.where(usable, time_ns, arrival)[back], usable[back], audit)


def _repeats(reader: np.ndarray, arrival: np.ndarray) -> np.ndarray:
    """Rows with the reader time of the row before them, though more than `_EARLY_S` has passed since its first row.

    Raises `RecordingError` where one of the clocks stands still for a large part of the table.
    """
    steps_s = np.abs(np.diff(arrival)) * 1e-9
    still_s = steps_s[np.diff(reader) == 0].sum()
    if len(reader) > 2 and still_s > MAX_SET_ASIDE * steps_s.sum():
        raise RecordingError(
            f"The reader's clock stands still for {still_s:.3g} s of {steps_s.sum():.3g} s, or its resolution is too coarse; "
            "expected a time for each read. Import with clock=arrival."
        )
    if len(reader) > 2 and steps_s.sum() == 0 and np.ptp(reader) > 1e9:
        raise RecordingError(
            f"All {len(reader)} times of arrival are the same, while the reader's clock runs for {np.ptp(reader) * 1e-9:.3g} s. "
            "Import with clock=reader, or with clock=<seconds to add to it>."
        )
    first = np.maximum.accumulate(np.where(np.r_[True, np.diff(reader) != 0], np.arange(len(reader)), 0))
    return (arrival - arrival[first]) * 1e-9 > _EARLY_S


@dataclasses.dataclass(frozen=True)
class _Fit:
    piece: ClockPiece
    usable: np.ndarray  # (num_rows,) bool
    spread_s: float  # of the smallest delays about the line

    def to_host(self, reader: np.ndarray) -> np.ndarray:
        piece = self.piece
        drift_ns = (reader - piece.reference_ns) * (piece.drift_ppm * 1e-6)
        return reader + round(piece.offset_s * 1e9) + np.rint(drift_ns).astype(np.int64)


def _fit(reader: np.ndarray, arrival: np.ndarray) -> _Fit:
    """Offset and drift of one piece, and which of its rows fit them."""
    # Integers are subtracted before they become float64 seconds, which resolve 1.7e9 s to 0.2 us only.
    reference, base = _median(reader), _median(arrival - reader)
    since_s, delay_s = (reader - reference) * 1e-9, (arrival - reader - base) * 1e-9
    usual = np.abs(delay_s - _running_median(delay_s)) < _LATE_S
    if usual.sum() < 2:
        usual[:] = True
    drift, drift_interval, spread_s = _drift(since_s[usual], delay_s[usual])
    if drift_interval is None:
        raise RecordingError(_no_clock(reader[usual], arrival[usual], drift))
    low, offset_s, high = _smallest(delay_s[usual] - drift * since_s[usual])
    late_s = delay_s - drift * since_s - offset_s
    neighbours_s = np.maximum(_running_median(late_s), 0)
    piece = ClockPiece(
        reference_ns=reference,
        num_reads=len(reader),
        offset_s=offset_s + base * 1e-9,
        offset_interval_s=(low + base * 1e-9, high + base * 1e-9),
        drift_ppm=1e6 * drift,
        drift_interval_ppm=(1e6 * drift_interval[0], 1e6 * drift_interval[1]) if drift_interval else None,
    )
    usable = (late_s > -_EARLY_S - 5 * spread_s) & (late_s < neighbours_s + _LATE_S)
    known = len(delay_s) >= _MANY_READS or high - low <= MAX_UNCERTAINTY_S
    return _Fit(piece, usable & known, spread_s)


def _drift(since_s: np.ndarray, delay_s: np.ndarray) -> tuple[float, tuple[float, ...] | None, float]:
    """The drift of the delays' lower envelope, its 95 % interval, and the envelope's spread in seconds.

    The drift is 0 and its interval empty where the piece is too short; the interval is None where this is no clock.
    """
    x, y = _envelope(since_s, delay_s)
    if len(x) == 1:
        return 0.0, (), 0.0
    drift, _, low, high = map(float, scipy.stats.theilslopes(y, x))
    residual_s = y - drift * x
    spread_s = _NORMAL * float(np.median(np.abs(residual_s - np.median(residual_s))))
    span_s, limit = float(np.ptp(since_s)), MAX_DRIFT_PPM * 1e-6
    if span_s >= MIN_DRIFT_SPAN_S:
        return drift, (low, high) if abs(drift) <= limit else None, spread_s
    limit = max(limit, _QUEUE_S / span_s)
    return (drift, None, spread_s) if low > limit or high < -limit else (0.0, (), spread_s)


def _smallest(delay_s: np.ndarray) -> tuple[float, float, float]:
    """The delay that 1 % fall short of, between the ends of its 95 % interval; of less than 300 reads the smallest one.

    The interval of a quantile is by binomial ranks. That of the smallest of few delays takes them as uniform, from the
    unknown smallest latency to twice their median.
    """
    ordered = np.sort(delay_s)
    number = len(ordered)
    if number >= _MANY_READS:
        first, last = scipy.stats.binom.ppf([0.025, 0.975], number, 0.01).astype(int)
        return float(ordered[max(0, first - 1)]), float(ordered[number // 100]), float(ordered[last])
    width_s = 2 * float(np.median(ordered) - ordered[0])
    lowest = float(ordered[0]) - width_s * (0.05 ** (-1 / max(1, number - 1)) - 1)
    return lowest, float(ordered[0]), float(ordered[0])


def _envelope(since_s: np.ndarray, delay_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The smallest delay of each of several groups of consecutive reads, and when it was; of all where they are few."""
    count = min(len(since_s) // _BIN_READS, _MAX_BINS)
    if count < _MIN_BINS:  # few reads: for a drift, which matters more in a long piece, or for an offset alone
        count = _MIN_BINS if np.ptp(since_s) >= MIN_DRIFT_SPAN_S and len(since_s) >= 5 * _MIN_BINS else 1
    lowest = [group[np.argmin(delay_s[group])] for group in np.array_split(np.arange(len(since_s)), count)]
    return since_s[lowest], delay_s[lowest]


def _no_clock(reader: np.ndarray, arrival: np.ndarray, drift: float) -> str:
    reader_s, host_s = (reader[-1] - reader[0]) * 1e-9, (arrival[-1] - arrival[0]) * 1e-9
    return (
        f"The reader's clock advances by {reader_s:.6g} s while the host's advances by {host_s:.6g} s (drift {1e6 * drift:.0f} "
        f"ppm); expected a difference of at most {MAX_DRIFT_PPM:.0f} ppm. A wrong unit, or a clock that does not run: import "
        "with clock=arrival."
    )


def _running_median(values: np.ndarray) -> np.ndarray:
    """The median of seven neighbours; at an end the values inside count twice, so that a wrong first row stands out."""
    return scipy.ndimage.median_filter(values, 7, mode="mirror")


def _median(values: np.ndarray) -> int:
    """A middle value: exact for integers of any size."""
    return int(np.partition(values, len(values) // 2)[len(values) // 2])
