"""Rectification: both pictures of a pair as if the cameras had the same intrinsics and looked in one direction."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ..core.camera import Intrinsics
from ..core.errors import RecordingError
from .rig import StereoRig

_MAX_ZOOM = 3.0
"""A rectified focal length that differs by a larger factor shows cameras that look in different directions."""

_NEGLIGIBLE = 1e-9


@dataclasses.dataclass(frozen=True)
class Rectification:
    """Maps from rectified to original pictures. X_rectified = turn_left X_left, and likewise on the right.

    `camera` are the intrinsics of both rectified pictures; the right camera is `baseline_m` to the right. Maps are None for a
    pair that is rectified already.
    """

    camera: Intrinsics
    baseline_m: float
    turn_left: np.ndarray  # (3, 3)
    turn_right: np.ndarray  # (3, 3)
    maps_left: tuple[np.ndarray, np.ndarray] | None = None  # x and y for cv2.remap
    maps_right: tuple[np.ndarray, np.ndarray] | None = None

    def left(self, picture: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """The rectified left picture (bilinear)."""
        return _mapped(picture, self.maps_left)

    def right(self, picture: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width 3"]:
        """The rectified right picture (bilinear)."""
        return _mapped(picture, self.maps_right)

    def points(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the left camera's frame in the frame of the rectified one, such as antenna positions."""
        return points_m @ self.turn_left.T


def rectify(rig: StereoRig) -> Rectification:
    """The rectification of a checked pair (OpenCV's stereoRectify, by Bouguet's method: each camera turns by half).

    Pictures are enlarged so that no pixel lies outside of the originals. Raises `RecordingError` for cameras that look in too
    different directions.
    """
    if _is_rectified(rig):
        return Rectification(rig.left, rig.baseline_m, np.eye(3), np.eye(3))
    size = (rig.left.width, rig.left.height)
    lenses = [np.array(camera.distortion or (0.0,) * 5) for camera in (rig.left, rig.right)]
    turn_left, turn_right, left, right, *_ = cv2.stereoRectify(
        rig.left.matrix(), lenses[0], rig.right.matrix(), lenses[1], size,
        np.asarray(rig.rotation, float), np.asarray(rig.translation_m, float).reshape(3, 1),
        flags=cv2.CALIB_ZERO_DISPARITY, alpha=0,
    )  # fmt: skip
    focal = float(left[0, 0])
    if not rig.left.fx_px / _MAX_ZOOM <= focal <= rig.left.fx_px * _MAX_ZOOM:
        turn = np.degrees(np.linalg.norm(cv2.Rodrigues(np.asarray(rig.rotation, float))[0]))
        raise RecordingError(
            f"The rectified focal length is {focal:.4g} px, the left camera's {rig.left.fx_px:.4g} px (the cameras are turned by "
            f"{turn:.1f} degrees against each other); expected at most a factor of {_MAX_ZOOM:g}. Turn the cameras until their views "
            "overlap, and calibrate again with boards up to the pictures' edges."
        )
    camera = Intrinsics(focal, float(left[1, 1]), float(left[0, 2]), float(left[1, 2]), *size)
    return Rectification(
        camera,
        float(-right[0, 3] / right[0, 0]),
        turn_left,
        turn_right,
        _maps(rig.left, lenses[0], turn_left, left, size),
        _maps(rig.right, lenses[1], turn_right, right, size),
    )


def row_difference_px(
    rig: StereoRig,
    rectification: Rectification,
    left_px: Float[np.ndarray, "points 2"],
    right_px: Float[np.ndarray, "points 2"],
) -> Float[np.ndarray, " points"]:
    """By how many rows the same points differ in the rectified pictures; 0 for a perfect calibration."""
    matrix = rectification.camera.matrix()
    rows = [
        cv2.undistortPoints(
            np.asarray(pixels, np.float64).reshape(-1, 1, 2),
            camera.matrix(),
            np.array(camera.distortion or (0.0,) * 5),
            R=turn,
            P=matrix,
        )[:, 0, 1]
        for pixels, camera, turn in (
            (left_px, rig.left, rectification.turn_left),
            (right_px, rig.right, rectification.turn_right),
        )
    ]
    return rows[1] - rows[0]


def _is_rectified(rig: StereoRig) -> bool:
    plain = not any(rig.left.distortion) and dataclasses.replace(rig.left, distortion=()) == dataclasses.replace(
        rig.right, distortion=()
    )
    aligned = np.abs(np.asarray(rig.rotation) - np.eye(3)).max() < _NEGLIGIBLE
    return bool(
        plain
        and not any(rig.right.distortion)
        and aligned
        and np.abs(np.asarray(rig.translation_m)[1:]).max() < _NEGLIGIBLE
    )


def _maps(
    camera: Intrinsics, lens: np.ndarray, turn: np.ndarray, matrix: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    x, y = cv2.initUndistortRectifyMap(camera.matrix(), lens, turn, matrix, size, cv2.CV_32FC1)
    return np.asarray(x), np.asarray(y)


def _mapped(picture: np.ndarray, maps: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    return picture if maps is None else np.asarray(cv2.remap(picture, *maps, cv2.INTER_LINEAR))
