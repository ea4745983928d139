"""The common reference frame of antennas and camera (Goller et al., III.D), and the pixels' way to the floor."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from ...core.geometry import backproject
from ...recording import Intrinsics, Recording, RecordingError

_TOLERANCE_M = 0.03
_DRAWS = 400
_LEAN = 0.26  # sine of 15 degrees: how far a camera that is mounted level may be rolled


@dataclasses.dataclass(frozen=True)
class Site:
    """The room frame: on the floor below antenna 1, x from antenna 1 to the last, z up; rows of `axes` in camera frame."""

    origin_m: Float[np.ndarray, " 3"]  # camera frame
    axes: Float[np.ndarray, "3 3"]

    def to_room(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the camera frame in the room frame."""
        return (points_m - self.origin_m) @ self.axes.T

    def to_camera(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the room frame in the camera frame."""
        return points_m @ self.axes + self.origin_m

    def pixel_on_plane(
        self, pixel: Float[np.ndarray, "points 2"], intrinsics: Intrinsics, height_m: float = 0.0
    ) -> Float[np.ndarray, "points 2"]:
        """Where the rays through pixels meet the plane at a height, room x and y; NaN where they never do.

        Lens distortion is not undone, as in the paper.
        """
        rays = np.stack(
            [
                (pixel[:, 0] - intrinsics.cx_px) / intrinsics.fx_px,
                (pixel[:, 1] - intrinsics.cy_px) / intrinsics.fy_px,
                np.ones(len(pixel)),
            ],
            axis=-1,
        )
        start, along = -self.axes @ self.origin_m, rays @ self.axes.T
        falls = (height_m - start[2]) * along[:, 2] > 0
        share = np.where(falls, (height_m - start[2]) / np.where(falls, along[:, 2], 1.0), np.nan)
        return start[:2] + share[:, None] * along[:, :2]


def level_site(antennas_m: Float[np.ndarray, "antennas 3"], antenna_height_m: float) -> Site:
    """The room frame of a camera that is mounted level: up is normal to the antennas' line and to the picture's rows.

    `antenna_height_m` is how high antenna 1 hangs over the floor. Raises `ValueError` where there are fewer than 2 antennas,
    their line is the rows', or the height is not positive.
    """
    line = np.asarray(antennas_m[-1] - antennas_m[0], np.float64)
    size = np.linalg.norm(line)
    up = np.cross(line / max(float(size), 1e-9), [1.0, 0.0, 0.0])
    if size < 1e-6 or np.linalg.norm(up) < 0.2:
        raise ValueError(
            f"{len(antennas_m)} antennas, {size:.2f} m from first to last, give no room frame: at least 2 are needed, in a "
            "line that is not the picture's rows. Find the floor by depth instead."
        )
    if not antenna_height_m > 0:
        raise ValueError(f"antenna_height_m is {antenna_height_m}; expected a positive height over the floor.")
    up = up / np.linalg.norm(up)
    up = up if up[1] < 0 else -up
    x = line / size
    return Site(np.asarray(antennas_m[0], np.float64) - antenna_height_m * up, np.stack([x, np.cross(up, x), up]))


def find_site(recording: Recording, *, num_frames: int = 5) -> Site:
    """The room frame of a recording: x along the antennas' line, z normal to the floor that the depth camera sees.

    The floor is the plane of most depth pixels (RANSAC) among those that lie level with the antennas' line and with the
    camera's rows and at least 1 m below the antennas. With one antenna x is where the camera looks. Raises
    `RecordingError` where no floor is found.
    """
    rng = np.random.default_rng(0)
    frames = np.unique(np.linspace(0, recording.num_frames - 1, num_frames).astype(int))
    points = np.concatenate(
        [backproject(recording.depth_metres(int(f)), recording.intrinsics).reshape(-1, 3) for f in frames]
    )
    points = points[points[:, 2] > 0].astype(np.float64)
    antennas = np.asarray(recording.antennas_m, np.float64)
    line = antennas[-1] - antennas[0]
    ahead = line if np.linalg.norm(line) > 1e-6 else np.array([0.0, 0.0, 1.0])
    ahead = ahead / np.linalg.norm(ahead)
    rows = np.array([1.0, 0.0, 0.0])
    # A camera beside the room looks along its own rows at the antennas' line: then the rows say nothing new.
    told = abs(ahead @ rows) < 0.9
    level = ahead if len(antennas) > 1 and np.linalg.norm(line) > 1e-6 else None
    best, most = None, 0
    sample = points[rng.integers(len(points), size=min(len(points), 6000))] if len(points) else points
    for _ in range(_DRAWS if len(sample) >= 3 else 0):
        a, b, c = sample[rng.integers(len(sample), size=3)]
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal)
        if size < 1e-6:
            continue
        normal = normal / size
        height = (antennas[0] - a) @ normal
        normal, height = (normal, height) if height > 0 else (-normal, -height)
        if height < 1.0 or (level is not None and abs(normal @ level) > 0.1) or (told and abs(normal @ rows) > _LEAN):
            continue
        near = np.abs((sample - a) @ normal) < _TOLERANCE_M
        if near.sum() > most:
            best, most = near, int(near.sum())
    if best is None or most < 0.02 * len(sample):
        raise RecordingError(
            f"{recording.name}: no floor found below the antennas in {len(frames)} depth frames. The camera must see some "
            "floor, be mounted level, and antennas_m must place the antennas overhead."
        )
    middle = sample[best].mean(axis=0)
    up = np.linalg.svd(sample[best] - middle, full_matrices=False)[2][-1]
    up = up if (antennas[0] - middle) @ up > 0 else -up
    x = ahead - (ahead @ up) * up
    if np.linalg.norm(x) < 1e-3:
        raise RecordingError(f"{recording.name}: the antennas' line is upright; a room frame needs it level.")
    x = x / np.linalg.norm(x)
    origin = antennas[0] - ((antennas[0] - middle) @ up) * up
    return Site(origin, np.stack([x, np.cross(up, x), up]))
