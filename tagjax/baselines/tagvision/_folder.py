"""A camera calibrated from folders of pictures: what `experiments.calibrate_camera` does."""

from __future__ import annotations

import dataclasses
import itertools
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ._calibration import Board, CalibrationError, CameraCalibration, calibrate, find_corners, locate
from ._drawing import BoardSeen, draw_boards
from ._plane import FORMAT, PlaneCamera

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff")

GOOD_PX = 1.0
"""A reprojection error above this is reported as doubtful: corners are found to a tenth of a pixel or so."""

_MOST_POSES = 9


@dataclasses.dataclass(frozen=True)
class PosePicture:
    """A picture of the board lying on the plane, and where: its first corner, and how far it is turned."""

    picture: str
    origin_m: tuple[float, float] = (0.0, 0.0)
    turn_deg: float = 0.0  # anticlockwise, seen from above


@dataclasses.dataclass(frozen=True)
class CalibrateSettings:
    """What is calibrated from what. `pictures` is a folder; `poses` may be empty: intrinsics only."""

    pictures: str
    out: str = "camera.json"
    board: Board = dataclasses.field(default_factory=Board)
    num_radial: int = 2
    poses: tuple[PosePicture, ...] = ()


@dataclasses.dataclass(frozen=True)
class FolderCalibration:
    """The result, in which pictures the board was found, and those of `poses` (without any, the one that fits worst)."""

    camera: CameraCalibration
    plane: PlaneCamera | None
    used: tuple[str, ...]
    without_board: tuple[str, ...]
    boards: tuple[BoardSeen, ...] = ()

    def said(self) -> list[str]:
        """What a user wants to know, line by line."""
        k, spread = self.camera.intrinsics, self.camera.uncertainty_px
        lines = [
            f"board found in {len(self.used)} of {len(self.used) + len(self.without_board)} pictures"
            + (f"; not in {', '.join(self.without_board)}" if self.without_board else ""),
            f"fx {k.fx_px:.2f} +- {spread[0]:.2f}  fy {k.fy_px:.2f} +- {spread[1]:.2f}  "
            f"cx {k.cx_px:.2f} +- {spread[2]:.2f}  cy {k.cy_px:.2f} +- {spread[3]:.2f} px",
            "distortion k1 k2 p1 p2 k3: " + " ".join(f"{value:.4f}" for value in k.distortion),
            f"reprojection error {self.camera.reprojection_px:.3f} px rms",
        ]
        if self.camera.reprojection_px > GOOD_PX:
            worst = int(np.argmax(self.camera.view_reprojection_px))
            lines.append(f"doubtful: above {GOOD_PX:g} px. The worst picture is {self.used[worst]}; is the board flat?")
        if self.plane is None:
            lines.append("no pose: give poses=[{picture: ...}] with the board on the plane, for world places")
        else:
            x, y, z = self.plane.position_m
            lines.append(
                f"camera at x {x:.3f} y {y:.3f} z {z:.3f} m; reprojection error {self.plane.reprojection_px:.3f} px rms"
            )
            lines += [
                f"doubtful: the pose explains {board.picture} to {board.reprojection_px:.2f} px rms only, above {GOOD_PX:g} px. "
                "Are its origin_m and turn_deg right, the board's size, and does it lie flat on the plane?"
                for board in self.boards
                if board.reprojection_px > GOOD_PX
            ]
        return lines


def read_picture(path: str | Path) -> UInt8[np.ndarray, "height width 3"]:
    """A picture file as RGB. Raises `CalibrationError` where it is none."""
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is None:
        raise CalibrationError(f"{path}: no readable picture. Expected one of {', '.join(SUFFIXES)}.")
    return np.asarray(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))


def calibrate_folder(settings: CalibrateSettings) -> FolderCalibration:
    """Find the board in every picture, calibrate, and place the camera where poses are given.

    Raises `CalibrationError` for no folder, no pictures, pictures of several sizes, or too few that show the board, and
    where the folder of `out` cannot be made.
    """
    _make_room(Path(settings.out))
    folder = Path(settings.pictures)
    if not folder.is_dir():
        raise CalibrationError(f"{folder}: no such folder. Give pictures=<folder of pictures of the checkerboard>.")
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES)
    if not files:
        raise CalibrationError(f"{folder}: no picture in it; expected files ending in {', '.join(SUFFIXES)}.")
    views, used, without, shapes = [], [], [], {}
    for path in files:
        picture = read_picture(path)
        shapes.setdefault(picture.shape[:2], path.name)
        corners = find_corners(picture, settings.board)
        (used if corners is not None else without).append(path.name)
        if corners is not None:
            views.append(corners)
    if len(shapes) > 1:
        found = ", ".join(f"{width} x {height} ({name})" for (height, width), name in shapes.items())
        raise CalibrationError(f"{folder}: pictures of several sizes: {found}; expected one camera's, all of one size.")
    board = settings.board
    if not views:
        raise CalibrationError(
            f"{folder}: none of {len(files)} pictures shows a board of {board.columns} x {board.rows} squares with all its "
            f"{len(board.corners_m())} inner corners. Are columns and rows right? They count squares, not corners."
        )
    height, width = next(iter(shapes))
    camera = calibrate(views, board, width, height, num_radial=settings.num_radial)
    if settings.poses:
        plane, boards = _placed(settings.poses, board, camera, (height, width))
        return FolderCalibration(camera, plane, tuple(used), tuple(without), boards)
    worst = int(np.argmax(camera.view_reprojection_px))
    held = locate(board.corners_m(), views[worst], camera.intrinsics)
    seen = BoardSeen(
        str(folder / used[worst]), views[worst], held, (0.0, 0.0), board, camera.view_reprojection_px[worst]
    )
    return FolderCalibration(camera, None, tuple(used), tuple(without), (seen,))


