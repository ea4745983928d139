"""What is measured of the camera: depth coverage, frame rate, dropped frames, and how much the picture moves."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from ..recording import Recording

MAX_FRAMES = 1800
"""Frames that are looked at: the first minute at 30 a second."""

_COLUMNS = 128


@dataclasses.dataclass(frozen=True)
class CameraLimits:
    """Values of the video; `motion` is by frame, 0 at the first."""

    depth_fraction: float  # of pixels with a depth
    frame_rate_hz: float
    dropped_fraction: float
    longest_step_s: float
    motion: np.ndarray  # (looked at,) mean change of brightness above the noise, 1/s
    step_s: np.ndarray  # (frames - 1,) times between frames


def measure_camera(
    recording: Recording, on_frame: Callable[[int, int], None] = lambda done, total: None
) -> CameraLimits:
    """The values of the video, from the first `MAX_FRAMES` frames. `on_frame(done, total)` is called after each.

    A step of n median steps counts as n - 1 dropped frames.
    """
    step_s = np.diff(recording.time_ns) * 1e-9
    median = float(np.median(step_s)) if step_s.size else float("nan")
    lost = np.maximum(np.rint(step_s / median) - 1, 0).sum() if step_s.size else 0
    count = min(recording.num_frames, MAX_FRAMES)
    stride = max(1, recording.intrinsics.width // _COLUMNS)
    depth, motion, before = [], np.zeros(count), None
    for frame in range(count):
        metres = recording.depth_metres(frame)
        depth.append(float(np.mean(metres > 0)))
        now = np.asarray(recording.colour[frame])[::stride, ::stride].mean(axis=-1, dtype=np.float32)
        if before is not None:
            change = np.abs(now - before)
            noise = 4.0 * float(np.median(change)) + 2.0
            motion[frame] = float(np.mean(np.maximum(change - noise, 0.0))) / max(float(step_s[frame - 1]), 1e-3)
        before = now
        on_frame(frame + 1, count)
    return CameraLimits(
        depth_fraction=float(np.mean(depth)),
        frame_rate_hz=recording.frame_rate_hz,
        dropped_fraction=float(lost / (lost + recording.num_frames)),
        longest_step_s=float(step_s.max(initial=0.0)),
        motion=motion,
        step_s=step_s,
    )
