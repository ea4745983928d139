"""A calibrated camera over a plane (TagVision, Eqs. 2-3): from pixels to the plane and back; the calibration file."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from ...core.files import write_atomic
from ...core.json_text import parse_json
from ...core.results import finite_array
from ...recording import Intrinsics

FORMAT = "tagjax-camera"


@dataclasses.dataclass(frozen=True)
class PlaneCamera:
    """A calibrated camera over a plane: X_camera = rotation X_world + translation. World z is up from the plane z = 0.

    The lens is OpenCV's: x (1 + k1 r^2 + k2 r^4 + ...) (Eq. 3 of the paper has k1 and k2).
    """

    intrinsics: Intrinsics
    rotation: Float[np.ndarray, "3 3"]
    translation_m: Float[np.ndarray, " 3"]
    reprojection_px: float = float("nan")  # of the points that determined the pose

    def __post_init__(self):
        rotation = np.asarray(self.rotation)
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError("rotation is no rotation; expected orthonormal rows and determinant 1.")
        if not np.all(np.isfinite(self.translation_m)):
            raise ValueError(f"translation_m is {self.translation_m}; expected finite metres.")

    @property
    def position_m(self) -> Float[np.ndarray, " 3"]:
        """The camera's position in the world."""
        return -self.rotation.T @ self.translation_m

    def to_world(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the camera frame, such as antennas, in the world."""
        return (points_m - self.translation_m) @ self.rotation

    def to_camera(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the world in the camera frame."""
        return points_m @ self.rotation.T + self.translation_m

    def to_plane(self, pixels: Shaped[np.ndarray, "points 2"], height_m: float = 0.0) -> Float[np.ndarray, "points 3"]:
        """World points at height z = `height_m` seen at these pixels, with lens distortion corrected.

        NaN where the ray does not meet the plane in front of the camera. On the undistorted picture this is the plane's
        homography.
        """
        if not len(pixels):
            return np.empty((0, 3))
        k = self.intrinsics
        seen = np.ascontiguousarray(pixels, np.float64).reshape(-1, 1, 2)
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-9)
        ideal = cv2.undistortPoints(seen, k.matrix(), np.array(k.distortion or (0.0,) * 5), criteria=criteria)
        rays = np.concatenate([ideal.reshape(-1, 2), np.ones((len(pixels), 1))], axis=1) @ self.rotation
        origin = self.position_m
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = (height_m - origin[2]) / rays[:, 2]
        ahead = np.isfinite(scale) & (scale > 0)
        return np.where(ahead[:, None], origin + np.where(ahead, scale, 0.0)[:, None] * rays, np.nan)

    def to_picture(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 2"]:
        """Pixels of points of the world, with lens distortion; NaN for points that are not in front of the camera."""
        if not len(points_m):
            return np.empty((0, 2))
        k = self.intrinsics
        ahead = self.to_camera(points_m)[:, 2] > 0
        safe = np.where(ahead[:, None], points_m, self.position_m + self.rotation[2])
        pixels, _ = cv2.projectPoints(
            np.ascontiguousarray(safe, np.float64),
            cv2.Rodrigues(self.rotation)[0],
            self.translation_m,
            k.matrix(),
            np.array(k.distortion or (0.0,) * 5),
        )
        return np.where(ahead[:, None], pixels.reshape(-1, 2), np.nan)

    def metres_per_pixel(
        self, pixels: Shaped[np.ndarray, "points 2"], height_m: float = 0.0
    ) -> Float[np.ndarray, " points"]:
        """Side of a square on the plane with the area that one pixel covers; NaN beyond the horizon."""
        half = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        around = self.to_plane((np.asarray(pixels, np.float64)[:, None] + half).reshape(-1, 2), height_m)
        right, left, below, above = np.moveaxis(around.reshape(-1, 4, 3)[..., :2], 1, 0)
        across, along = right - left, below - above
        return np.sqrt(np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]))


def save_calibration(camera: PlaneCamera | Intrinsics, path: str | Path, **about: Any) -> None:
    """Write a calibration as JSON: a camera over a plane, or intrinsics without a pose; `about` is stored beside it."""
    plane = camera if isinstance(camera, PlaneCamera) else None
    intrinsics = camera.intrinsics if isinstance(camera, PlaneCamera) else camera
    values = {
        "format": FORMAT,
        "intrinsics": dataclasses.asdict(intrinsics),
        "rotation": None if plane is None else np.asarray(plane.rotation).tolist(),
        "translation_m": None if plane is None else np.asarray(plane.translation_m).tolist(),
        "reprojection_px": plane.reprojection_px if plane is not None and np.isfinite(plane.reprojection_px) else None,
        **about,
    }
    write_atomic(path, json.dumps(values, indent=1, allow_nan=False) + "\n")


def load_calibration(path: str | Path) -> PlaneCamera:
    """Read a calibration with a pose. Raises `ValueError` for any other file."""
    try:
        values = parse_json(Path(path).read_bytes())
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path}: no readable calibration ({error}). Make one with experiments.calibrate_camera."
        ) from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise ValueError(f"{path}: no calibration of format {FORMAT!r}. Make one with experiments.calibrate_camera.")
    if values.get("rotation") is None:
        raise ValueError(
            f"{path}: found intrinsics only, expected the camera's pose too. Calibrate again with "
            "'poses=[{picture: <the board lying on the plane>}]'."
        )
    try:
        fields = dict(values["intrinsics"])
        fields["distortion"] = tuple(fields["distortion"])
        intrinsics, error_px = Intrinsics(**fields), values.get("reprojection_px")
        intrinsics.check()
        return PlaneCamera(
            intrinsics,
            finite_array(values["rotation"], (3, 3), "rotation"),
            finite_array(values["translation_m"], (3,), "translation_m"),
            float("nan") if error_px is None else float(error_px),
        )
    except (KeyError, OverflowError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: damaged calibration ({type(error).__name__}: {error}). Make it again.") from error
