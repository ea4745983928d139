"""Reads and frames put together: which phase belongs to which place (TagVision, IV.B)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from ...radio.channels import MAX_SLOPE_RAD_HZ, estimate_slope
from ...recording import TagReads

Pairing = Literal["nearest", "interpolate"]


def nearest_reads(
    frame_time_s: Float[np.ndarray, " frames"], read_time_s: Float[np.ndarray, " reads"]
) -> Int[np.ndarray, " frames"]:
    """The read nearest in time to each frame, argmin_i |t_i - t_k| (IV.B); of two equally near ones the earlier."""
    if not len(read_time_s):
        raise ValueError("There is no read to pair frames with; expected at least one.")
    after = np.clip(np.searchsorted(read_time_s, frame_time_s), 1, max(len(read_time_s) - 1, 1))
    after = np.minimum(after, len(read_time_s) - 1)
    before = np.maximum(after - 1, 0)
    nearer = frame_time_s - read_time_s[before] <= read_time_s[after] - frame_time_s
    return np.where(nearer, before, after)


def pair_nearest(
    frame_time_s: Float[np.ndarray, " frames"],
    place_m: Float[np.ndarray, "frames 3"],
    read_time_s: Float[np.ndarray, " reads"],
    *,
    max_gap_s: float = float("inf"),
) -> tuple[Int[np.ndarray, " frames"], Float[np.ndarray, "frames 3"], Bool[np.ndarray, " frames"]]:
    """The paper's pairing: every frame with its nearest read. Gives reads, places, and which pairs count.

    Pairs farther apart than `max_gap_s`, and frames without a place (NaN), do not count.
    """
    read = nearest_reads(frame_time_s, read_time_s)
    near = np.abs(read_time_s[read] - frame_time_s) <= max_gap_s
    return read, place_m, near & np.all(np.isfinite(place_m), axis=1)


def pair_interpolated(
    frame_time_s: Float[np.ndarray, " frames"],
    place_m: Float[np.ndarray, "frames 3"],
    read_time_s: Float[np.ndarray, " reads"],
    *,
    max_gap_s: float = float("inf"),
) -> tuple[Int[np.ndarray, " reads"], Float[np.ndarray, "reads 3"], Bool[np.ndarray, " reads"]]:
    """Every read with the place between the two frames around it: no time is rounded. As `pair_nearest` otherwise.

    At 0.5 m/s a read 15 ms from its frame is off by 0.3 rad, twice what the score's weight allows for.
    """
    every = np.arange(len(read_time_s))
    known = np.all(np.isfinite(place_m), axis=1)
    if not known.any():
        return every, np.full((len(read_time_s), 3), np.nan), np.zeros(len(read_time_s), bool)
    after = np.clip(np.searchsorted(frame_time_s, read_time_s), 1, max(len(frame_time_s) - 1, 1))
    after = np.minimum(after, len(frame_time_s) - 1)
    before = np.maximum(after - 1, 0)
    span = frame_time_s[after] - frame_time_s[before]
    share = np.divide(read_time_s - frame_time_s[before], span, out=np.zeros(len(span)), where=span > 0)
    # Beyond the frames at hand, one step is continued: the newest reads come after the newest frame's neighbour.
    inside = (share >= 0) & (share <= 1) & known[before] & known[after]
    gap = np.minimum(np.abs(read_time_s - frame_time_s[before]), np.abs(read_time_s - frame_time_s[after]))
    safe = np.clip(share, 0, 1)[:, None]
    place = place_m[before] * (1 - safe) + place_m[after] * safe
    return every, place, inside & (gap <= max_gap_s)


def unsigned_phase(reads: TagReads) -> Float[np.ndarray, " reads"]:
    """Phases that grow with distance, in [0, 2 pi)."""
    return np.mod(reads.phase_sign * np.asarray(reads.phase_rad, np.float64), 2 * np.pi)


def hop_slope(reads: TagReads, read_time_s: Float[np.ndarray, " reads"]) -> float:
    """The slope of phase over carrier (rad/Hz) that a tag's own hops show; NaN where they do not agree on one."""
    _, channel = np.unique(reads.carrier_hz, return_inverse=True)
    found = estimate_slope(unsigned_phase(reads), read_time_s, channel, np.asarray(reads.carrier_hz, np.float64))
    settled = found.residual_rad < np.pi and abs(found.slope_rad_hz) < MAX_SLOPE_RAD_HZ
    return found.slope_rad_hz if settled else float("nan")


def heading(
    time_s: Float[np.ndarray, " frames"], place_m: Float[np.ndarray, "frames 3"], smooth_s: float = 0.2
) -> Float[np.ndarray, "frames 3"]:
    """Unit vectors along the motion on the plane: the slope of a line fitted over +- `smooth_s`; NaN without motion."""
    out = np.full((len(time_s), 3), np.nan)
    known = np.flatnonzero(np.all(np.isfinite(place_m), axis=1))
    if len(known) < 2:
        return out
    when, where = time_s[known], place_m[known, :2]
    reach_s = smooth_s + 1e-6  # frames at the very edge count on both sides
    first = np.searchsorted(when, when - reach_s, side="left")
    last = np.searchsorted(when, when + reach_s, side="right")
    # Sums over every window from running sums, of centred numbers.
    sums = _running(np.column_stack([when, when**2, where, where * when[:, None]]))
    number = (last - first)[:, None].astype(np.float64)
    total = sums[last] - sums[first]
    covariance = total[:, 4:6] - total[:, :1] * total[:, 2:4] / number
    variance = total[:, 1:2] - total[:, :1] ** 2 / number
    slope = np.divide(covariance, variance, out=np.zeros_like(covariance), where=variance > 1e-9)
    speed = np.linalg.norm(slope, axis=1)
    moving = speed > 1e-3
    out[known[moving], :2] = slope[moving] / speed[moving, None]
    out[known[moving], 2] = 0.0
    return out


def _running(columns: Shaped[np.ndarray, "frames columns"]) -> np.ndarray:
    return np.concatenate([np.zeros((1, columns.shape[1])), np.cumsum(columns, axis=0)])
