"""Calibration of a camera from a folder of pictures, as `experiments.calibrate_camera` does it."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ...core.progress import OnProgress, unobserved
from ...image.checkerboard import Board, CalibrationError, CameraCalibration, calibrate, find_corners
from ...recording.image_files import write_image
from .board_drawing import LocatedBoard, draw_boards
from .calibration import camera_pose
from .plane import PlaneCamera, save_calibration

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")

MAX_ERROR_PX = 1.0
"""A larger reprojection error is reported as doubtful: corners are found to about a tenth of a pixel."""

_MAX_POSES = 9


@dataclasses.dataclass(frozen=True)
class PosePicture:
    """A picture of the board lying on the plane, with the position of its first corner and its rotation."""

    picture: str
    origin_m: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0  # rotation, anticlockwise seen from above


@dataclasses.dataclass(frozen=True)
class CalibrateSettings:
    """Inputs of a calibration. `pictures` is a folder; without `poses` only intrinsics are calibrated."""

    pictures: str
    out: str = "camera.json"
    board: Board = dataclasses.field(default_factory=Board)
    num_radial: int = 2
    poses: tuple[PosePicture, ...] = ()


@dataclasses.dataclass(frozen=True)
class FolderCalibration:
    """The result, the pictures with and without the board, and the boards of `poses` (without any, the worst one)."""

    camera: CameraCalibration
    plane: PlaneCamera | None
    used: tuple[str, ...]
    without_board: tuple[str, ...]
    boards: tuple[LocatedBoard, ...] = ()

    def summary(self) -> list[str]:
        """The result in words, line by line."""
        k, spread = self.camera.intrinsics, self.camera.uncertainty_px
        lines = [
            f"board found in {len(self.used)} of {len(self.used) + len(self.without_board)} pictures"
            + (f"; not in {', '.join(self.without_board)}" if self.without_board else ""),
            f"fx {k.fx_px:.2f} +- {spread[0]:.2f}  fy {k.fy_px:.2f} +- {spread[1]:.2f}  "
            f"cx {k.cx_px:.2f} +- {spread[2]:.2f}  cy {k.cy_px:.2f} +- {spread[3]:.2f} px",
            "distortion k1 k2 p1 p2 k3: " + " ".join(f"{value:.4f}" for value in k.distortion),
            f"reprojection error {self.camera.reprojection_px:.3f} px rms",
        ]
        if self.camera.reprojection_px > MAX_ERROR_PX:
            worst = int(np.argmax(self.camera.view_reprojection_px))
            lines.append(
                f"doubtful: above {MAX_ERROR_PX:g} px. The worst picture is {self.used[worst]}; is the board flat?"
            )
        if self.plane is None:
            lines.append("no pose: give poses=[{picture: ...}] with the board on the plane, for positions in the world")
        else:
            x, y, z = self.plane.position_m
            lines.append(
                f"camera at x {x:.3f} y {y:.3f} z {z:.3f} m; reprojection error {self.plane.reprojection_px:.3f} px rms"
            )
            lines += [
                f"doubtful: the pose explains {board.picture} to {board.reprojection_px:.2f} px rms only, above {MAX_ERROR_PX:g} px. "
                "Are its origin_m and turn_deg right, the board's size, and does it lie flat on the plane?"
                for board in self.boards
                if board.reprojection_px > MAX_ERROR_PX
            ]
        return lines


def read_picture(path: str | Path) -> UInt8[np.ndarray, "height width 3"]:
    """A picture file as RGB. Raises `CalibrationError` where it cannot be read."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise CalibrationError(f"{path}: no readable picture. Expected one of {', '.join(SUFFIXES)}.")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def calibrate_folder(settings: CalibrateSettings, *, on_progress: OnProgress = unobserved) -> FolderCalibration:
    """Find the board in every picture, calibrate, and find the camera's pose if `poses` are given.

    Raises `CalibrationError` for a missing folder, no pictures, pictures of several sizes, too few that show the board,
    and where the folder of `out` cannot be made.
    """
    _make_folder(Path(settings.out))
    folder = Path(settings.pictures)
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder. Give pictures=<folder of pictures of the checkerboard>.")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not files:
        raise CalibrationError(f"{folder}: no picture in it; expected files ending in {', '.join(SUFFIXES)}.")
    views, used, without, shapes = [], [], [], {}
    for number, path in enumerate(files):
        on_progress("find the board", number, len(files), path.name)
        picture = read_picture(path)
        shapes.setdefault(picture.shape[:2], path.name)
        corners = find_corners(picture, settings.board)
        (used if corners is not None else without).append(path.name)
        if corners is not None:
            views.append(corners)
    on_progress("find the board", len(files), len(files))
    if len(shapes) > 1:
        found = ", ".join(f"{width} x {height} ({name})" for (height, width), name in shapes.items())
        raise CalibrationError(
            f"{folder}: found pictures of several sizes: {found}; expected one size. Use pictures of one camera."
        )
    board = settings.board
    if not views:
        raise CalibrationError(
            f"{folder}: none of {len(files)} pictures shows a board of {board.columns} x {board.rows} squares with all its "
            f"{len(board.corners_m())} inner corners. Check columns and rows: they count squares, not corners."
        )
    height, width = next(iter(shapes))
    camera = calibrate(views, board, width, height, num_radial=settings.num_radial)
    if settings.poses:
        plane, boards = _pose(settings.poses, board, camera, (height, width))
        return FolderCalibration(camera, plane, tuple(used), tuple(without), boards)
    worst = int(np.argmax(camera.view_reprojection_px))
    held = camera_pose(board.corners_m(), views[worst], camera.intrinsics)
    seen = LocatedBoard(
        str(folder / used[worst]), views[worst], held, (0.0, 0.0), board, camera.view_reprojection_px[worst]
    )
    return FolderCalibration(camera, None, tuple(used), tuple(without), (seen,))


