"""The camera's pose over a plane from points of known position (`solvePnP`)."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float

from ...image.checkerboard import CalibrationError, check_corners
from ...recording import Intrinsics
from .plane import PlaneCamera


def camera_pose(
    points_m: Float[np.ndarray, "points 3"], pixels: Float[np.ndarray, "points 2"], intrinsics: Intrinsics
) -> PlaneCamera:
    """The camera's pose from world points and their pixels: `solvePnP`, refined by Levenberg-Marquardt.

    One picture of the board in the world plane suffices (`Board.corners_m` moved to its position); several positions of
    the board together are more accurate. Raises `CalibrationError` for fewer than 4 points, or where no pose is found.
    """
    check_corners(pixels, points_m, "pose")
    if len(points_m) < 4:
        raise CalibrationError(f"Found {len(points_m)} points, expected at least 4 that are not in line. Add points.")
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    if spread[1] < 1e-3 * spread[0] or spread[0] == 0:
        raise CalibrationError(
            "All points lie in line, expected at least 4 that span a plane. Add points beside the line."
        )
    matrix, distortion = intrinsics.matrix(), np.array(intrinsics.distortion or (0.0,) * 5)
    world, seen = np.ascontiguousarray(points_m, np.float64), np.ascontiguousarray(pixels, np.float64)
    flags = cv2.SOLVEPNP_IPPE if spread[2] < 1e-6 * spread[0] else cv2.SOLVEPNP_SQPNP
    try:
        found, rotation, translation = cv2.solvePnP(world, seen, matrix, distortion, flags=flags)
    except cv2.error as error:
        raise CalibrationError(f"No pose explains the points ({error.err}).") from error
    if not found:
        raise CalibrationError("No pose explains the points. Check their order.")
    rotation, translation = cv2.solvePnPRefineLM(world, seen, matrix, distortion, rotation, translation)
    projected = cv2.projectPoints(world, rotation, translation, matrix, distortion)[0].reshape(-1, 2)
    error_px = float(np.sqrt(np.mean(np.sum((projected - seen) ** 2, axis=1))))
    camera = PlaneCamera(intrinsics, cv2.Rodrigues(rotation)[0], translation.ravel(), reprojection_px=error_px)
    if camera.position_m[2] <= 0:
        raise CalibrationError(
            f"The camera comes out below the plane, at z = {camera.position_m[2]:.3g} m; expected world axes with z up "
            "from the plane, right-handed. Reverse the order of the corners, or the y axis."
        )
    return camera
