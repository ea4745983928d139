"""Scores of masks: region similarity J, boundary accuracy F, and which object a mask covers (DAVIS: Perazzi et al., CVPR 2016)."""

from __future__ import annotations

import math

import cv2
import numpy as np
from jaxtyping import Bool, Float, Integer

from ..recording import Truth

BOUNDARY_PX = (1.0, 2.0, 3.0)
"""Tolerances of the boundary accuracy F, pixels."""

BOUNDARY_FRACTION = 0.008
"""DAVIS's tolerance of F, of the picture's diagonal, rounded up to a pixel."""

_ROOT_ERROR_PX = 1e-3  # of the float32 distance transform; squared distances are integers


def mask_iou(mask: Bool[np.ndarray, "height width"], labels: Integer[np.ndarray, "height width"], label: int) -> float:
    """Region similarity J: IoU of a mask with a labelled object, pixels labelled 255 (ignore) left out of both.

    NaN where both are empty.
    """
    counted = labels != Truth.IGNORE
    predicted, true = mask & counted, labels == label
    union = int(np.sum(predicted | true))
    return float(np.sum(predicted & true) / union) if union else float("nan")


def boundary_tolerances_px(height: int, width: int) -> tuple[float, ...]:
    """1, 2 and 3 pixels, and DAVIS's 0.8 % of the diagonal."""
    return (*BOUNDARY_PX, float(math.ceil(BOUNDARY_FRACTION * math.hypot(height, width))))


def boundary(mask: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Pixels that differ from their right, lower or lower right neighbour: a contour one pixel wide, as in DAVIS."""
    padded = np.pad(mask, ((0, 1), (0, 1)), mode="edge")
    right, lower, diagonal = padded[:-1, 1:], padded[1:, :-1], padded[1:, 1:]
    edge = (mask != right) | (mask != lower) | (mask != diagonal)
    edge[-1, -1] = False
    return edge


def boundary_f(
    mask: Bool[np.ndarray, "height width"], true: Bool[np.ndarray, "height width"], tolerances_px: tuple[float, ...]
) -> Float[np.ndarray, " tolerance"]:
    """Boundary accuracy F: harmonic mean of precision and recall of the contour, for each tolerance in pixels.

    A contour pixel is right if a pixel of the other contour is within the tolerance. 1 if neither mask has a contour, 0
    if only one has.
    """
    found, wanted = boundary(mask), boundary(true)
    if not found.any() or not wanted.any():
        return np.full(len(tolerances_px), float(found.any() == wanted.any()))
    # Only the part of the picture that holds both contours matters.
    rows, columns = np.flatnonzero((found | wanted).any(axis=1)), np.flatnonzero((found | wanted).any(axis=0))
    part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    found, wanted = found[part], wanted[part]
    to_wanted, to_found = _distance_px(wanted)[found], _distance_px(found)[wanted]
    values = []
    for tolerance in tolerances_px:
        precision = np.mean(to_wanted <= tolerance + _ROOT_ERROR_PX)
        recall = np.mean(to_found <= tolerance + _ROOT_ERROR_PX)
        values.append(2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0)
    return np.array(values, dtype=np.float64)


def _distance_px(contour: Bool[np.ndarray, "rows columns"]) -> Float[np.ndarray, "rows columns"]:
    """The exact distance of each pixel to the nearest pixel of a contour."""
    return np.asarray(cv2.distanceTransform((~contour).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE))


def decay(values: Float[np.ndarray, " time"]) -> float:
    """How much a score falls in a sequence: its mean over the first quarter of the frames minus that over the last (DAVIS).

    NaN for fewer than four frames. Frames without a value (NaN) must be left out by the caller.
    """
    if len(values) < 4:
        return float("nan")
    # The four parts overlap by their ends, as in DAVIS's own evaluation.
    edges = np.round(np.linspace(1, len(values), 5) + 1e-10).astype(int) - 1
    return float(np.mean(values[edges[0] : edges[1] + 1]) - np.mean(values[edges[3] : edges[4] + 1]))


def best_covered_label(
    mask: Bool[np.ndarray, "height width"], labels: Integer[np.ndarray, "height width"], *, min_pixels: int = 20
) -> int:
    """The label of the object of which the mask covers the largest fraction; 0 if it covers none.

    Objects with fewer than `min_pixels` visible pixels are ignored: masks cover these by chance.
    """
    area = np.bincount(labels.reshape(-1), minlength=256).astype(np.float64)
    covered = np.bincount(labels[mask], minlength=256).astype(np.float64)
    area[[0, Truth.IGNORE]] = covered[[0, Truth.IGNORE]] = 0
    fraction = np.where(area >= min_pixels, covered / np.maximum(area, 1.0), 0.0)
    return int(np.argmax(fraction)) if fraction.max() > 0 else 0
