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


_KERNEL = np.ones((3, 3), np.uint8)
_START_VARIANCE = 300.0  # levels squared, summed over channels
_MIN_VARIANCE = 30.0  # quantisation and compression
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

    Everything of the first frame is background. Colour decides only where the depth of the pixel or of its background is
    missing, so that shadows and light make no foreground elsewhere.
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
    blend = np.where(receded, 1.0, np.where(known, own, ~moving))
    depth = np.where(measured, background.depth_m + blend * (depth_m - background.depth_m), background.depth_m)
    variance = background.variance + np.where(moving, 0.0, own) * (squared - background.variance)
    after = Background(
        depth.astype(np.float32),
        background.colour + own[..., None] * (smooth - background.colour),
        np.maximum(variance, _MIN_VARIANCE).astype(np.float32),
    )
    return moving, after


def connected_parts(
    moving: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    rays: Float[np.ndarray, "height width 3"],
    edge_m: float,
    min_area_m2: float,
    *,
    bridge: bool = False,
) -> list[Blob]:
    """Parts of the foreground that are connected in space, with a surface of at least `min_area_m2`; the largest first.

    Pixels within which the foreground's depth changes by more than `edge_m` separate parts and belong to none. Foreground
    without depth takes that of the nearest foreground with depth: dark cloth does not reflect the sensor's light. `bridge`
    closes gaps of the foreground two pixels wide. `rays` are ((x - cx) / fx, (y - cy) / fy, 1).
    """
    known = moving & (depth_m > 0)
    if not known.any():
        return []
    solid = cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_CLOSE, _KERNEL) if bridge else moving.astype(np.uint8)
    solid = cv2.morphologyEx(solid, cv2.MORPH_OPEN, _KERNEL) > 0
    depth_m = np.where(known, depth_m, _of_nearest(depth_m, known)).astype(np.float32)
    low = cv2.erode(np.where(solid, depth_m, np.float32(np.inf)), _KERNEL)
    high = cv2.dilate(np.where(solid, depth_m, np.float32(0)), _KERNEL)
    smooth = solid & (high - low <= edge_m)
    count, labels, stats, _ = cv2.connectedComponentsWithStats(smooth.astype(np.uint8), connectivity=8)
    area_m2 = np.bincount(labels.reshape(-1), _pixel_area_m2(depth_m, rays).reshape(-1), count)
    order = [int(label) for label in np.argsort(-area_m2) if label and area_m2[label] >= min_area_m2]
    return [_blob(label, labels, stats[label], depth_m, rays) for label in order]


def _of_nearest(values: np.ndarray, there: np.ndarray) -> np.ndarray:
    """At each pixel the value of the nearest pixel that is `there`; at least one must be."""
    _, zone = cv2.distanceTransformWithLabels((~there).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    zone = np.asarray(zone, np.int64)
    of_zone = np.zeros(int(zone.max()) + 1, values.dtype)
    of_zone[zone[there]] = values[there]
    return of_zone[zone]


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
