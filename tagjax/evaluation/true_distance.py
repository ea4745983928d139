"""True distances of tags to antennas, at frames and at other times."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from ..recording import Recording

_MIN_KNOTS = 4


def true_distance_m(recording: Recording, epc: str, antenna: int) -> Float[np.ndarray, " frames"] | None:
    """A tag's true distance to an antenna (counted from 1) at every frame; None where the truth does not hold it.

    It is that of the tag's true position, or else the true range, which is known to antenna 1 only.
    """
    truth = recording.truth
    if truth is not None and epc in truth.tag_position_m:
        position_m = np.asarray(truth.tag_position_m[epc], np.float64)
        return np.linalg.norm(position_m - recording.antennas_m[antenna - 1], axis=-1)
    if truth is not None and antenna == 1 and epc in truth.tag_range_m:
        return np.asarray(truth.tag_range_m[epc], np.float64)
    return None


def at_times(
    frame_s: Float[np.ndarray, " frames"], distance_m: Float[np.ndarray, " frames"], time_s: Float[np.ndarray, " reads"]
) -> Float[np.ndarray, " reads"]:
    """A distance at other times: a cubic spline through the known frames, NaN outside of these and in gaps between them."""
    known = np.flatnonzero(np.isfinite(distance_m))
    if len(known) < _MIN_KNOTS:
        return np.full(len(time_s), np.nan)
    values = CubicSpline(frame_s[known], distance_m[known])(time_s)
    after = np.searchsorted(frame_s, time_s)
    around = np.clip(np.stack([after - 1, after]), 0, len(frame_s) - 1)
    inside = (time_s >= frame_s[known[0]]) & (time_s <= frame_s[known[-1]])
    return np.where(inside & np.isfinite(distance_m[around]).all(axis=0), values, np.nan)
