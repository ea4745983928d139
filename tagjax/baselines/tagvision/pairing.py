"""Pairing of reads and frames: the position of a candidate at each phase (TagVision, IV.B); direction of motion."""

from __future__ import annotations

from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

Pairing = Literal["nearest", "interpolate"]


def nearest_reads(
    frame_time_s: Float[np.ndarray, " frames"], read_time_s: Float[np.ndarray, " reads"]
) -> Int[np.ndarray, " frames"]:
    """The read nearest in time to each frame, argmin_i |t_i - t_k| (IV.B); of two equally near ones the earlier."""
    if not len(read_time_s):
        raise ValueError("Found no read to pair with frames, expected at least one.")
    before, after = _neighbours(read_time_s, frame_time_s)
    nearer = frame_time_s - read_time_s[before] <= read_time_s[after] - frame_time_s
    return np.where(nearer, before, after)


def pair_nearest(
    frame_time_s: Float[np.ndarray, " frames"],
    position_m: Float[np.ndarray, "frames 3"],
    read_time_s: Float[np.ndarray, " reads"],
    *,
    max_gap_s: float = float("inf"),
) -> tuple[Int[np.ndarray, " frames"], Float[np.ndarray, "frames 3"], Bool[np.ndarray, " frames"]]:
    """The paper's pairing: reads frame with its nearest read. Returns read indices, positions, and which pairs are
    valid.

    Pairs farther apart in time than `max_gap_s`, and frames without a position (NaN), are not valid.
    """
    read = nearest_reads(frame_time_s, read_time_s)
    near = np.abs(read_time_s[read] - frame_time_s) <= max_gap_s
    return read, position_m, near & np.all(np.isfinite(position_m), axis=1)


def pair_interpolated(
    frame_time_s: Float[np.ndarray, " frames"],
    position_m: Float[np.ndarray, "frames 3"],
    read_time_s: Float[np.ndarray, " reads"],
    *,
    max_gap_s: float = float("inf"),
) -> tuple[Int[np.ndarray, " reads"], Float[np.ndarray, "reads 3"], Bool[np.ndarray, " reads"]]:
    """Every read with the position interpolated between the two frames around it; otherwise as `pair_nearest`.

    At 0.5 m/s a read 15 ms from its frame has an error of 0.3 rad, twice the sigma of the score's weight.
    """
    reads = np.arange(len(read_time_s))
    known = np.all(np.isfinite(position_m), axis=1)
    if not known.any():
        return reads, np.full((len(read_time_s), 3), np.nan), np.zeros(len(read_time_s), bool)
    before, after = _neighbours(frame_time_s, read_time_s)
    span = frame_time_s[after] - frame_time_s[before]
    fraction = np.divide(read_time_s - frame_time_s[before], span, out=np.zeros(len(span)), where=span > 0)
    inside = (fraction >= 0) & (fraction <= 1) & known[before] & known[after]
    gap = np.minimum(np.abs(read_time_s - frame_time_s[before]), np.abs(read_time_s - frame_time_s[after]))
    weight = np.clip(fraction, 0, 1)[:, None]
    position = position_m[before] * (1 - weight) + position_m[after] * weight
    return reads, position, inside & (gap <= max_gap_s)


def _neighbours(
    time_s: Float[np.ndarray, " times"], at_s: Float[np.ndarray, " at"]
) -> tuple[Int[np.ndarray, " at"], Int[np.ndarray, " at"]]:
    """Indices of the last time before and the first one after each `at_s`; of the outermost two beyond the ends."""
    after = np.clip(np.searchsorted(time_s, at_s), 1, max(len(time_s) - 1, 1))
    after = np.minimum(after, len(time_s) - 1)
    return np.maximum(after - 1, 0), after


def motion_direction(
    time_s: Float[np.ndarray, " frames"], position_m: Float[np.ndarray, "frames 3"], smooth_s: float = 0.2
) -> Float[np.ndarray, "frames 3"]:
    """Unit vectors of the motion on the plane: the slope of a line fitted over +- `smooth_s`; NaN without motion."""
    out = np.full((len(time_s), 3), np.nan)
    known = np.flatnonzero(np.all(np.isfinite(position_m), axis=1))
    if len(known) < 2:
        return out
    when, where = time_s[known], position_m[known, :2]
    reach_s = smooth_s + 1e-6  # includes frames exactly at the edge
    first = np.searchsorted(when, when - reach_s, side="left")
    last = np.searchsorted(when, when + reach_s, side="right")
    # Sums over reads window from running sums, of centred numbers.
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
