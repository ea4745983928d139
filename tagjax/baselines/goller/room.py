"""The room frame shared by antennas and camera (Goller et al., III.D), and rays of pixels intersected with a plane."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ...core.geometry import backproject
from ...recording import Intrinsics, Recording, RecordingError

_TOLERANCE_M = 0.03
_MIN_HEIGHT_M = 1.0  # of the antennas over the floor
_MIN_INLIERS = 0.02  # fraction of the depth pixels
_NUM_DRAWS = 400
_MAX_ROLL = 0.26  # sine of 15 degrees: the largest roll of a camera that counts as mounted level


@dataclasses.dataclass(frozen=True)
class RoomFrame:
    """Origin on the floor below antenna 1, x from antenna 1 to the last, z up. The rows of `axes` are in camera
    frame.
    """

    origin_m: Float[np.ndarray, " 3"]  # camera frame
    axes: Float[np.ndarray, "3 3"]

    def to_room(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the camera frame in the room frame."""
        return (points_m - self.origin_m) @ self.axes.T

    def to_camera(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the room frame in the camera frame."""
        return points_m @ self.axes + self.origin_m

    def pixels_on_plane(
        self, pixel: Float[np.ndarray, "points 2"], intrinsics: Intrinsics, height_m: float = 0.0
    ) -> Float[np.ndarray, "points 2"]:
        """Room x and y where the rays of pixels meet the plane at a height; NaN where they do not.

        Lens distortion is not corrected, as in the paper.
        """
        rays = np.stack(
            [
                (pixel[:, 0] - intrinsics.cx_px) / intrinsics.fx_px,
                (pixel[:, 1] - intrinsics.cy_px) / intrinsics.fy_px,
                np.ones(len(pixel)),
            ],
            axis=-1,
        )
        camera, direction = -self.axes @ self.origin_m, rays @ self.axes.T
        meets = (height_m - camera[2]) * direction[:, 2] > 0
        scale = np.where(meets, (height_m - camera[2]) / np.where(meets, direction[:, 2], 1.0), np.nan)
        return camera[:2] + scale[:, None] * direction[:, :2]


def level_room_frame(antennas_m: Float[np.ndarray, "antennas 3"], antenna_height_m: float) -> RoomFrame:
    """The room frame of a camera mounted level: up is normal to the line of antennas and to the picture's rows.

    `antenna_height_m` is the height of antenna 1 over the floor. Raises `ValueError` for fewer than 2 antennas, for a
    line of antennas parallel to the rows, and for a height that is not positive.
    """
    line = np.asarray(antennas_m[-1] - antennas_m[0], np.float64)
    length = np.linalg.norm(line)
    up = np.cross(line / max(float(length), 1e-9), [1.0, 0.0, 0.0])
    if length < 1e-6 or np.linalg.norm(up) < 0.2:
        raise ValueError(
            f"Found {len(antennas_m)} antennas, {length:.2f} m from first to last; expected at least 2 in a line that is "
            "not parallel to the picture's rows. Find the floor from depth instead."
        )
    if not antenna_height_m > 0:
        raise ValueError(f"antenna_height_m is {antenna_height_m}; expected a positive height over the floor.")
    up = up / np.linalg.norm(up)
    up = up if up[1] < 0 else -up
    x = line / length
    return RoomFrame(np.asarray(antennas_m[0], np.float64) - antenna_height_m * up, np.stack([x, np.cross(up, x), up]))


def find_room_frame(recording: Recording, *, num_frames: int = 5) -> RoomFrame:
    """The room frame of a recording: x along the line of antennas, z normal to the floor in the depth pictures.

    The floor is the plane with most depth pixels (RANSAC) among those parallel to the line of antennas and to the
    picture's rows and at least 1 m below the antennas. With one antenna x is the camera's viewing direction. Raises
    `RecordingError` where no floor is found.
    """
    rng = np.random.default_rng(0)
    frames = np.unique(np.linspace(0, recording.num_frames - 1, num_frames).astype(int))
    points = np.concatenate(
        [backproject(recording.depth_metres(int(f)), recording.intrinsics).reshape(-1, 3) for f in frames]
    )
    points = points[points[:, 2] > 0].astype(np.float64)
    sample = points[rng.integers(len(points), size=min(len(points), 6000))] if len(points) else points
    antennas = np.asarray(recording.antennas_m, np.float64)
    inliers = _floor_inliers(sample, antennas, rng)
    if inliers is None:
        raise RecordingError(
            f"{recording.name}: no floor found below the antennas in {len(frames)} depth frames; expected a camera mounted "
            "level that sees some floor, and antennas_m overhead. Check both."
        )
    middle = sample[inliers].mean(axis=0)
    up = np.linalg.svd(sample[inliers] - middle, full_matrices=False)[2][-1]
    up = up if (antennas[0] - middle) @ up > 0 else -up
    ahead = _horizontal(antennas)
    x = ahead - (ahead @ up) * up
    if np.linalg.norm(x) < 1e-3:
        raise RecordingError(
            f"{recording.name}: the line of antennas is vertical; expected a level one for a room frame."
        )
    x = x / np.linalg.norm(x)
    origin = antennas[0] - ((antennas[0] - middle) @ up) * up
    return RoomFrame(origin, np.stack([x, np.cross(up, x), up]))


def _horizontal(antennas_m: Float[np.ndarray, "antennas 3"]) -> Float[np.ndarray, " 3"]:
    """Unit vector along the line of antennas; the viewing direction for a single one."""
    line = antennas_m[-1] - antennas_m[0]
    ahead = line if np.linalg.norm(line) > 1e-6 else np.array([0.0, 0.0, 1.0])
    return ahead / np.linalg.norm(ahead)


def _floor_inliers(
    points_m: Float[np.ndarray, "points 3"], antennas_m: Float[np.ndarray, "antennas 3"], rng: np.random.Generator
) -> Bool[np.ndarray, " points"] | None:
    """Points on the plane of most points among the planes that may be the floor; None without one."""
    ahead, rows = _horizontal(antennas_m), np.array([1.0, 0.0, 0.0])
    has_line = np.linalg.norm(antennas_m[-1] - antennas_m[0]) > 1e-6
    # A line of antennas parallel to the rows makes the test of roll redundant.
    check_roll = abs(ahead @ rows) < 0.9
    best, num_inliers = None, 0
    for _ in range(_NUM_DRAWS if len(points_m) >= 3 else 0):
        a, b, c = points_m[rng.integers(len(points_m), size=3)]
        normal = np.cross(b - a, c - a)
        length = np.linalg.norm(normal)
        if length < 1e-6:
            continue
        normal = normal / length
        height = (antennas_m[0] - a) @ normal
        normal, height = (normal, height) if height > 0 else (-normal, -height)
        tilted = (has_line and abs(normal @ ahead) > 0.1) or (check_roll and abs(normal @ rows) > _MAX_ROLL)
        if height < _MIN_HEIGHT_M or tilted:
            continue
        near = np.abs((points_m - a) @ normal) < _TOLERANCE_M
        if near.sum() > num_inliers:
            best, num_inliers = near, int(near.sum())
    return best if num_inliers >= _MIN_INLIERS * len(points_m) else None
