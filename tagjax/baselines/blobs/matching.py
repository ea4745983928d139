"""How well a tag's phases agree with the range of each track, and which tag belongs to which track."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from ...core.numerics import SPEED_OF_LIGHT_M_S


def coherence_of_ranges(
    phase_rad: Float[np.ndarray, " reads"],
    carrier_hz: Float[np.ndarray, " reads"],
    channel: Int[np.ndarray, " reads"],
    range_m: Float[np.ndarray, "tracks reads"],
) -> Float[np.ndarray, " tracks"]:
    """Coherence of phases with ranges, modulo pi, for each track: sum_c |sum_{r in c} exp(2j residual)| / number of reads.

    The residual of a read is its phase (growing with distance) less 4 pi f / c times the range; channels have unknown
    offsets of their own. Reads at which a track's range is NaN are left out of that track. A channel with one read left adds
    its one to neither sum, since it would agree with anything; 0 where no other is left.
    """
    residual = phase_rad[None] - 4 * np.pi * carrier_hz[None] / SPEED_OF_LIGHT_M_S * range_m
    known = np.isfinite(residual)
    turned = np.where(known, np.exp(2j * np.where(known, residual, 0.0)), 0.0)
    member = channel[:, None] == np.unique(channel)[None]  # (reads, channels)
    sums, count = np.abs(turned @ member), known.astype(np.float64) @ member
    several = count > 1
    total = np.sum(count * several, axis=1)
    return np.divide(np.sum(sums * several, axis=1), total, out=np.zeros(len(total)), where=total > 0)
