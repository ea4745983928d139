"""Pictures of the boards of a calibration: corners in their order, the first corner, and the axes."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ...image.checkerboard import Board
from .plane import PlaneCamera

Colour = tuple[int, int, int]

_PANEL_PX = 800
"""Width of a panel; smaller pictures are enlarged, so that lines and letters are fine."""

_STRIP_PX, _GAP_PX = 44, 8
_AXES: tuple[tuple[str, Colour], ...] = (("x", (220, 40, 40)), ("y", (30, 150, 50)), ("z", (40, 80, 230)))
_PATH, _FIRST, _INK, _PAPER = (255, 170, 0), (230, 0, 200), (30, 30, 30), (255, 255, 255)
_FONT = cv2.FONT_HERSHEY_DUPLEX


@dataclasses.dataclass(frozen=True)
class LocatedBoard:
    """One picture of the board: its corners in the order of `Board.corners_m`, the camera's pose and its error."""

    picture: str
    corners_px: Float[np.ndarray, "corners 2"]
    plane: PlaneCamera  # camera and world axes
    origin_m: tuple[float, float]  # first corner in the world
    board: Board
    reprojection_px: float


def draw_boards(
    boards: Sequence[tuple[LocatedBoard, UInt8[np.ndarray, "_ _ 3"]]],
) -> UInt8[np.ndarray, "height width 3"]:
    """Panels side by side, in as many rows as columns: each picture with corners, first corner and axes of two
    squares.
    """
    panels = [_panel(board, picture) for board, picture in boards]
    columns = math.ceil(math.sqrt(len(panels)))
    height = max(panel.shape[0] for panel in panels)
    rows = math.ceil(len(panels) / columns)
    sheet = np.full((rows * (height + _GAP_PX) - _GAP_PX, columns * (_PANEL_PX + _GAP_PX) - _GAP_PX, 3), 255, np.uint8)
    for number, panel in enumerate(panels):
        top, left = number // columns * (height + _GAP_PX), number % columns * (_PANEL_PX + _GAP_PX)
        sheet[top : top + panel.shape[0], left : left + _PANEL_PX] = panel
    return sheet


def _panel(board: LocatedBoard, picture: UInt8[np.ndarray, "_ _ 3"]) -> UInt8[np.ndarray, "_ _ 3"]:
    scale = _PANEL_PX / picture.shape[1]
    size = (_PANEL_PX, round(scale * picture.shape[0]))
    drawn = np.ascontiguousarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
    )
    # Marks scale with the squares, so that they do not cover each other.
    side = scale * float(np.median(np.linalg.norm(np.diff(board.corners_px, axis=0), axis=1)))
    radius = int(np.clip(side / 8, 2, 6))
    at = lambda pixel: tuple(int(v) for v in np.rint(scale * (np.asarray(pixel) + 0.5) - 0.5))  # noqa: E731
    for row in board.corners_px.reshape(-1, board.board.columns - 1, 2):
        cv2.polylines(drawn, [np.array([at(p) for p in row])], False, _PATH, 1, cv2.LINE_AA)
    for pixel in board.corners_px:
        cv2.circle(drawn, at(pixel), radius, _PATH, -1, cv2.LINE_AA)
    start = np.array([*board.origin_m, 0.0])
    ends = board.plane.to_picture(start + 2 * board.board.square_m * np.eye(3))
    begin = board.corners_px[0]
    for (name, colour), end in zip(_AXES, ends, strict=True):
        if not np.all(np.isfinite(end)) or np.linalg.norm(scale * (end - begin)) < 4 * radius:
            continue  # the z axis seen from above
        cv2.arrowedLine(drawn, at(begin), at(end), _PAPER, 6, cv2.LINE_AA, tipLength=0.15)
        cv2.arrowedLine(drawn, at(begin), at(end), colour, 3, cv2.LINE_AA, tipLength=0.15)
        beyond = end + (end - begin) * 16 / max(float(np.linalg.norm(scale * (end - begin))), 1.0)
        x, y = np.clip(at(beyond), 14, np.array(size) - 14)
        _write(drawn, name, (int(x), int(y)), colour, 0.7, centred=True)
    cv2.circle(drawn, at(begin), 2 * radius, _PAPER, 5, cv2.LINE_AA)
    cv2.circle(drawn, at(begin), 2 * radius, _FIRST, 2, cv2.LINE_AA)
    strip = np.full((_STRIP_PX, _PANEL_PX, 3), 255, np.uint8)
    x, y = board.origin_m
    cv2.circle(strip, (18, _STRIP_PX // 2), 7, _FIRST, 2, cv2.LINE_AA)
    caption = f"first corner: x {x:.3f} y {y:.3f} m    {board.reprojection_px:.2f} px rms    {Path(board.picture).name}"
    _write(strip, caption, (36, _STRIP_PX // 2 + 6), _INK, 0.55)
    return np.concatenate([drawn, strip])


def _write(
    picture: np.ndarray, text: str, position: tuple[int, ...], colour: Colour, size: float, *, centred=False
) -> None:
    text = text.encode("ascii", "replace").decode()  # OpenCV has no other glyphs
    (width, height), _ = cv2.getTextSize(text, _FONT, size, 1)
    x, y = (position[0] - width // 2, position[1] + height // 2) if centred else (position[0], position[1])
    if centred:
        cv2.putText(picture, text, (x, y), _FONT, size, _PAPER, 5, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), _FONT, size, colour, 1, cv2.LINE_AA)
