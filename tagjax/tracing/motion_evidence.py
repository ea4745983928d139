"""What a tag's raw reads say against rest: whether the radio hears a tag move, before anything is estimated."""

from __future__ import annotations

import numpy as np

from ..recording import TagReads

MIN_READS = 6
"""A piece of fewer reads says nothing."""


def coherence_lost(reads: TagReads, edges_s: np.ndarray, origin_ns: int) -> np.ndarray:
    """1 - the coherence modulo pi of one tag's reads with no motion, (pieces,), of the pieces of time between the edges.

    Of a piece sum_c |sum_{r in c} exp(2j phi_r)| / (number of reads) over antenna and carrier c, whose offsets are
    unknown: about 2 sigma^2 is lost to noise of sigma rad, pi flips lose nothing, motion of some centimetres nearly all. Pieces
    of fewer than `MIN_READS` reads of known carrier lose nothing. `edges_s` (pieces + 1,) rises, seconds from `origin_ns`.
    """
    num_pieces = len(edges_s) - 1
    reads = reads[np.isfinite(reads.carrier_hz)]
    piece = np.searchsorted(edges_s, (reads.time_ns - origin_ns) * 1e-9, side="left") - 1
    inside = (piece >= 0) & (piece < num_pieces)
    reads, piece = reads[inside], piece[inside]
    pairs = np.stack([reads.antenna, reads.carrier_hz])
    _, channel = np.unique(pairs, axis=1, return_inverse=True) if reads.num_reads else (None, np.empty(0, np.intp))
    num_channels = int(channel.max(initial=0)) + 1
    code, size = piece * num_channels + channel.reshape(-1), num_pieces * num_channels
    real, imaginary = (
        np.bincount(code, part(2.0 * reads.phase_rad), minlength=size).reshape(num_pieces, num_channels)
        for part in (np.cos, np.sin)
    )
    count = np.bincount(piece, minlength=num_pieces)
    coherence = np.hypot(real, imaginary).sum(axis=1) / np.maximum(count, 1)
    return np.where(count >= MIN_READS, 1.0 - coherence, 0.0)
