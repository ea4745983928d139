"""Scores of bounding boxes: overlap (TagAttention, Eq. 8), centre error, and the success curve of tracking benchmarks."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Integer, Shaped

from ..recording import Truth

REFERENCE_WIDTH_PX = 512
"""Centre errors are scaled to a picture of this width (Kinect v2's depth camera, as in TagAttention)."""

PRECISION_PX = 20.0
"""The centre error up to which a frame counts as precise (Wu et al., Online Object Tracking, CVPR 2013)."""

_SUCCESS_LEVELS = np.linspace(0.0, 1.0, 21)


def box_iou(
    box_a_px: Shaped[np.ndarray, "*batch 4"], box_b_px: Shaped[np.ndarray, "*batch 4"]
) -> Float[np.ndarray, "*batch"]:
    """Intersection over union of boxes x0 y0 x1 y1 with inclusive pixel edges (TagAttention, Eq. 8).

    Pixels have unit size, so a box spans x1 - x0 + 1. 0 where either box is NaN or has a negative side.
    """
    a, b = np.asarray(box_a_px, np.float64), np.asarray(box_b_px, np.float64)
    side_a, side_b = a[..., 2:] - a[..., :2] + 1.0, b[..., 2:] - b[..., :2] + 1.0
    with np.errstate(invalid="ignore"):
        overlap = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]) + 1.0
        proper = np.all(side_a > 0, axis=-1) & np.all(side_b > 0, axis=-1)
        intersection = np.prod(np.maximum(overlap, 0.0), axis=-1)
        union = np.prod(side_a, axis=-1) + np.prod(side_b, axis=-1) - intersection
    return np.where(proper, np.divide(intersection, union, out=np.zeros_like(union), where=proper & (union > 0)), 0.0)


def centre_error(
    box_a_px: Shaped[np.ndarray, "*batch 4"], box_b_px: Shaped[np.ndarray, "*batch 4"], width: int
) -> Float[np.ndarray, "*batch"]:
    """Distance between box centres in pixels of a 512-pixel-wide picture; NaN where a box is NaN.

    `width` is the width of the picture to which the boxes belong, pixels.
    """
    a, b = np.asarray(box_a_px, np.float64), np.asarray(box_b_px, np.float64)
    gap = 0.5 * (a[..., :2] + a[..., 2:] - b[..., :2] - b[..., 2:])
    return np.asarray(np.linalg.norm(gap, axis=-1) * (REFERENCE_WIDTH_PX / width))


def success_area(iou: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """The fraction of the thresholds 0, 0.05, ..., 1 that an overlap exceeds.

    Its mean over frames is the area under the success curve ("success AUC") of Wu et al. (CVPR 2013).
    """
    return np.mean(np.asarray(iou)[..., None] > _SUCCESS_LEVELS, axis=-1)


def label_box(labels: Integer[np.ndarray, "height width"], label: int) -> Float[np.ndarray, " 4"]:
    """Tight box x0 y0 x1 y1 (inclusive) around a labelled object; NaN if it is not visible."""
    return _box_of(labels == label)


def labelled_area(labels: Integer[np.ndarray, "height width"]) -> Float[np.ndarray, " 4"]:
    """Box x0 y0 x1 y1 (inclusive) of the labelled area: rows and columns at the edges that are all 255 (ignore) are cut."""
    return _box_of(labels != Truth.IGNORE)


def _box_of(mask: Bool[np.ndarray, "height width"]) -> Float[np.ndarray, " 4"]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    if not len(rows):
        return np.full(4, np.nan)
    return np.array([columns[0], rows[0], columns[-1], rows[-1]], dtype=np.float64)


def touches_border(
    box_px: Shaped[np.ndarray, "*batch 4"], area_px: Float[np.ndarray, " 4"], *, margin_px: float = 0.0
) -> Bool[np.ndarray, "*batch"]:
    """Whether a box is within `margin_px` of the edge of the labelled area, where the object may be cut off."""
    x0, y0, x1, y1 = np.moveaxis(np.asarray(box_px, np.float64), -1, 0)
    left, top, right, bottom = np.asarray(area_px) + margin_px * np.array([1.0, 1.0, -1.0, -1.0])
    return np.asarray((x0 <= left) | (y0 <= top) | (x1 >= right) | (y1 >= bottom))
