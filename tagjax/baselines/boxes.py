"""Boxes: x0 y0 x1 y1 in pixels, first and last pixel (both inside). Pixel i covers i - 1/2 to i + 1/2."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int, Shaped

Window = tuple[int, int, int, int]
"""x, y, width, height in pixels: OpenCV's convention, used for calls of OpenCV only."""


def box_from_window(window: Window) -> Int[np.ndarray, " 4"]:
    """The box of one of OpenCV's windows."""
    x, y, width, height = window
    return np.array([x, y, x + width - 1, y + height - 1])


def box_size_px(box_px: Shaped[np.ndarray, "*boxes 4"]) -> Shaped[np.ndarray, "*boxes 2"]:
    """Width and height."""
    return box_px[..., 2:] - box_px[..., :2] + 1


def box_area_px(box_px: Shaped[np.ndarray, "*boxes 4"]) -> Shaped[np.ndarray, "*boxes"]:
    """Area in square pixels, 0 for a box whose last pixel lies before its first."""
    return np.asarray(np.prod(np.maximum(box_size_px(box_px), 0), axis=-1))


def box_centre_px(box_px: Shaped[np.ndarray, "*boxes 4"]) -> Shaped[np.ndarray, "*boxes 2"]:
    """Centre, x and y; pixel centres lie at integers."""
    return 0.5 * (box_px[..., :2] + box_px[..., 2:])


def intersection_px(
    first_px: Shaped[np.ndarray, "first 4"], second_px: Shaped[np.ndarray, "second 4"]
) -> Shaped[np.ndarray, "first second"]:
    """Area that every two boxes share, square pixels."""
    low = np.maximum(first_px[:, None, :2], second_px[None, :, :2])
    high = np.minimum(first_px[:, None, 2:], second_px[None, :, 2:])
    return box_area_px(np.concatenate([low, high], axis=-1))


def box_iou(
    first_px: Shaped[np.ndarray, "first 4"], second_px: Shaped[np.ndarray, "second 4"]
) -> Shaped[np.ndarray, "first second"]:
    """Intersection over union of every two boxes; 0 where both are empty."""
    shared = np.asarray(intersection_px(first_px, second_px), np.float64)
    union = box_area_px(first_px)[:, None] + box_area_px(second_px)[None, :] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def non_maximum_suppression(
    box_px: Shaped[np.ndarray, "boxes 4"], score: Shaped[np.ndarray, " boxes"], max_iou: float
) -> Int[np.ndarray, " kept"]:
    """Indices of boxes by falling score, without those that overlap a better one by more than `max_iou`."""
    kept: list[int] = []
    iou = box_iou(box_px, box_px)
    for index in np.argsort(-score, kind="stable"):
        if all(iou[index, other] <= max_iou for other in kept):
            kept.append(int(index))
    return np.array(kept, dtype=np.int64)


def box_mask(box_px: Shaped[np.ndarray, " 4"], shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
    """The pixels of a box, rounded to whole pixels and cut at the picture's edge."""
    x0, y0, x1, y1 = np.maximum(np.round(box_px).astype(int) + np.array([0, 0, 1, 1]), 0)
    mask = np.zeros(shape, bool)
    mask[y0:y1, x0:x1] = True
    return mask
