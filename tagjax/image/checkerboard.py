"""Checkerboards: their corners in pictures, and a camera's intrinsics from them (Zhang, 2000; OpenCV)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ..core.camera import Intrinsics

MIN_VIEWS = 3
"""Two views are the theoretical minimum (TagVision, III.B); with three, one bad view does not decide."""

MIN_TILT_DEG = 5.0
"""Boards that are all parallel leave the focal length undetermined."""

FOCAL_WIDTHS = (0.1, 20.0)
"""Plausible focal lengths in picture widths: from a fish-eye to a long lens."""


class CalibrationError(ValueError):
    """Pictures or corners from which no calibration can be computed."""


@dataclasses.dataclass(frozen=True)
class Board:
    """A checkerboard of `columns` x `rows` squares; the paper's has 7 x 5 of 41 mm, so 24 inner corners."""

    columns: int = 7
    rows: int = 5
    square_m: float = 0.041

    def __post_init__(self):
        if min(self.columns, self.rows) < 3 or self.columns == self.rows:
            raise ValueError(
                f"Found a board of {self.columns} x {self.rows} squares, expected at least 3 each way and different numbers: "
                "the orientation of a square board is ambiguous."
            )
        if not self.square_m > 0:
            raise ValueError(f"square_m is {self.square_m}; expected a positive length.")

    @property
    def pattern(self) -> tuple[int, int]:
        """Inner corners along columns and rows, as OpenCV counts them."""
        return (self.columns - 1, self.rows - 1)

    def corners_m(self) -> Float[np.ndarray, "corners 3"]:
        """Inner corners on the board's own plane z = 0, row by row, the first at the origin.

        x runs along the rows, y opposite to the order of the rows, so that z points out of the printed side.
        """
        x, y = np.meshgrid(np.arange(self.columns - 1), np.arange(self.rows - 1))
        return np.stack([x.ravel(), -y.ravel(), np.zeros(x.size)], axis=-1) * self.square_m


@dataclasses.dataclass(frozen=True)
class CameraCalibration:
    """The result of `calibrate`. Reprojection errors are root mean squares over corners."""

    intrinsics: Intrinsics
    reprojection_px: float
    view_reprojection_px: tuple[float, ...]  # of each view
    uncertainty_px: tuple[float, float, float, float]  # standard deviations of fx, fy, cx, cy


def find_corners(
    picture: UInt8[np.ndarray, "height width *channels"], board: Board
) -> Float[np.ndarray, "corners 2"] | None:
    """Inner corners of the board, pixels, in the order of `Board.corners_m`; None unless all of them are visible."""
    grey = picture if picture.ndim == 2 else cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    accurate = cv2.CALIB_CB_EXHAUSTIVE | cv2.CALIB_CB_ACCURACY
    found, corners = cv2.findChessboardCornersSB(grey, board.pattern, flags=accurate)
    if found:
        return np.asarray(corners, np.float64).reshape(-1, 2)
    # In poor light the histogram is equalised first, which shifts edges: corners are refined on the original picture.
    found, corners = cv2.findChessboardCornersSB(grey, board.pattern, flags=accurate | cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not found:
        return None
    refined = cv2.cornerSubPix(grey, np.asarray(corners, np.float32), (4, 4), (-1, -1), (3, 50, 1e-4))
    return np.asarray(refined, np.float64).reshape(-1, 2)


def calibrate(
    views_px: Sequence[Float[np.ndarray, "corners 2"]], board: Board, width: int, height: int, *, num_radial: int = 2
) -> CameraCalibration:
    """Intrinsics with distortion from the corners seen in several pictures of the board (Zhang's method).

    `num_radial`: 2 fits the paper's k1 and k2; 3 also fits k3 and the tangential terms; 0 assumes an ideal lens. Raises
    `CalibrationError` for too few views, a wrong number of corners, corners outside the picture, or boards that are all
    parallel.
    """
    if num_radial not in (0, 2, 3):
        raise ValueError(f"num_radial is {num_radial}; expected 0, 2 or 3.")
    model = board.corners_m()
    if len(views_px) < MIN_VIEWS:
        raise CalibrationError(
            f"{len(views_px)} pictures show the board; expected at least {MIN_VIEWS}, tilted in different ways."
        )
    for number, view in enumerate(views_px):
        check_corners(view, model, f"view {number}")
        if np.any(view < -0.5) or np.any(view > np.array([width, height]) - 0.5):
            raise CalibrationError(
                f"View {number} has corners from {view.min(axis=0)} to {view.max(axis=0)}; expected all within "
                f"{width} x {height} pixels. Are the pictures all of one size?"
            )
    flags = 0
    if num_radial < 3:
        flags |= cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if num_radial == 0:
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    objects = [model.astype(np.float32)] * len(views_px)
    pictured = [np.asarray(view, np.float32).reshape(-1, 1, 2) for view in views_px]
    try:
        rms, matrix, distortion, rotations, _, spread, _, errors = cv2.calibrateCameraExtended(
            objects, pictured, (width, height), np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise CalibrationError(
            f"No camera fits the corners ({error.err}). Show the board tilted in different ways."
        ) from error
    normals = np.stack([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    tilt_deg = float(np.degrees(np.arccos(np.clip(np.min(normals @ normals.T), -1.0, 1.0))))
    focal = np.array([matrix[0, 0], matrix[1, 1]]) / width
    plausible = np.all(np.isfinite(matrix)) and np.all((focal > FOCAL_WIDTHS[0]) & (focal < FOCAL_WIDTHS[1]))
    if tilt_deg < MIN_TILT_DEG or not plausible:
        raise CalibrationError(
            f"The boards differ in tilt by {tilt_deg:.1f} degrees at most, and the focal length comes out at "
            f"{focal[0]:.3g} picture widths; expected more than {MIN_TILT_DEG:g} degrees. Boards that are all parallel "
            f"leave the focal length undetermined: tilt them in different ways. Or the board is not of {board.columns} x "
            f"{board.rows} squares, and a part of it was detected as the whole."
        )
    return CameraCalibration(
        intrinsics=Intrinsics(
            fx_px=float(matrix[0, 0]),
            fy_px=float(matrix[1, 1]),
            cx_px=float(matrix[0, 2]),
            cy_px=float(matrix[1, 2]),
            width=width,
            height=height,
            distortion=tuple(float(k) for k in np.ravel(distortion)[:5]),
        ),
        reprojection_px=float(rms),
        view_reprojection_px=tuple(float(e) for e in np.ravel(errors)),
        uncertainty_px=tuple(float(s) for s in np.ravel(spread)[:4]),  # type: ignore[arg-type]
    )


def check_corners(pixels: np.ndarray, points_m: np.ndarray, where: str) -> None:
    """Raise `CalibrationError`, which names `where`, unless there is a finite pixel for each finite point."""
    if len(pixels) != len(points_m):
        raise CalibrationError(f"{where}: {len(pixels)} corners; expected {len(points_m)}.")
    if not (np.all(np.isfinite(pixels)) and np.all(np.isfinite(points_m))):
        raise CalibrationError(f"{where}: points that are not finite; expected numbers.")
