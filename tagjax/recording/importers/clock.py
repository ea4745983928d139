"""Clock audit: was the reader's clock set, and how do reader and host clocks relate."""

from __future__ import annotations

import datetime as dt

import numpy as np

from ...core.errors import RecordingError
from ..recording import ClockAudit

_YEAR_2010_NS = int(dt.datetime(2010, 1, 1, tzinfo=dt.UTC).timestamp()) * 10**9
_YEAR_2000_NS = int(dt.datetime(2000, 1, 1, tzinfo=dt.UTC).timestamp()) * 10**9


def reader_epoch(reader_ns: np.ndarray) -> str:
    """ "unix" for a clock that was set; "1970" or "2000" for one that started there."""
    first = int(np.min(reader_ns))
    if first >= _YEAR_2010_NS:
        return "unix"
    return "2000" if first >= _YEAR_2000_NS else "1970"


def audit_clocks(reader_ns: np.ndarray, host_ns: np.ndarray) -> ClockAudit:
    """Offset and drift of the host's clock against the reader's, from when reads were made and when they arrived.

    Arrival is never before the read, and late by queues: in each of up to 60 stretches of time the earliest arrivals
    count, and a line is fitted through them, outliers left out. The least latency stays in the offset.
    """
    if len(reader_ns) != len(host_ns) or len(reader_ns) < 2:
        raise RecordingError(f"{len(reader_ns)} reader and {len(host_ns)} host times; a clock audit needs two of each.")
    order = np.argsort(reader_ns, kind="stable")
    reader_s = (reader_ns[order] - reader_ns[order][0]) * 1e-9
    late_ns = host_ns[order] - reader_ns[order]
    late_s = (late_ns - late_ns[0]) * 1e-9
    pieces = np.array_split(np.arange(len(reader_s)), min(60, max(1, len(reader_s) // 5)))
    lowest = np.array([piece[np.argmin(late_s[piece])] for piece in pieces if len(piece)])
    x, y = reader_s[lowest], late_s[lowest]
    keep = np.ones(len(x), bool)
    slope, offset = 0.0, float(np.median(y))
    for _ in range(5):
        if keep.sum() < 3 or np.ptp(x[keep]) == 0:
            break
        slope, offset = np.polyfit(x[keep], y[keep], 1)
        residual = y - (slope * x + offset)
        limit = 3 * 1.4826 * np.median(np.abs(residual[keep] - np.median(residual[keep]))) + 1e-6
        keep = np.abs(residual) <= limit
    residual_ms = 1e3 * float(np.std(y[keep] - (slope * x[keep] + offset)))
    epoch = reader_epoch(reader_ns)
    note = "" if epoch == "unix" else f"the reader's clock was never set: it started in {epoch}"
    return ClockAudit(
        offset_s=float(offset) + float(late_ns[0]) * 1e-9,
        drift_ppm=float(slope) * 1e6,
        residual_ms=residual_ms,
        num_reads=len(reader_ns),
        reader_epoch=epoch,
        note=note,
    )


def to_host_ns(reader_ns: np.ndarray, audit: ClockAudit) -> np.ndarray:
    """Reader times on the host's clock: free of the jitter with which reads arrive."""
    first = int(np.min(reader_ns))
    drift = (reader_ns - first) * (audit.drift_ppm * 1e-6)
    return reader_ns + round(audit.offset_s * 1e9) + np.rint(drift).astype(np.int64)
