"""A small independent reader simulation for the tests of the radio side (plain NumPy, two-ray channel)."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from tagjax.recording import TagReads

C = 299_792_458.0


def smooth_path(rng, max_speed_m_s, duration_s):
    """A random smooth distance over time (function of seconds), never nearer than 1.5 m."""
    knots = np.linspace(0, duration_s, int(duration_s * 4 / 3) + 2)
    grid = np.linspace(0, duration_s, 4000)
    speed = CubicSpline(knots, rng.uniform(-max_speed_m_s, max_speed_m_s, len(knots)))(grid)
    speed = np.clip(speed, -max_speed_m_s, max_speed_m_s)
    x = np.concatenate([[0.0], np.cumsum((speed[1:] + speed[:-1]) / 2 * np.diff(grid))])
    x = x - x.min() + 1.5
    return lambda t: np.interp(t, grid, x)


def simulate_reads(
    rng,
    path,
    duration_s,
    *,
    rate_hz=45.0,
    flip_share=0.05,
    num_channels=16,
    first_hz=920.625e6,
    spacing_hz=0.25e6,
    slope_rad_hz=0.42e-6,
    reflector=0.3,
    sigma_rad=0.08,
):
    """Reads of one tag "A": jittered schedule, 0.203 s dwell, affine channel offsets, a reflector, pi flips."""
    time_s = np.cumsum(rng.gamma(4, 1 / rate_hz / 4, int(duration_s * rate_hz * 1.6)))
    time_s = time_s[time_s < duration_s]
    channel = rng.permutation(num_channels)[(time_s // 0.203).astype(int) % num_channels]
    carrier = first_hz + spacing_hz * channel
    direct = path(time_s)
    reflected = np.sqrt(direct**2 + 1.5**2) + 0.3
    h = np.exp(-2j * np.pi * carrier * direct / C) / direct
    h = h + reflector * np.exp(-2j * np.pi * carrier * reflected / C) / reflected
    count = len(time_s)
    phase = -np.angle(h**2) + 1.1 + slope_rad_hz * (carrier - first_hz) + rng.normal(0, sigma_rad, count)
    phase = phase + np.pi * (rng.random(count) < flip_share)
    return TagReads(
        epc=np.full(count, "A"),
        time_ns=(time_s * 1e9).astype(np.int64),
        antenna=np.ones(count, np.int16),
        carrier_hz=carrier,
        phase_rad=np.mod(phase, 2 * np.pi),
        rssi_dbm=np.full(count, -60.0, np.float32),
        doppler_hz=np.full(count, np.nan, np.float32),
    )
