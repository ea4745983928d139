"""Phase noise by signal strength, and the share of pi flips, as measured on public R420 logs."""

from __future__ import annotations

import numpy as np

SLOPE_PER_DBM = -0.0374
"""d log10(sigma) / d RSSI: antenna-rail recordings, static tags, one channel."""

INTERCEPT = -3.56
"""log10(sigma / rad) at 0 dBm, the same fit: 0.031 rad at -55 dBm, 0.114 at -70."""

FLOOR_RAD = 0.016
"""Noise that a strong signal does not remove: 0.012 to 0.02 rad between recordings."""

UNKNOWN_RSSI_DBM = -60.0
"""Assumed where the reader reports no RSSI."""


def thermal_sigma_rad(rssi_dbm: np.ndarray) -> np.ndarray:
    """Standard deviation of phase noise at each RSSI (dBm), radians; multipath is not in it."""
    rssi = np.where(np.isfinite(rssi_dbm), rssi_dbm, UNKNOWN_RSSI_DBM)
    return np.hypot(FLOOR_RAD, 10.0 ** (SLOPE_PER_DBM * rssi + INTERCEPT))


def pi_flip_share(phase_rad: np.ndarray, time_s: np.ndarray, channel: np.ndarray, *, max_gap_s: float = 0.03) -> float:
    """Share of reads that carry an extra pi, from steps between adjacent reads of one channel.

    A step within 0.5 rad of pi is a transition; independent flips at share p make 2 p (1 - p) of them. NaN
    where fewer than 20 adjacent pairs are close enough in time to tell. A tag faster than about 2.2 m/s at 30 ms gaps moves by as
    much as a flip and would be taken for one.
    """
    if len(time_s) < 2:
        return float("nan")
    near = (np.diff(time_s) < max_gap_s) & (np.diff(channel) == 0)
    if near.sum() < 20:
        return float("nan")
    step = np.abs((np.diff(phase_rad)[near] + np.pi) % (2 * np.pi) - np.pi)
    transitions = float(np.mean(step > np.pi - 0.5))
    return 0.5 * (1.0 - np.sqrt(max(0.0, 1.0 - 2.0 * transitions)))
