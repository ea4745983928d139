"""Evidence in a tag's raw reads against the hypothesis that it is stationary, before any range is estimated."""

from __future__ import annotations

import numpy as np

from ..recording import TagReads

MIN_READS = 6
"""An interval with fewer reads gives no evidence."""


def coherence_loss(reads: TagReads, edges_s: np.ndarray, origin_ns: int) -> np.ndarray:
    """1 - the coherence modulo pi of one tag's reads under the stationary hypothesis, (intervals,), between the edges.

    The coherence of an interval is sum_c |sum_{r in c} exp(2j phi_r)| / (number of reads) over antenna and carrier c, whose
    phase offsets are unknown. Noise of sigma rad costs about 2 sigma^2, pi flips cost nothing, and motion by some
    centimetres costs nearly all. Intervals with fewer than `MIN_READS` reads of known carrier lose nothing. `edges_s`
    (intervals + 1,) rises, seconds from `origin_ns`.
    """
    num_intervals = len(edges_s) - 1
    reads = reads[np.isfinite(reads.carrier_hz)]
    interval = np.searchsorted(edges_s, (reads.time_ns - origin_ns) * 1e-9, side="left") - 1
    inside = (interval >= 0) & (interval < num_intervals)
    reads, interval = reads[inside], interval[inside]
    pairs = np.stack([reads.antenna, reads.carrier_hz])
    _, channel = np.unique(pairs, axis=1, return_inverse=True) if reads.num_reads else (None, np.empty(0, np.intp))
    num_channels = int(channel.max(initial=0)) + 1
    code, size = interval * num_channels + channel.reshape(-1), num_intervals * num_channels
    real, imaginary = (
        np.bincount(code, part(2.0 * reads.phase_rad), minlength=size).reshape(num_intervals, num_channels)
        for part in (np.cos, np.sin)
    )
    count = np.bincount(interval, minlength=num_intervals)
    coherence = np.hypot(real, imaginary).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= MIN_READS, 1.0 - coherence, 0.0)
