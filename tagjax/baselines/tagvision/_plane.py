"""From the picture to a plane of the world and back (TagVision, Eqs. 2-3), and the calibration file."""

from __future__ import annotations

import dataclasses
import json
import reprlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, Shaped

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
    reprojection_px: float = float("nan")  # of the points the pose was found from

    def __post_init__(self):
        turn = np.asarray(self.rotation)
        if not np.allclose(turn @ turn.T, np.eye(3), atol=1e-6) or np.linalg.det(turn) < 0:
            raise ValueError("rotation is no rotation; expected orthonormal rows and determinant 1.")
        if not np.all(np.isfinite(self.translation_m)):
            raise ValueError(f"translation_m is {self.translation_m}; expected finite metres.")

    @property
    def position_m(self) -> Float[np.ndarray, " 3"]:
        """The camera's place in the world."""
        return -self.rotation.T @ self.translation_m

    def to_world(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the camera frame (antennas, say) in the world."""
        return (points_m - self.translation_m) @ self.rotation

    def to_camera(self, points_m: Float[np.ndarray, "points 3"]) -> Float[np.ndarray, "points 3"]:
        """Points of the world in the camera frame."""
        return points_m @ self.rotation.T + self.translation_m

    def to_plane(self, pixels: Shaped[np.ndarray, "points 2"], height_m: float = 0.0) -> Float[np.ndarray, "points 3"]:
        """World points of height z = `height_m` that are seen at these pixels; the lens is undone first.

        NaN where the line of sight does not meet the plane in front of the camera. On the undistorted picture this is
        the plane's homography.
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
        """Pixels at which points of the world are seen, through the lens; NaN for points not in front of the camera."""
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
        """Side of the square on the plane that has the area one pixel sees; NaN beyond the horizon."""
        half = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
        around = self.to_plane((np.asarray(pixels, np.float64)[:, None] + half).reshape(-1, 2), height_m)
        right, left, below, above = np.moveaxis(around.reshape(-1, 4, 3)[..., :2], 1, 0)
        across, along = right - left, below - above
        return np.sqrt(np.abs(across[:, 0] * along[:, 1] - across[:, 1] * along[:, 0]))


def save_camera(camera: PlaneCamera, path: str | Path, **said: Any) -> None:
    """Write a calibration as JSON; `said` is kept beside it (how well it fits, from what)."""
    k = camera.intrinsics
    values = {
        "format": FORMAT,
        "intrinsics": dataclasses.asdict(k),
        "rotation": np.asarray(camera.rotation).tolist(),
        "translation_m": np.asarray(camera.translation_m).tolist(),
        "reprojection_px": camera.reprojection_px if np.isfinite(camera.reprojection_px) else None,
        **said,
    }
    Path(path).write_text(json.dumps(values, indent=1, allow_nan=False) + "\n")


def load_camera(path: str | Path) -> PlaneCamera:
    """Read a calibration. Raises `ValueError` for what is none."""
    try:
        values = json.loads(Path(path).read_text())
    except (OSError, ValueError) as error:
        raise ValueError(
            f"{path}: no readable calibration ({error}). Make one with experiments.calibrate_camera."
        ) from error
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise ValueError(f"{path}: no calibration of format {FORMAT!r}. Make one with experiments.calibrate_camera.")
    if values.get("rotation") is None:
        raise ValueError(
            f"{path}: holds intrinsics only; expected the camera's place too. Calibrate again with "
            "'poses=[{picture: <the board lying on the plane>}]'."
        )
    try:
        intrinsics = dict(values["intrinsics"])
        intrinsics["distortion"] = tuple(intrinsics["distortion"])
        lens, error_px = Intrinsics(**intrinsics), values.get("reprojection_px")
        lens.check()
        return PlaneCamera(
            lens,
            _numbers(values, "rotation", (3, 3)),
            _numbers(values, "translation_m", (3,)),
            float("nan") if error_px is None else float(error_px),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: damaged calibration ({type(error).__name__}: {error}). Make it again.") from error


def _numbers(values: dict[str, Any], name: str, shape: tuple[int, ...]) -> np.ndarray:
    """One of a file's arrays. Raises `ValueError` (ragged lists do as well) where it is not of finite numbers."""
    array = np.asarray(values[name])
    if array.dtype.kind not in "iuf" or array.shape != shape or not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is {reprlib.repr(values[name])}; expected finite numbers of shape {shape}")
    return array.astype(np.float64)
