"""Default boxes of the single-shot detector: where they lie, what they are told to become, and the way back."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from ._boxes import overlap

STRIDE_PX = 4
"""Between the cells of the feature map."""

SHAPES_PX = ((11.0, 11.0), (17.0, 17.0), (19.0, 10.0), (10.0, 19.0))
"""Width and height of the default boxes of each cell, in the detector's pixels: things of 0.2 m on a table."""

_SCALE = (0.1, 0.1, 0.2, 0.2)
"""Offsets are counted in these units (the variances of Liu et al.'s program)."""


def default_boxes(height: int, width: int) -> Float[np.ndarray, "boxes 4"]:
    """Default boxes of a picture: cells row by row, the shapes of each cell in a row."""
    rows, columns = -(-height // STRIDE_PX), -(-width // STRIDE_PX)
    y, x = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    middle = (np.stack([x, y], axis=-1)[..., None, :] + 0.5) * STRIDE_PX - 0.5
    half = 0.5 * np.array(SHAPES_PX)
    return np.concatenate([middle - half, middle + half], axis=-1).reshape(-1, 4)


def encode(box_px: Shaped[np.ndarray, "boxes 4"], default_px: Shaped[np.ndarray, "boxes 4"]) -> np.ndarray:
    """Offsets (boxes, 4) that turn default boxes into these: shift in units of the size, and log of the size's ratio."""
    size, own = default_px[:, 2:] - default_px[:, :2], box_px[:, 2:] - box_px[:, :2]
    shift = 0.5 * (box_px[:, :2] + box_px[:, 2:] - default_px[:, :2] - default_px[:, 2:]) / size
    return np.concatenate([shift, np.log(own / size)], axis=1) / np.array(_SCALE)


def decode(offset: Shaped[np.ndarray, "boxes 4"], default_px: Shaped[np.ndarray, "boxes 4"]) -> np.ndarray:
    """The boxes (boxes, 4) that offsets mean; sizes stay within a factor of 8 of the default's."""
    scaled = offset * np.array(_SCALE)
    size = default_px[:, 2:] - default_px[:, :2]
    middle = 0.5 * (default_px[:, :2] + default_px[:, 2:]) + scaled[:, :2] * size
    half = 0.5 * size * np.exp(np.clip(scaled[:, 2:], -np.log(8.0), np.log(8.0)))
    return np.concatenate([middle - half, middle + half], axis=1)


def targets(
    truth_px: Shaped[np.ndarray, "things 4"],
    ignored_px: Shaped[np.ndarray, "others 4"],
    default_px: Shaped[np.ndarray, "boxes 4"],
    *,
    least_overlap: float = 0.5,
) -> tuple[Int[np.ndarray, " boxes"], Float[np.ndarray, "boxes 4"]]:
    """What each default box is to say: 1 a thing, 0 nothing, -1 no matter; and its offsets, 0 where there is no thing.

    A default box stands for the thing that it overlaps most if that is `least_overlap` or more, and every thing has at
    least the default box that overlaps it most (SSD, 2.2). Boxes that overlap a thing by 0.4 or more, or one that is
    ignored at all, are left out rather than called nothing.
    """
    label = np.zeros(len(default_px), np.int64)
    offset = np.zeros((len(default_px), 4))
    if len(ignored_px):
        label[overlap(default_px, ignored_px).max(axis=1) > 0.1] = -1
    if not len(truth_px):
        return label, offset
    shared = overlap(default_px, truth_px)
    owner = shared.argmax(axis=1)
    most = shared.max(axis=1)
    label[(most >= 0.4) & (most < least_overlap)] = -1
    positive: Bool[np.ndarray, " boxes"] = most >= least_overlap
    for thing in range(len(truth_px)):
        best = int(shared[:, thing].argmax())
        positive[best], owner[best] = True, thing
    label[positive] = 1
    offset[positive] = encode(np.asarray(truth_px, np.float64)[owner[positive]], default_px[positive])
    return label, offset
