"""Accuracy of TagVision's calibration in world positions (VI.B), on simulated views of a checkerboard."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from ....image.checkerboard import Board, calibrate
from ....recording import Intrinsics
from ..calibration import camera_pose
from ..plane import PlaneCamera

PAPER_CAMERA = Intrinsics(1000.0, 1000.0, 639.5, 359.5, 1280, 720, (-0.12, 0.05, 0.0, 0.0, 0.0))
"""A 720p web camera with the distortion of a wide lens; assumed, since the paper does not give its values."""


@dataclasses.dataclass(frozen=True)
class CalibrationSettings:
    """Simulated pictures of a board: their number, and the accuracy of its corners."""

    board: Board = dataclasses.field(default_factory=Board)
    num_views: int = 24  # for the intrinsics, as in the paper
    num_board_positions: int = 9  # of the board on the plane, for the pose
    corner_noise_px: float = 0.1  # as measured with `find_corners` on drawn boards
    seed: int = 0


def board_views(
    camera: Intrinsics, settings: CalibrationSettings, rng: np.random.Generator
) -> list[Float[np.ndarray, "corners 2"]]:
    """Corners of the board in front of the camera at random distances, positions and tilts, all within the picture."""
    corners = settings.board.corners_m()
    centred = corners - corners.mean(axis=0)
    size_m = float(np.linalg.norm(np.ptp(corners, axis=0)))
    views = []
    while len(views) < settings.num_views:
        distance = camera.fx_px * size_m / (rng.uniform(0.25, 0.6) * camera.height)
        reach = np.array([camera.width / camera.fx_px, camera.height / camera.fy_px]) * distance * 0.5
        position = np.array([*rng.uniform(-reach, reach), distance])
        tilt = rng.uniform(-0.7, 0.7, 2)
        about_z = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
        rotation = Rotation.from_euler("x", np.pi + tilt[0]) * Rotation.from_euler("y", tilt[1]) * about_z
        seen = PlaneCamera(camera, rotation.as_matrix(), position).to_picture(centred)
        seen = seen + settings.corner_noise_px * rng.normal(size=seen.shape)
        if np.all(seen >= 0) and np.all(seen <= [camera.width - 1, camera.height - 1]):
            views.append(seen)
    return views


def simulate_calibration(
    true: PlaneCamera, area_m: tuple[float, float, float, float], settings: CalibrationSettings
) -> PlaneCamera:
    """The calibrated camera: intrinsics from views of the board, the pose from the board lying on the plane.

    The board lies at `num_board_positions` known positions within `area_m` (x0 y0 x1 y1).
    """
    rng = np.random.default_rng([settings.seed, 7])
    k = true.intrinsics
    found = calibrate(board_views(k, settings, rng), settings.board, k.width, k.height)
    corners = settings.board.corners_m()
    corners = corners - corners.min(axis=0)
    span = corners.max(axis=0)[:2]
    low, high = np.array(area_m[:2]), np.maximum(np.array(area_m[2:]) - span, area_m[:2])
    side = int(np.ceil(np.sqrt(settings.num_board_positions)))
    grid = np.stack(np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)), axis=-1).reshape(-1, 2)
    fractions = grid[: settings.num_board_positions] if settings.num_board_positions > 1 else np.array([[0.5, 0.5]])
    laid = np.concatenate([corners + np.array([*(low + fraction * (high - low)), 0.0]) for fraction in fractions])
    pixels = true.to_picture(laid)
    inside = np.all((pixels >= 0) & (pixels <= [k.width - 1, k.height - 1]), axis=1)
    pixels = pixels + settings.corner_noise_px * rng.normal(size=pixels.shape)
    return camera_pose(laid[inside], pixels[inside], found.intrinsics)


def transform_error_m(
    found: PlaneCamera,
    true: PlaneCamera,
    area_m: tuple[float, float, float, float],
    *,
    pixel_noise_px: float = 0.0,
    seed: int = 0,
) -> Float[np.ndarray, " points"]:
    """Distance of points of the plane from where a calibration maps their pixels (with noise)."""
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