def _make_room(out: Path) -> None:
    """Make the folder that the result will lie in, before any work."""
    if out.is_dir():
        raise CalibrationError(f"out={out} is a folder; expected a file, as {out / 'camera.json'}.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CalibrationError(f"out={out}: its folder cannot be made ({error}). Give another out=<file>.") from error


def _placed(
    poses: Sequence[PosePicture], board: Board, camera: CameraCalibration, shape: tuple[int, int]
) -> tuple[PlaneCamera, tuple[BoardSeen, ...]]:
    places: list[Float[np.ndarray, "corners 3"]] = []
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
            raise CalibrationError(f"{pose.picture}: the board does not show with all its inner corners.")
        c, s = np.cos(np.radians(pose.turn_deg)), np.sin(np.radians(pose.turn_deg))
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        places.append(board.corners_m() @ turn.T + np.array([*pose.origin_m, 0.0]))
        pixels.append(corners)
    # Corners may be found from either end of the board: what several places agree on is right.
    best: PlaneCamera | None = None
    order: list[Float[np.ndarray, "corners 2"]] = []
    for flips in _flips(len(poses)):
        turned = [seen[::-1] if flip else seen for seen, flip in zip(pixels, flips, strict=True)]
        try:
            found = locate(np.concatenate(places), np.concatenate(turned), camera.intrinsics)
        except CalibrationError:
            continue
        if best is None or found.reprojection_px < best.reprojection_px:
            best, order = found, turned
    if best is None:
        raise CalibrationError(
            "No pose explains the pictures of the board on the plane: are origin_m and turn_deg right?"
        )
    boards = []
    for pose, place, corners in zip(poses, places, order, strict=True):
        error_px = float(np.sqrt(np.mean(np.sum((best.to_picture(place) - corners) ** 2, axis=1))))
        x, y = float(place[0, 0]), float(place[0, 1])
        boards.append(BoardSeen(pose.picture, corners, best, (x, y), board, error_px))
    return best, tuple(boards)


def _flips(count: int) -> list[tuple[bool, ...]]:
    """Which boards may have been found from the other end; a single one decides by itself where the axes point."""
    if count == 1:
        return [(False,)]
    if count > _MOST_POSES:
        raise CalibrationError(f"{count} poses; expected {_MOST_POSES} at most. Leave some out.")
    return list(itertools.product((False, True), repeat=count))


def write_calibration(found: FolderCalibration, path: str | Path) -> None:
    """Write the calibration as JSON, which `load_camera` reads if it has a pose."""
    plane = found.plane
    values: dict[str, Any] = {
        "format": FORMAT,
        "intrinsics": dataclasses.asdict(found.camera.intrinsics),
        "rotation": None if plane is None else plane.rotation.tolist(),
        "translation_m": None if plane is None else plane.translation_m.tolist(),
        "reprojection_px": None if plane is None else plane.reprojection_px,
        "intrinsics_reprojection_px": found.camera.reprojection_px,
        "views_reprojection_px": dict(zip(found.used, found.camera.view_reprojection_px, strict=True)),
        "uncertainty_px": found.camera.uncertainty_px,
        "without_board": found.without_board,
    }
    Path(path).parent.mkdir(parents=True, exist_ok=True)
    Path(path).write_text(json.dumps(values, indent=1, allow_nan=False) + "\n")


def write_corners(found: FolderCalibration, path: str | Path) -> Path:
    """Draw the boards that the pose came from beside the calibration: corners, first corner, axes. Returns the picture."""
    path = Path(path)
    beside = path.with_name(f"{path.stem}_corners.png")
    sheet = draw_boards([(board, read_picture(board.picture)) for board in found.boards])
    if not cv2.imwrite(str(beside), cv2.cvtColor(sheet, cv2.COLOR_RGB2BGR)):
        raise CalibrationError(f"{beside}: cannot be written.")
    return beside