def _make_folder(out: Path) -> None:
    """Make the result's folder before any work."""
    if out.is_dir():
        raise CalibrationError(f"out={out} is a folder; expected a file, as {out / 'camera.json'}.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"out={out}: its folder cannot be made ({error}). Give another out=<file>.") from error


def _pose(
    poses: Sequence[PosePicture], board: Board, camera: CameraCalibration, shape: tuple[int, int]
) -> tuple[PlaneCamera, tuple[LocatedBoard, ...]]:
    points_m: list[Float[np.ndarray, "corners 3"]] = []
    pixels: list[Float[np.ndarray, "corners 2"]] = []
    for pose in poses:
        picture = read_picture(pose.picture)
        if picture.shape[:2] != shape:
            raise CalibrationError(
                f"{pose.picture}: {picture.shape[1]} x {picture.shape[0]} pixels; expected {shape[1]} x {shape[0]}, as "
                "the pictures for the intrinsics."
            )
        corners = find_corners(picture, board)
        if corners is None:
            raise CalibrationError(
                f"{pose.picture}: the board is not visible with all its inner corners. Take another picture."
            )
        c, s = np.cos(np.radians(pose.turn_deg)), np.sin(np.radians(pose.turn_deg))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        points_m.append(board.corners_m() @ turn.T + np.array([*pose.origin_m, 0.0]))
        pixels.append(corners)
    # Corners may be found from either end of the board; the order on which several positions agree is the right one.
    best: PlaneCamera | None = None
    order: list[Float[np.ndarray, "corners 2"]] = []
    for reversals in _reversals(len(poses)):
        turned = [seen[::-1] if reverse else seen for seen, reverse in zip(pixels, reversals, strict=True)]
        try:
            found = camera_pose(np.concatenate(points_m), np.concatenate(turned), camera.intrinsics)
        except CalibrationError:
            continue
        if best is None or found.reprojection_px < best.reprojection_px:
            best, order = found, turned
    if best is None:
        raise CalibrationError("No pose explains the pictures of the board on the plane. Check origin_m and turn_deg.")
    boards = []
    for pose, board_m, corners in zip(poses, points_m, order, strict=True):
        error_px = float(np.sqrt(np.mean(np.sum((best.to_picture(board_m) - corners) ** 2, axis=1))))
        x, y = float(board_m[0, 0]), float(board_m[0, 1])
        boards.append(LocatedBoard(pose.picture, corners, best, (x, y), board, error_px))
    return best, tuple(boards)


def _reversals(count: int) -> list[tuple[bool, ...]]:
    """Which boards may have been found from the other end; a single one defines the axes by itself."""
    if count == 1:
        return [(False,)]
    if count > _MAX_POSES:
        raise CalibrationError(f"Found {count} poses, expected at most {_MAX_POSES}. Leave some out.")
    return list(itertools.product((False, True), repeat=count))


def write_calibration(found: FolderCalibration, path: str | Path) -> None:
    """Write the calibration as JSON, which `load_calibration` reads if it has a pose."""
    save_calibration(
        found.camera.intrinsics if found.plane is None else found.plane,
        path,
        intrinsics_reprojection_px=found.camera.reprojection_px,
        views_reprojection_px=dict(zip(found.used, found.camera.view_reprojection_px, strict=True)),
        uncertainty_px=found.camera.uncertainty_px,
        without_board=found.without_board,
    )


def write_corners(found: FolderCalibration, path: str | Path) -> Path:
    """Draw the boards that determined the pose into a picture beside the calibration, and return its path."""
    path = Path(path)
    beside = path.with_name(f"{path.stem}_corners.png")
    sheet = draw_boards([(board, read_picture(board.picture)) for board in found.boards])
    write_image(beside, sheet)
    return beside
