"""Foreground by depth and colour, and its connected parts in space."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from .settings import BlobSettings


@dataclasses.dataclass(frozen=True)
class Blob:
    """A connected part of the foreground."""

    centre_m: Float[np.ndarray, " 3"]  # mean of its points, camera frame
    mask: Bool[np.ndarray, "rows columns"]  # within `corner_px`
    corner_px: tuple[int, int]  # column and row of the mask's first pixel

    def full_mask(self, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        """The mask in the whole picture."""
        out = np.zeros(shape, bool)
        (x, y), (rows, columns) = self.corner_px, self.mask.shape
        out[y : y + rows, x : x + columns] = self.mask
        return out


@dataclasses.dataclass(frozen=True)
class Background:
    """Means of the empty room's depth and colour, at each pixel; 0 where no depth was measured yet."""

    depth_m: Float[np.ndarray, "height width"]
    colour: Float[np.ndarray, "height width 3"]
    variance: Float[np.ndarray, "height width"]  # of the colour, levels squared, summed over channels


_START_VARIANCE = 300.0
_COLOUR_SIGMAS = 4.0
_SLOW = 0.1
"""The background follows what it takes for foreground ten times as slowly as the rest, and depth that recedes at once."""


def foreground(
    background: Background | None,
    colour: UInt8[np.ndarray, "height width 3"],
    depth_m: Float[np.ndarray, "height width"],
    elapsed_s: float,
    settings: BlobSettings,
) -> tuple[Bool[np.ndarray, "height width"], Background]:
    """Pixels that are nearer than the background, or of another colour; and the background after this frame.

    Everything of the first frame is background. Where depth is measured and equal to the background's, colour alone
    (shadows, light) makes no foreground.
    """
    smooth = cv2.GaussianBlur(colour, (0, 0), 1.0).astype(np.float32)
    if background is None:
        none = np.zeros(depth_m.shape, bool)
        return none, Background(depth_m.copy(), smooth, np.full(depth_m.shape, _START_VARIANCE, np.float32))
    measured, known = depth_m > 0, background.depth_m > 0
    slack = np.maximum(settings.nearer_m, settings.nearer_fraction * background.depth_m)
    nearer = measured & known & (depth_m < background.depth_m - slack)
    squared = np.sum((smooth - background.colour) ** 2, axis=-1)
    coloured = squared > _COLOUR_SIGMAS**2 * background.variance
    moving = nearer | (coloured & ~(measured & known))
    rate = min(elapsed_s / settings.background_s, 1.0)
    own = np.where(moving, _SLOW * rate, rate).astype(np.float32)
    receded = measured & known & (depth_m > background.depth_m + slack)
    blend = np.where(receded | ~known, 1.0, own)
    depth = np.where(measured, background.depth_m + blend * (depth_m - background.depth_m), background.depth_m)
    variance = background.variance + np.where(moving, 0.0, own) * (squared - background.variance)
    after = Background(
        depth.astype(np.float32),
        background.colour + own[..., None] * (smooth - background.colour),
        np.maximum(variance, 30.0).astype(np.float32),
    )
    return moving, after


def connected_parts(
    moving: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    rays: Float[np.ndarray, "height width 3"],
    settings: BlobSettings,
) -> list[Blob]:
    """Parts of the foreground that are connected in space, with a surface of at least `min_area_m2`; the largest first.

    Pixels at a step in depth, and those without depth, belong to none. `rays` are ((x - cx) / fx, (y - cy) / fy, 1).
    """
    solid = cv2.morphologyEx((moving & (depth_m > 0)).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    span = cv2.dilate(depth_m, np.ones((3, 3), np.uint8)) - cv2.erode(
        np.where(depth_m > 0, depth_m, np.float32(1e3)), np.ones((3, 3), np.uint8)
    )
    solid[span > settings.edge_m] = 0
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid, connectivity=8)
    pixel_m2 = _pixel_area_m2(depth_m, rays)
    area_m2 = np.bincount(labels.reshape(-1), pixel_m2.reshape(-1), count)
    order = [int(label) for label in np.argsort(-area_m2) if label and area_m2[label] >= settings.min_area_m2]
    return [_blob(label, labels, stats[label], depth_m, rays) for label in order]


def _pixel_area_m2(depth_m: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """The area that a pixel covers on a surface that faces the camera."""
    side_x = abs(float(rays[0, 1, 0] - rays[0, 0, 0]))
    side_y = abs(float(rays[1, 0, 1] - rays[0, 0, 1]))
    return depth_m.astype(np.float64) ** 2 * side_x * side_y


def _blob(
    label: int, labels: Int[np.ndarray, "height width"], stats: np.ndarray, depth_m: np.ndarray, rays: np.ndarray
) -> Blob:
    x, y, width, height = (int(value) for value in stats[:4])
    part = slice(y, y + height), slice(x, x + width)
    mask = labels[part] == label
    points = rays[part][mask] * depth_m[part][mask][:, None]
    return Blob(points.mean(axis=0, dtype=np.float64), mask, (x, y))
