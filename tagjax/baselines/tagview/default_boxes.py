"""Default boxes of the single-shot detector: their positions, training targets, and offsets to boxes and back."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from ..boxes import box_centre_px, box_iou, box_size_px

STRIDE_PX = 4
"""Distance between cells of the feature map."""

SHAPES_PX = ((11.0, 11.0), (17.0, 17.0), (19.0, 10.0), (10.0, 19.0))
"""Width and height of the default boxes of each cell, in the detector's pixels: objects of 0.2 m on a table."""

_AMBIGUOUS_IOU, _IGNORED_IOU = 0.4, 0.1

_SCALE = (0.1, 0.1, 0.2, 0.2)
"""Units of the offsets (the variances of Liu et al.'s program)."""


def default_boxes(height: int, width: int) -> Float[np.ndarray, "boxes 4"]:
    """Default boxes of a picture: cells row by row, the shapes of each cell in order."""
    rows, columns = -(-height // STRIDE_PX), -(-width // STRIDE_PX)
    y, x = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    middle = (np.stack([x, y], axis=-1)[..., None, :] + 0.5) * STRIDE_PX - 0.5
    half = 0.5 * (np.array(SHAPES_PX) - 1)
    return np.concatenate([middle - half, middle + half], axis=-1).reshape(-1, 4)


def encode(
    box_px: Shaped[np.ndarray, "boxes 4"], default_px: Shaped[np.ndarray, "boxes 4"]
) -> Float[np.ndarray, "boxes 4"]:
    """Offsets from default boxes to boxes: shift of the centre in units of the size, logarithm of the ratio of
    sizes.
    """
    size = box_size_px(default_px)
    shift = (box_centre_px(box_px) - box_centre_px(default_px)) / size
    return np.concatenate([shift, np.log(box_size_px(box_px) / size)], axis=1) / np.array(_SCALE)


def decode(
    offset: Shaped[np.ndarray, "boxes 4"], default_px: Shaped[np.ndarray, "boxes 4"]
) -> Float[np.ndarray, "boxes 4"]:
    """The boxes of offsets from default boxes; sizes stay within a factor of 8 of the default's."""
    scaled = offset * np.array(_SCALE)
    size = box_size_px(default_px)
    middle = box_centre_px(default_px) + scaled[:, :2] * size
    half = 0.5 * (size * np.exp(np.clip(scaled[:, 2:], -np.log(8.0), np.log(8.0))) - 1)
    return np.concatenate([middle - half, middle + half], axis=1)


def targets(
    truth_px: Shaped[np.ndarray, "objects 4"],
    ignored_px: Shaped[np.ndarray, "others 4"],
    default_px: Shaped[np.ndarray, "boxes 4"],
    *,
    min_iou: float = 0.5,
) -> tuple[Int[np.ndarray, " boxes"], Float[np.ndarray, "boxes 4"]]:
    """The label of each default box, 1 object, 0 background, -1 ignored; and its offsets, 0 without an object.

    A default box gets the object of highest IoU if that is `min_iou` or more, and every object gets at least the
    default box of highest IoU (SSD, 2.2). Boxes with an IoU of 0.4 or more with an object, or over 0.1 with an ignored
    one, are ignored rather than labelled background.
    """
    label = np.zeros(len(default_px), np.int64)
    offset = np.zeros((len(default_px), 4))
    if len(ignored_px):
        label[box_iou(default_px, ignored_px).max(axis=1) > _IGNORED_IOU] = -1
    if not len(truth_px):
        return label, offset
    iou = box_iou(default_px, truth_px)
    nearest, highest = iou.argmax(axis=1), iou.max(axis=1)
    label[(highest >= _AMBIGUOUS_IOU) & (highest < min_iou)] = -1
    positive: Bool[np.ndarray, " boxes"] = highest >= min_iou
    for number in range(len(truth_px)):
        best = int(iou[:, number].argmax())
        positive[best], nearest[best] = True, number
    label[positive] = 1
    offset[positive] = encode(np.asarray(truth_px, np.float64)[nearest[positive]], default_px[positive])
    return label, offset
