"""How well a tag's phases agree with the range of each track."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int
from scipy.special import ive

from ...core.numerics import SPEED_OF_LIGHT_M_S


def coherent_evidence(
    phase_rad: Float[np.ndarray, " reads"],
    carrier_hz: Float[np.ndarray, " reads"],
    channel: Int[np.ndarray, " reads"],
    range_m: Float[np.ndarray, "tracks reads"],
    phase_std_rad: float,
) -> Float[np.ndarray, " tracks"]:
    """Log likelihood ratio, nats, of phases from a tag on each track and from a tag that stays where it is.

    sum_c log I0(k |sum_{r in c} exp(2j (phase_r - 4 pi f_r range_r / c))|) less the same with ranges of 0, where
    k = 1 / (2 phase_std_rad)^2: von Mises noise of the doubled phase, which pi flips leave as it is, and an unknown
    offset of each channel, over which the likelihood is integrated. So a channel's only read adds 0.

    `phase_rad` grows with distance. Reads at which a track's range is NaN are left out of both terms of that track.
    """
    known = np.isfinite(range_m)
    travel_rad = 4 * np.pi * carrier_hz / SPEED_OF_LIGHT_M_S * np.where(known, range_m, 0.0)
    member = (channel[:, None] == np.unique(channel)[None]).astype(np.float64)  # (reads, channels)
    moving = np.abs((known * np.exp(2j * (phase_rad[None] - travel_rad))) @ member)
    still = np.abs((known * np.exp(2j * phase_rad[None])) @ member)
    concentration = 1 / (2 * phase_std_rad) ** 2
    return np.sum(_log_i0(concentration * moving) - _log_i0(concentration * still), axis=1)


def _log_i0(x: np.ndarray) -> np.ndarray:
    return np.log(ive(0, x)) + x
