"""Calibration of a pair of cameras from pictures of a checkerboard that both see at once."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float

from ..core.errors import RecordingError
from ..core.progress import OnProgress, unobserved
from ..image.checkerboard import Board, CalibrationError, CameraCalibration, calibrate, check_corners, find_corners
from ..recording.image_files import natural_sorted, read_colour
from .rectification import rectify, row_difference_px
from .rig import StereoRig, write_rig

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")

MAX_ROW_DIFFERENCE_PX = 0.5
"""Matching searches one row: a larger difference of rows (root mean square) is reported as doubtful."""

_MIN_AGREE = 0.9  # of the directions of the board's longest diagonal in both pictures: its cosine


@dataclasses.dataclass(frozen=True)
class StereoCalibration:
    """The result of `calibrate_pair`. Errors are root mean squares over corners."""

    rig: StereoRig
    left: CameraCalibration  # by itself
    right: CameraCalibration
    reprojection_px: float  # of the pair
    row_difference_px: float  # of the same corner in both rectified pictures

    def summary(self) -> list[str]:
        """The result in words, line by line."""
        rig, lines = self.rig, []
        for side, k, alone in (("left", rig.left, self.left), ("right", rig.right, self.right)):
            lines.append(
                f"{side}: fx {k.fx_px:.2f} fy {k.fy_px:.2f} cx {k.cx_px:.2f} cy {k.cy_px:.2f} px; reprojection error "
                f"{alone.reprojection_px:.3f} px rms by itself"
            )
        turn_deg = np.degrees(cv2.Rodrigues(np.asarray(rig.rotation, float))[0].ravel())
        shift_mm = 1000 * np.asarray(rig.translation_m)
        lines.append(
            f"baseline {1000 * rig.baseline_m:.1f} mm (translation {', '.join(f'{value:.1f}' for value in shift_mm)} mm), rotation "
            f"{', '.join(f'{value:.2f}' for value in turn_deg)} degrees about x, y, z"
        )
        lines.append(
            f"reprojection error {self.reprojection_px:.3f} px rms; rows of the rectified pictures differ by "
            f"{self.row_difference_px:.3f} px rms"
        )
        if self.row_difference_px > MAX_ROW_DIFFERENCE_PX:
            lines.append(
                f"doubtful: rows differ by more than {MAX_ROW_DIFFERENCE_PX:g} px. Were both pictures of a pair taken at the same "
                "time, with the board and both cameras held still?"
            )
        return lines


def calibrate_pair(
    left_px: Sequence[Float[np.ndarray, "corners 2"]],
    right_px: Sequence[Float[np.ndarray, "corners 2"]],
    board: Board,
    width: int,
    height: int,
    *,
    num_radial: int = 2,
) -> StereoCalibration:
    """Both cameras and their relative pose from the corners of boards seen by both (OpenCV's stereoCalibrate).

    Each camera is calibrated by itself first (`calibrate`, whose errors apply); the joint fit starts there. Where the board was
    found from its other end in the right picture, its corners are reversed. Raises `CalibrationError` for unusable corners and
    `RecordingError` for a pose that no stereo pair has, such as swapped cameras.
    """
    if len(left_px) != len(right_px):
        raise CalibrationError(f"{len(left_px)} views on the left, {len(right_px)} on the right; expected pairs.")
    model = board.corners_m()
    for number, view in enumerate(right_px):
        check_corners(view, model, f"right view {number}")
    alone = [calibrate(views, board, width, height, num_radial=num_radial) for views in (left_px, right_px)]
    right_px = [
        _same_order(one, other, number) for number, (one, other) in enumerate(zip(left_px, right_px, strict=True))
    ]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    if num_radial < 3:
        flags |= cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST
    if num_radial == 0:
        flags |= cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2
    first, second = (one.intrinsics for one in alone)
    fit: Any = cv2.stereoCalibrate  # its stubs have no overload with a flag and criteria
    pictured = [[np.asarray(view, np.float32).reshape(-1, 1, 2) for view in views] for views in (left_px, right_px)]
    try:
        rms, matrix_left, lens_left, matrix_right, lens_right, rotation, shift, *_ = fit(
            [model.astype(np.float32)] * len(left_px), *pictured,
            first.matrix(), np.array(first.distortion), second.matrix(), np.array(second.distortion), (width, height),
            flags=flags, criteria=(cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-9),
        )  # fmt: skip
    except cv2.error as error:
        raise CalibrationError(f"No pair of cameras fits the corners ({error.err}). Show other boards.") from error
    rig = StereoRig(
        _with(first, matrix_left, lens_left),
        _with(second, matrix_right, lens_right),
        np.asarray(rotation),
        np.ravel(shift),
    )
    rig.check("The calibrated pair")
    rows = row_difference_px(rig, rectify(rig), np.concatenate(list(left_px)), np.concatenate(right_px))
    return StereoCalibration(rig, alone[0], alone[1], float(rms), float(np.sqrt(np.mean(rows**2))))


def _same_order(left: np.ndarray, right: np.ndarray, number: int) -> np.ndarray:
    """The right view's corners in the order of the left one's: a board looks the same from its other end."""
    along, other = left[-1] - left[0], right[-1] - right[0]
    cosine = float(along @ other / max(np.linalg.norm(along) * np.linalg.norm(other), 1e-9))
    if abs(cosine) < _MIN_AGREE:
        raise CalibrationError(
            f"Pair {number}: the board is turned by {np.degrees(np.arccos(abs(cosine))):.0f} degrees between both pictures; expected "
            "pictures taken at the same time by cameras side by side. Are the pairs in the same order in both folders?"
        )
    return right if cosine > 0 else right[::-1]


def _with(k, matrix: np.ndarray, lens: np.ndarray):
    """Intrinsics with the values of a joint fit."""
    return dataclasses.replace(
        k,
        fx_px=float(matrix[0, 0]),
        fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]),
        cy_px=float(matrix[1, 2]),
        distortion=tuple(float(value) for value in np.ravel(lens)[:5]),
    )


@dataclasses.dataclass(frozen=True)
class CalibrateStereoSettings:
    """Two folders of pictures of the board: the n-th of one was taken at the same time as the n-th of the other."""

    left: str
    right: str
    out: str = "stereo.json"
    board: Board = dataclasses.field(default_factory=Board)
    num_radial: int = 2


def calibrate_stereo_folders(
    settings: CalibrateStereoSettings, *, on_progress: OnProgress = unobserved
) -> tuple[StereoCalibration, list[str]]:
    """Calibrate from two folders, write the camera file, and report line by line.

    Pictures are paired in natural order of their names. `on_progress` counts the pairs. Raises `CalibrationError` for folders that cannot be used, and errors
    as of `calibrate_pair`.
    """
    files = [_pictures(side, getattr(settings, side)) for side in ("left", "right")]
    if len(files[0]) != len(files[1]):
        raise CalibrationError(
            f"{len(files[0])} pictures in {settings.left}, {len(files[1])} in {settings.right}; expected pairs. Remove pictures "
            "that only one camera took."
        )
    views: tuple[list[np.ndarray], list[np.ndarray]] = ([], [])
    without, shape = [], None
    for number, pair in enumerate(zip(*files, strict=True)):
        on_progress("find the board", number, len(files[0]), pair[0].name)
        pictures = [_read(path) for path in pair]
        for path, picture in zip(pair, pictures, strict=True):
            shape = shape or picture.shape[:2]
            if picture.shape[:2] != shape:
                raise CalibrationError(
                    f"{path}: {picture.shape[1]} x {picture.shape[0]} pixels; expected {shape[1]} x {shape[0]} as in the first "
                    "picture. Use one resolution for both cameras."
                )
        corners = [find_corners(picture, settings.board) for picture in pictures]
        if corners[0] is None or corners[1] is None:
            without.append(pair[0].name)
            continue
        views[0].append(corners[0])
        views[1].append(corners[1])
    on_progress("find the board", len(files[0]), len(files[0]))
    assert shape is not None
    found = calibrate_pair(*views, settings.board, shape[1], shape[0], num_radial=settings.num_radial)
    write_rig(
        found.rig,
        settings.out,
        reprojection_px=found.reprojection_px,
        row_difference_px=found.row_difference_px,
        num_views=len(views[0]),
    )
    seen = f"both cameras see the board in {len(views[0])} of {len(files[0])} pairs"
    return found, [seen + (f"; not in {', '.join(without)}" if without else ""), *found.summary()]


def _pictures(side: str, folder: str) -> list[Path]:
    if not Path(folder).is_dir():
        raise CalibrationError(f"{side}={folder}: no such folder. Give a folder of pictures of the checkerboard.")
    files = natural_sorted(path for path in Path(folder).iterdir() if path.suffix.lower() in SUFFIXES)
    if not files:
        raise CalibrationError(f"{side}={folder}: no picture in it; expected files ending in {', '.join(SUFFIXES)}.")
    return files


def _read(path: Path) -> np.ndarray:
    try:
        return np.ascontiguousarray(read_colour(path))
    except RecordingError as error:
        raise CalibrationError(str(error)) from error
