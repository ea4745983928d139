"""Boxes (left, top, right, bottom in pixels; pixel i reaches from i - 1/2 to i + 1/2): overlap and suppression."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int, Shaped


def area_px(box_px: Shaped[np.ndarray, "*boxes 4"]) -> Shaped[np.ndarray, "*boxes"]:
    """Area in square pixels, 0 for a box turned inside out."""
    return np.maximum(box_px[..., 2] - box_px[..., 0], 0.0) * np.maximum(box_px[..., 3] - box_px[..., 1], 0.0)


def overlap(first_px: Shaped[np.ndarray, "first 4"], second_px: Shaped[np.ndarray, "second 4"]) -> np.ndarray:
    """Intersection over union of every two boxes (first, second); 0 where both are empty."""
    low = np.maximum(first_px[:, None, :2], second_px[None, :, :2])
    high = np.minimum(first_px[:, None, 2:], second_px[None, :, 2:])
    shared = np.prod(np.maximum(high - low, 0.0), axis=-1)
    union = area_px(first_px)[:, None] + area_px(second_px)[None, :] - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def suppress(
    box_px: Shaped[np.ndarray, "boxes 4"], score: Shaped[np.ndarray, " boxes"], most_overlap: float
) -> Int[np.ndarray, " kept"]:
    """Non-maximum suppression: boxes by falling score, without those that overlap a better one by more."""
    kept: list[int] = []
    overlaps = overlap(box_px, box_px)
    for index in np.argsort(-score, kind="stable"):
        if all(overlaps[index, other] <= most_overlap for other in kept):
            kept.append(int(index))
    return np.array(kept, dtype=np.int64)


def middle_px(box_px: Shaped[np.ndarray, "*boxes 4"]) -> Shaped[np.ndarray, "*boxes 2"]:
    """Middles of boxes, x and y."""
    return 0.5 * (box_px[..., :2] + box_px[..., 2:])


def from_inclusive(box_px: Shaped[np.ndarray, "*boxes 4"]) -> Float[np.ndarray, "*boxes 4"]:
    """Boxes of this module from boxes that name their first and last pixel (as in `Recording.truth`)."""
    return np.asarray(box_px, np.float64) + np.array([-0.5, -0.5, 0.5, 0.5])
