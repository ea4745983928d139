"""Phase offsets of hopping channels: affine in frequency, with a slope specific to the reader."""

from __future__ import annotations

import dataclasses

import numpy as np

MAX_SLOPE_RAD_HZ = 1.0e-6
"""Largest slope of the search, either sign; 0.3 to 0.43 rad/MHz were measured (cable and group delay)."""


@dataclasses.dataclass(frozen=True)
class ChannelSlope:
    """Offsets are slope * (f - f0) + a residual of standard deviation `residual_rad` per hop; pi if the slope is
    unknown.
    """

    slope_rad_hz: float
    residual_rad: float
    coherence: float
    num_hops: int


def estimate_slope(
    phase_rad: np.ndarray,
    time_s: np.ndarray,
    channel: np.ndarray,
    carrier_hz: np.ndarray,
    *,
    max_gap_s: float = 0.15,
    min_coherence: float = 0.3,
    at_first: bool = False,
) -> ChannelSlope:
    """The slope that best explains the phase jumps at channel changes, corrected for motion by steps within channels.

    A distance x adds 4 pi x / c to it, 0.04 rad/MHz a metre: it is that at the mean distance, or with `at_first` that at the
    distance of the first read.
    Angles are doubled, so pi flips have no effect. If the jumps do not agree on a slope (coherence below
    `min_coherence`), or there are fewer than 4 hops, the offset after a hop is unknown: residual pi.
    """
    unknown = ChannelSlope(0.0, float(np.pi), 0.0, 0)
    if len(time_s) < 8:
        return unknown
    gap, same = np.diff(time_s), np.diff(channel) == 0
    hops = np.flatnonzero(~same & (gap < max_gap_s) & (np.diff(carrier_hz) != 0))
    if len(hops) < 4:
        return dataclasses.replace(unknown, num_hops=len(hops))
    step = np.diff(phase_rad)
    wrapped = (step + np.pi / 2) % np.pi - np.pi / 2
    rate = np.where(same & (gap > 1e-4), wrapped / np.maximum(gap, 1e-4), np.nan)
    jump, change, at = [], [], []
    turned = np.where(same & (gap < max_gap_s), wrapped, 0.0)
    for hop in hops:
        around = rate[max(0, hop - 4) : hop + 5]
        around = around[np.isfinite(around)]
        if around.size:
            turned[hop] = np.median(around) * gap[hop]
            jump.append(step[hop] - turned[hop])
            change.append(carrier_hz[hop + 1] - carrier_hz[hop])
            at.append(hop)
    # In units of c / (4 pi): by how much the distance to the first read tilts each jump.
    moved = np.cumsum(turned / carrier_hz[:-1])[at] if at_first else 0.0
    if len(jump) < 4:
        return dataclasses.replace(unknown, num_hops=len(jump))
    changes = np.asarray(change)
    jumps = np.asarray(jump) - changes * moved
    # Doubled phases make slopes ambiguous by pi over the channel raster; the smallest of the best is used.
    slopes = np.linspace(-MAX_SLOPE_RAD_HZ, MAX_SLOPE_RAD_HZ, 4001)
    signed = np.mean(np.cos(2 * (jumps[None, :] - slopes[:, None] * changes[None, :])), axis=1)
    near_best = signed >= signed.max() - 1e-3
    best = np.flatnonzero(near_best)[np.argmin(np.abs(slopes[near_best]))]
    coherence = float(signed[best])
    if coherence < min_coherence:
        return ChannelSlope(0.0, float(np.pi), coherence, len(jumps))
    residual = 0.5 * np.sqrt(max(1e-4, -2.0 * np.log(min(coherence, 1 - 1e-6))))
    return ChannelSlope(float(slopes[best]), float(residual), coherence, len(jumps))
