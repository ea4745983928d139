"""Where a simulated camera is, and where it looks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ...recording import Intrinsics


@dataclasses.dataclass(frozen=True)
class Viewpoint:
    """A camera in the world: `rotation` takes camera axes (x right, y down, z forward) to the world's."""

    intrinsics: Intrinsics
    position_m: np.ndarray  # (3,)
    rotation: np.ndarray  # (3, 3)

    def to_camera(self, points_m: np.ndarray) -> np.ndarray:
        """World points (..., 3) in the camera frame."""
        return (points_m - self.position_m) @ self.rotation


def look_at(
    intrinsics: Intrinsics,
    position_m: Sequence[float] | np.ndarray,
    target_m: Sequence[float] | np.ndarray,
    up: Sequence[float] | np.ndarray = (0.0, 0.0, 1.0),
) -> Viewpoint:
    """An upright camera at a position that looks at a target. Looking straight down or up, the picture's top is +x."""
    position = np.asarray(position_m, float)
    forward = np.asarray(target_m, float) - position
    if np.linalg.norm(forward) < 1e-9:
        raise ValueError(f"Camera position and target are both {position}; expected two different points.")
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, np.asarray(up, float))
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(forward, [1.0, 0.0, 0.0])
    right = right / np.linalg.norm(right)
    return Viewpoint(intrinsics, position, np.stack([right, np.cross(forward, right), forward], axis=1))


def moved_right(view: Viewpoint, distance_m: float) -> Viewpoint:
    """The same camera, moved along its own x axis."""
    return Viewpoint(view.intrinsics, view.position_m + distance_m * view.rotation[:, 0], view.rotation)


def view_key(view: Viewpoint) -> tuple[Intrinsics, bytes, bytes]:
    """A dictionary key that identifies a viewpoint."""
    return view.intrinsics, view.position_m.tobytes(), view.rotation.tobytes()
