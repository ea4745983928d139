"""When a tag's object begins to move, and how long a tracer takes to find it."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ..recording import Truth

SPEED_WINDOW_S = 0.2
"""Speeds are measured over this time, so that millimetres of noise in a true position are no motion."""


def first_motion(
    truth: Truth, epc: str, time_s: Float[np.ndarray, " time"], *, min_speed_m_s: float = 0.1
) -> int | None:
    """The first frame at which a tag moves at `min_speed_m_s` or faster; None if it never does.

    The speed is that of the true position over `SPEED_WINDOW_S` around the frame, or of the true range where no position
    is known. 0 if the truth holds neither: every frame then counts.
    """
    if epc in truth.tag_position_m:
        place = np.asarray(truth.tag_position_m[epc], np.float64)
    elif epc in truth.tag_range_m:
        place = np.asarray(truth.tag_range_m[epc], np.float64)[:, None]
    else:
        return 0
    half_s, last = 0.5 * SPEED_WINDOW_S + 1e-6, len(time_s) - 1
    before = np.searchsorted(time_s, time_s - half_s)
    after = np.minimum(np.searchsorted(time_s, time_s + half_s, side="right") - 1, last)
    # At a low frame rate the window holds the frame alone: take its neighbours.
    frame = np.arange(len(time_s))
    before = np.minimum(before, np.maximum(frame - 1, 0))
    after = np.maximum(after, np.minimum(frame + 1, last))
    with np.errstate(invalid="ignore", divide="ignore"):
        speed = np.linalg.norm(place[after] - place[before], axis=-1) / (time_s[after] - time_s[before])
    moving = np.flatnonzero(np.nan_to_num(speed) >= min_speed_m_s)
    return int(moving[0]) if len(moving) else None


def frames_in(seconds: float, time_s: Float[np.ndarray, " time"], *, minimum: int = 1) -> int:
    """How many frames cover a time, at the median frame rate."""
    if len(time_s) < 2:
        return minimum
    return max(minimum, int(np.ceil(seconds / np.median(np.diff(time_s)) - 1e-6)))


def time_to_lock(
    locked: Bool[np.ndarray, " time"],
    valid: Bool[np.ndarray, " time"],
    time_s: Float[np.ndarray, " time"],
    *,
    num_frames: int = 5,
) -> float:
    """Seconds from the first valid frame to the first of `num_frames` valid and locked frames in a row.

    Invalid frames are skipped: they neither interrupt nor lengthen the sequence. Infinite if there is no lock, NaN
    without a valid frame.
    """
    frames = np.flatnonzero(valid)
    if not len(frames):
        return float("nan")
    row = 0
    for i, good in enumerate(np.asarray(locked)[frames]):
        row = row + 1 if good else 0
        if row == num_frames:
            return float(time_s[frames[i - num_frames + 1]] - time_s[frames[0]])
    return float("inf")


def times_to_recover(
    locked: Bool[np.ndarray, " time"],
    visible: Bool[np.ndarray, " time"],
    time_s: Float[np.ndarray, " time"],
    *,
    num_frames: int = 5,
    hidden_frames: int = 3,
) -> tuple[float, ...]:
    """Seconds to lock again, one value for every reappearance of the object after `hidden_frames` or more.

    Each is `time_to_lock` from the reappearance to the next disappearance of that length: infinite without a lock in
    between, and left out where the object is visible for fewer than `num_frames` frames.
    """
    visible = np.asarray(visible, bool)
    edges = np.diff(np.concatenate([[0], visible.astype(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    long = begins[1:] - ends[:-1] >= hidden_frames
    starts = begins[1:][long]
    stops = [
        int(ends[:-1][long][number + 1]) if number + 1 < len(starts) else len(visible) for number in range(len(starts))
    ]
    times = []
    for start, stop in zip(starts, stops, strict=True):
        part = slice(int(start), stop)
        if np.sum(visible[part]) >= num_frames:
            times.append(time_to_lock(locked[part], visible[part], time_s[part], num_frames=num_frames))
    return tuple(times)
