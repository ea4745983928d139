"""A reader's times on the host's clock, by times of arrival: offset and drift of each piece between jumps of a clock.

A read arrives some milliseconds to seconds after it was made, and never sooner than the smallest latency. The lower
envelope of this delay therefore shows the relation of the two clocks (Moon, Skelly and Towsley, "Estimation and removal
of clock skew from network delay measurements", INFOCOM 1999).
"""

from __future__ import annotations

import bisect
import dataclasses
import datetime as dt

import numpy as np
import scipy  # `scipy.stats` is imported at its first use: it takes most of a second

from ...core.errors import RecordingError
from ..recording import ClockAudit, ClockPiece
from .clock_jumps import continuous_pieces, far_too_small

MAX_DRIFT_PPM = 1000.0
"""A larger drift is no quartz: the times have a wrong unit, or one of the clocks does not run."""

MIN_DRIFT_SPAN_S = 60.0
"""A shorter piece gets no drift: 50 ppm (a plain quartz) are 3 ms there, less than the envelope's uncertainty."""

MAX_SET_ASIDE = 0.1
"""A table in which a larger fraction of the reader's times fits no clock is refused."""

MAX_UNCERTAINTY_S = 0.005
"""A piece of few reads that do not give its offset to so many seconds is set aside."""

_EARLY_S = 0.1  # a read that arrived so long before it was made has a wrong time
_LATE_S = 1.0  # the order of arrivals may differ from the order of reads by so much
_SWAPPED_S = 0.005  # reads that are reported in another order than they were made are so close in time
_GROUP_READS = 50  # the smallest delay of so many reads is one point of the envelope, of fewer in a small table
_MIN_GROUP_READS = 5
_MIN_POINTS, _MAX_POINTS = 12, 60
_COARSE_NS = 50_000_000
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
    if max(rows_in_order(reader, _SWAPPED_S).mean(), rows_in_order(arrival, _LATE_S).mean()) < 1 - MAX_SET_ASIDE:
        order = np.lexsort((reader, arrival))  # the table is sorted by something else, by EPC for example
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
    if num_set_aside > max(2.0, MAX_SET_ASIDE * len(reader)):
        raise RecordingError(
            f"{num_set_aside} of {len(reader)} reader times differ from the times of arrival by more than delays explain, or are "
            f"too few to know the offset of the clocks to {1e3 * MAX_UNCERTAINTY_S:.0f} ms; expected at most {MAX_SET_ASIDE:.0%}. "
            "Import with clock=arrival."
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
    if len(reader) > 9 and (arrival % _COARSE_NS == 0).all():
        raise RecordingError(
            f"All times of arrival are multiples of {_COARSE_NS * 1e-9:g} s; expected a resolution of milliseconds. Import with "
            "clock=reader, or with clock=<seconds to add to it>."
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
    in_order = rows_in_order(reader, _SWAPPED_S) & rows_in_order(arrival, _LATE_S)
    if 2 * in_order.sum() < len(reader) and len(reader) > 2:
        raise RecordingError(_no_clock(reader, arrival, "its times do not increase"))
    # Integers are subtracted before they become float64 seconds, which resolve 1.7e9 s to 0.2 us only.
    reference, base = _median(reader[in_order]), _median(arrival[in_order] - reader[in_order])
    since_s, delay_s = (reader - reference) * 1e-9, (arrival - reader - base) * 1e-9
    in_order &= ~far_too_small(delay_s)  # wrong, and yet in order: where reads are rare, or at an end
    if in_order.sum() < 2:
        raise RecordingError(_no_clock(reader, arrival, "its times do not increase"))
    line = _envelope_line(since_s[in_order], delay_s[in_order])
    span_s = float(np.ptp(since_s[in_order]))
    limit, is_long = MAX_DRIFT_PPM * 1e-6, span_s >= MIN_DRIFT_SPAN_S
    measured = line.num_points >= _MIN_POINTS and is_long
    if not is_long:  # there a drift is not fitted, and must not matter
        limit = min(limit, 2 * MAX_UNCERTAINTY_S / max(span_s, 1e-9))
    if line.low > limit or line.high < -limit:
        raise RecordingError(_no_clock(reader[in_order], arrival[in_order], f"a drift of {1e6 * line.slope:.0f} ppm"))
    if len(since_s) >= _GROUP_READS * _MIN_POINTS and line.spread_s > 2 * MAX_UNCERTAINTY_S:
        raise RecordingError(
            f"The smallest delays of arrival spread by {1e3 * line.spread_s:.0f} ms about a line; expected at most "
            f"{2e3 * MAX_UNCERTAINTY_S:.0f} ms. One of the clocks does not run evenly: import with clock=arrival."
        )
    drift = line.slope if measured else 0.0
    low, offset_s, high = _smallest(delay_s[in_order] - drift * since_s[in_order])
    late_s = delay_s - drift * since_s - offset_s
    piece = ClockPiece(
        reference_ns=reference,
        num_reads=len(reader),
        offset_s=offset_s + base * 1e-9,
        offset_interval_s=(low + base * 1e-9, high + base * 1e-9),
        drift_ppm=1e6 * drift,
        drift_interval_ppm=(1e6 * line.low, 1e6 * line.high) if measured else None,
    )
    is_known = high - low <= (MAX_UNCERTAINTY_S if high == offset_s else 3 * MAX_UNCERTAINTY_S)
    return _Fit(piece, in_order & (late_s > -_EARLY_S) & is_known, line.spread_s)


def rows_in_order(time_ns: np.ndarray, tolerance_s: float) -> np.ndarray:
    """Rows whose time follows those before it: the longest sequence that never falls, and what is close to it.

    A wrong time is out of order, whatever the delay of its arrival is.
    """
    ends: list[int] = []  # the smallest last time of a sequence of each length
    length = np.empty(len(time_ns), int)
    for row, time in enumerate(time_ns.tolist()):
        place = bisect.bisect_right(ends, time)
        ends[place : place + 1] = [time]
        length[row] = place
    kept = np.zeros(len(time_ns), bool)
    wanted, latest = len(ends) - 1, np.iinfo(np.int64).max
    for row in range(len(time_ns) - 1, -1, -1):
        if length[row] == wanted and time_ns[row] <= latest:
            kept[row], latest, wanted = True, time_ns[row], wanted - 1
    rows, base = np.arange(len(time_ns)), _median(time_ns)
    expected = np.interp(rows, rows[kept], (time_ns[kept] - base).astype(float))
    return kept | (np.abs(time_ns - base - expected) <= tolerance_s * 1e9)


@dataclasses.dataclass(frozen=True)
class _Line:
    """The lower envelope of delays over time: Theil-Sen slope with its 95 % interval, and the spread about it in seconds."""

    slope: float
    low: float
    high: float
    spread_s: float
    num_points: int


def _envelope_line(since_s: np.ndarray, delay_s: np.ndarray) -> _Line:
    """The line through the smallest delay of each of several groups of consecutive reads."""
    count = int(np.clip(len(since_s) // _GROUP_READS, _MIN_POINTS, _MAX_POINTS))
    count = min(count, max(1, len(since_s) // _MIN_GROUP_READS))
    lowest = [group[np.argmin(delay_s[group])] for group in np.array_split(np.arange(len(since_s)), count)]
    x, y = since_s[lowest], delay_s[lowest]
    if count < 3 or np.ptp(x) == 0:
        return _Line(0.0, -np.inf, np.inf, 0.0, count)
    slope, _, low, high = map(float, scipy.stats.theilslopes(y, x))
    residual_s = y - slope * x
    spread_s = _NORMAL * float(np.median(np.abs(residual_s - np.median(residual_s))))
    return _Line(slope, low, high, spread_s, count)


def _smallest(delay_s: np.ndarray) -> tuple[float, float, float]:
    """The smallest delay (of many reads, the one that 0.2 % fall short of) between the ends of its 95 % interval.

    The upper end is by binomial ranks. The lower one takes the delays as uniform, from the unknown smallest latency to twice
    their median.
    """
    ordered = np.sort(delay_s)
    number = len(ordered)
    rank = number // 500
    upper = int(scipy.stats.binom.ppf(0.975, number, 0.002)) if rank else 0
    width_s = 2 * float(np.median(ordered) - ordered[0])
    lowest = float(ordered[0]) - width_s * (0.05 ** (-1 / max(1, number - 1)) - 1)
    return lowest, float(ordered[rank]), float(ordered[upper])


def _no_clock(reader: np.ndarray, arrival: np.ndarray, found: str) -> str:
    reader_s, host_s = (reader[-1] - reader[0]) * 1e-9, (arrival[-1] - arrival[0]) * 1e-9
    return (
        f"The reader's clock advances by {reader_s:.6g} s while the host's advances by {host_s:.6g} s ({found}); expected a drift of "
        f"at most {MAX_DRIFT_PPM:.0f} ppm, and of {2e3 * MAX_UNCERTAINTY_S:.0f} ms in less than a minute. A wrong unit, or a clock "
        "that does not run: import with clock=arrival."
    )


def _median(values: np.ndarray) -> int:
    """A middle value: exact for integers of any size."""
    return int(np.partition(values, len(values) // 2)[len(values) // 2])
