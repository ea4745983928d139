"""How well TagVision's calibration turns pixels into places (VI.B), on simulated views of a checkerboard."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from ...baselines.tagvision import Board, PlaneCamera, calibrate, locate
from ...recording import Intrinsics

PAPER_CAMERA = Intrinsics(1000.0, 1000.0, 639.5, 359.5, 1280, 720, (-0.12, 0.05, 0.0, 0.0, 0.0))
"""A 720p web camera with a wide lens' distortion; the paper's table of its own is not at hand, so these are assumed."""


@dataclasses.dataclass(frozen=True)
class CalibrationSettings:
    """Simulated pictures of a board: how many, and how well its corners are found."""

    board: Board = dataclasses.field(default_factory=Board)
    num_views: int = 24  # of which the intrinsics are made, as in the paper
    num_places: int = 9  # of the board on the plane, of which the pose is made
    corner_noise_px: float = 0.1  # what `find_corners` shows on drawn boards
    seed: int = 0


def board_views(
    camera: Intrinsics, settings: CalibrationSettings, rng: np.random.Generator
) -> list[Float[np.ndarray, "corners 2"]]:
    """Corners of the board held before the camera at random distances, places and tilts, all within the picture."""
    corners = settings.board.corners_m()
    middle = corners - corners.mean(axis=0)
    size_m = float(np.linalg.norm(np.ptp(corners, axis=0)))
    views = []
    while len(views) < settings.num_views:
        distance = camera.fx_px * size_m / (rng.uniform(0.25, 0.6) * camera.height)
        reach = np.array([camera.width / camera.fx_px, camera.height / camera.fy_px]) * distance * 0.5
        place = np.array([*rng.uniform(-reach, reach), distance])
        tilt = rng.uniform(-0.7, 0.7, 2)
        turn = _turn(np.pi + tilt[0], 0) @ _turn(tilt[1], 1) @ _turn(rng.uniform(-np.pi, np.pi), 2)
        # A camera that stands where the board's frame has its origin sees it moved and turned.
        seen = PlaneCamera(camera, turn, place).to_picture(middle)
        seen = seen + settings.corner_noise_px * rng.normal(size=seen.shape)
        if np.all(seen >= 0) and np.all(seen <= [camera.width - 1, camera.height - 1]):
            views.append(seen)
    return views


def _turn(angle_rad: float, axis: int) -> np.ndarray:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    first, second = [(1, 2), (2, 0), (0, 1)][axis]
    out = np.eye(3)
    out[[first, second, first, second], [first, second, second, first]] = c, c, -s, s
    return out


def calibrated(
    true: PlaneCamera, area_m: tuple[float, float, float, float], settings: CalibrationSettings
) -> PlaneCamera:
    """The camera as calibration finds it: intrinsics from board views, its place from the board laid on the plane.

    `area_m` (x0 y0 x1 y1) is where the board is laid, in turn, in `num_places` known places.
    """
    rng = np.random.default_rng([settings.seed, 7])
    k = true.intrinsics
    found = calibrate(board_views(k, settings, rng), settings.board, k.width, k.height)
    corners = settings.board.corners_m()
    corners = corners - corners.min(axis=0)
    span = corners.max(axis=0)[:2]
    low, high = np.array(area_m[:2]), np.maximum(np.array(area_m[2:]) - span, area_m[:2])
    side = int(np.ceil(np.sqrt(settings.num_places)))
    grid = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)), axis=-1).reshape(-1, 2)
    shares = grid[: settings.num_places] if settings.num_places > 1 else np.array([[0.5, 0.5]])
    laid = np.concatenate([corners + np.array([*(low + share * (high - low)), 0.0]) for share in shares])
    pixels = true.to_picture(laid)
    inside = np.all((pixels >= 0) & (pixels <= [k.width - 1, k.height - 1]), axis=1)
    pixels = pixels + settings.corner_noise_px * rng.normal(size=pixels.shape)
    return locate(laid[inside], pixels[inside], found.intrinsics)


def transform_error_m(
    found: PlaneCamera,
    true: PlaneCamera,
    area_m: tuple[float, float, float, float],
    *,
    pixel_noise_px: float = 0.0,
    seed: int = 0,
) -> Float[np.ndarray, " points"]:
    """How far points of the plane come out from where they are, when their pixels (with noise) are turned back."""
    x, y = np.meshgrid(np.linspace(area_m[0], area_m[2], 13), np.linspace(area_m[1], area_m[3], 25))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=-1)
    pixels = true.to_picture(points)
    inside = np.all((pixels >= 0) & (pixels <= [true.intrinsics.width - 1, true.intrinsics.height - 1]), axis=1)
    seen = pixels[inside]
    seen = seen + pixel_noise_px * np.random.default_rng([seed, 11]).normal(size=seen.shape)
    return np.linalg.norm(found.to_plane(seen) - points[inside], axis=1)


def overhead(intrinsics: Intrinsics, position_m: tuple[float, float, float]) -> PlaneCamera:
    """A camera that looks straight down on the plane; the picture's top is towards +y."""
    turn = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return PlaneCamera(intrinsics, turn, -turn @ np.array(position_m))
