"""Pictures of a checkerboard, drawn by geometry."""

from __future__ import annotations

import itertools

import numpy as np

from tagjax.baselines.tagvision import PlaneCamera
from tagjax.image.checkerboard import Board


def draw_board(camera: PlaneCamera, board: Board, rng: np.random.Generator, origin_m=(0.0, 0.0)) -> np.ndarray:
    """A picture of the board on the plane z = 0, by looking up the square that every (quarter) pixel sees."""
    k = camera.intrinsics
    steps = np.array([-1 / 3, 0.0, 1 / 3])
    total = np.zeros((k.height, k.width))
    x, y = np.meshgrid(np.arange(k.width, dtype=float), np.arange(k.height, dtype=float))
    for dx, dy in itertools.product(steps, steps):
        place = camera.to_plane(np.stack([x + dx, y + dy], axis=-1).reshape(-1, 2))
        column = np.floor((place[:, 0] - origin_m[0]) / board.square_m + 1)
        row = np.floor(-(place[:, 1] - origin_m[1]) / board.square_m + 1)
        inside = (column >= 0) & (column < board.columns) & (row >= 0) & (row < board.rows)
        light = np.where(inside, np.where((column + row) % 2 == 0, 30.0, 220.0), 220.0)
        total += light.reshape(total.shape) / 9
    grey = np.clip(total + rng.normal(0, 2.0, total.shape), 0, 255)
    return np.repeat(np.rint(grey).astype(np.uint8)[..., None], 3, axis=-1)
