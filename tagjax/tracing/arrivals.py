"""From a recording's reads to the reads that arrive with every frame, on the host."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..radio.arrivals import Arrivals
from ..radio.noise import UNKNOWN_RSSI_DBM
from ..recording import TagReads


@dataclasses.dataclass(frozen=True)
class UnusedReads:
    """Numbers of the selected tags' reads between the first and the last frame that no buffer holds."""

    num_dropped: np.ndarray  # (time,) int64, of each frame: more reads than the buffer has elements
    num_other_antenna: int
    num_unknown_carrier: int  # of the antennas that are used: reads without a carrier or a phase


def frame_arrivals(
    reads: TagReads,
    epcs: Sequence[str],
    antennas: Sequence[int],
    frame_time_ns: np.ndarray,
    origin_ns: int,
    num_reads: int,
    *,
    since_ns: int | None = None,
) -> tuple[Arrivals, UnusedReads]:
    """The reads of (previous frame, frame] of every frame (leading time axis), in order of time; NumPy arrays.

    Tags and antennas are numbered as in `epcs` and `antennas` (these counted from 1); times are seconds from `origin_ns`.
    The first frame's reads are those since `since_ns`; it has none if this is None. Where more than `num_reads` arrive,
    the newest of each tag stay, then the second newest of each tag and so on; of equal rank the newest. A missing RSSI
    becomes `UNKNOWN_RSSI_DBM`. Raises `ValueError` for a buffer without elements, a tag or antenna given twice,
    and frames that are not in order of time.
    """
    if num_reads < 1:
        raise ValueError(f"num_reads is {num_reads}; expected at least 1 (length of a frame's buffer).")
    for name, values in (("epcs", epcs), ("antennas", antennas)):
        if len(set(values)) < len(values):
            raise ValueError(f"{name} is {list(values)}; expected each once.")
    first_ns = frame_time_ns[0] if since_ns is None else since_ns
    edges_ns = np.concatenate([[first_ns], frame_time_ns])
    if np.any(np.diff(edges_ns) < 0):
        raise ValueError("The frames' times go back; expected frames in order of time, after since_ns. Sort them.")
    # Frame i has the reads later than edge i and not later than edge i + 1.
    frame = np.searchsorted(edges_ns, reads.time_ns, side="left") - 1
    tag, antenna = _index(reads.epc, epcs), _index(reads.antenna, antennas)
    known = np.isfinite(reads.carrier_hz) & np.isfinite(reads.phase_rad)
    arrived = (tag >= 0) & (frame >= 0) & (frame < len(frame_time_ns))
    used = arrived & (antenna >= 0) & known
    # The carrier in kHz is a number of the channel that does not depend on which reads are given.
    channel = np.where(known, np.rint(1e-3 * np.where(known, reads.carrier_hz, 0.0)), -1.0)

    chosen = np.flatnonzero(used)
    chosen = chosen[np.argsort(reads.time_ns[chosen], kind="stable")]
    count = np.bincount(frame[chosen], minlength=len(frame_time_ns))
    age = _rank_from_last(frame[chosen] * max(len(epcs), 1) + tag[chosen])
    by_preference = np.lexsort((-np.arange(len(chosen)), age, frame[chosen]))
    place = np.empty(len(chosen), np.int64)
    place[by_preference] = np.arange(len(chosen)) - (np.cumsum(count) - count)[frame[chosen][by_preference]]
    chosen = chosen[place < num_reads]
    kept = np.minimum(count, num_reads)
    row, column = frame[chosen], np.arange(len(chosen)) - (np.cumsum(kept) - kept)[frame[chosen]]

    def buffered(values: np.ndarray, fill: float | int, dtype: type) -> Any:
        out = np.full((len(frame_time_ns), num_reads), fill, dtype)
        out[row, column] = values[chosen]
        return out

    phase_rad = np.mod(reads.phase_sign * reads.phase_rad, 2 * np.pi)
    rssi_dbm = np.where(np.isfinite(reads.rssi_dbm), reads.rssi_dbm, UNKNOWN_RSSI_DBM)
    arrivals = Arrivals(
        tag=buffered(tag, 0, np.int32),
        antenna=buffered(antenna, 0, np.int32),
        time_s=buffered((reads.time_ns - origin_ns) * 1e-9, 0.0, np.float32),
        phase_rad=buffered(phase_rad, 0.0, np.float32),
        carrier_hz=buffered(reads.carrier_hz, 915e6, np.float32),
        channel=buffered(channel, -1, np.int32),
        rssi_dbm=buffered(rssi_dbm, UNKNOWN_RSSI_DBM, np.float32),
        valid=buffered(np.ones(reads.num_reads), 0, np.bool_),
    )
    return arrivals, UnusedReads(
        num_dropped=count - kept,
        num_other_antenna=int(np.sum(arrived & (antenna < 0))),
        num_unknown_carrier=int(np.sum(arrived & (antenna >= 0) & ~known)),
    )


def _index(values: np.ndarray, known: Sequence[str] | Sequence[int]) -> np.ndarray:
    """The place of each value among the known ones; -1 for others."""
    index = np.full(len(values), -1)
    for place, one in enumerate(known):
        index[values == one] = place
    return index


def _rank_from_last(group: np.ndarray) -> np.ndarray:
    """How many later elements have the same group."""
    order = np.argsort(group, kind="stable")
    ordered = group[order]
    last = np.searchsorted(ordered, ordered, side="right") - 1
    rank = np.empty(len(group), np.int64)
    rank[order] = last - np.arange(len(group))
    return rank
