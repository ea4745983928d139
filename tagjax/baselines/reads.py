"""Tag reads as the phase-based baselines use them: joined over frames, of one antenna, with a sign and hops
corrected.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Shaped

from ..radio.channels import MAX_SLOPE_RAD_HZ, estimate_slope
from ..recording import TagReads


def usable_reads(reads: TagReads, antenna: int) -> Bool[np.ndarray, " reads"]:
    """Reads of one antenna (counted from 1) whose carrier is known."""
    return np.asarray((reads.antenna == antenna) & np.isfinite(reads.carrier_hz))


def range_phase_rad(reads: TagReads) -> Float[np.ndarray, " reads"]:
    """Phases that grow with distance whatever the reader's sign, in [0, 2 pi)."""
    return np.mod(reads.phase_sign * np.asarray(reads.phase_rad, np.float64), 2 * np.pi)


def hop_slope_rad_hz(
    phase_rad: Float[np.ndarray, " reads"],
    read_time_s: Shaped[np.ndarray, " reads"],
    carrier_hz: Float[np.ndarray, " reads"],
) -> float:
    """The slope of one tag's phase over the carrier at its channel hops, rad/Hz; NaN where the hops disagree."""
    channel = np.unique(carrier_hz, return_inverse=True)[1].reshape(-1)
    found = estimate_slope(phase_rad, read_time_s, channel, carrier_hz)
    known = found.residual_rad < np.pi and abs(found.slope_rad_hz) < MAX_SLOPE_RAD_HZ
    return found.slope_rad_hz if known else float("nan")


def padded_size(count: int, step: int) -> int:
    """The smallest multiple of `step` that is at least `count`: buffers of few sizes compile few programs."""
    return -(-count // step) * step
