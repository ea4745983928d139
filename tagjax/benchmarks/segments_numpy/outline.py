"""From segments back to pixels: `tagattention.segments.outline`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import outline as original
from ...tagattention.segments.cells import NO_LABEL


def filled_labels(
    labels: Int[np.ndarray, "height width"], depth_m: Float[np.ndarray, "height width"]
) -> Int[np.ndarray, "height width"]:
    """Labels in which gaps have that of a neighbour of nearly their depth, or of the segment that hangs or stands there."""
    width = labels.shape[1] + 2
    label = np.pad(labels, 1, constant_values=NO_LABEL).ravel()
    depth = np.pad(depth_m, 1).ravel()
    at = np.flatnonzero((label < 0) & (depth > 0))
    out, own = np.full(len(at), NO_LABEL, labels.dtype), depth[at]
    for step in (-1, 1, -width, width):
        beside = label[at + step]
        joins = (out < 0) & (beside >= 0) & (np.abs(depth[at + step] - own) < original._SAME_SURFACE * own)
        np.copyto(out, beside, where=joins)
    label[at] = out
    filled = label.reshape(-1, width)[1:-1, 1:-1]
    height, row = len(filled), np.arange(len(filled))[:, None]
    gap = filled < 0
    above = np.maximum.accumulate(np.where(gap, -1, row), axis=0)
    below = np.minimum.accumulate(np.where(gap, height, row)[::-1], axis=0)[::-1]
    rows, columns = np.nonzero(gap & (above >= 0) & (below < height))
    top, bottom = above[rows, columns], below[rows, columns]
    stands = depth_m[bottom, columns] < original._STANDS_ON * depth_m[top, columns]
    hangs = stands & (filled[top, columns] > 0)
    filled[rows[hangs], columns[hangs]] = filled[top, columns][hangs]
    return filled


def boxes_and_centroids(
    labels: Int[np.ndarray, "height width"], member: Bool[np.ndarray, "tag segment"]
) -> tuple[Float[np.ndarray, "tag 4"], Float[np.ndarray, "tag 2"]]:
    """The box around each tag's member segments and their centroid; zeros where there are none."""
    height, width = labels.shape
    num_tags, num = member.shape
    at = np.flatnonzero(labels > 0)
    slot, x, y = labels.ravel()[at], at % width, at // width
    sums = np.stack([np.bincount(slot, weight, num) for weight in (None, x, y)], axis=-1)
    box = np.empty((num, 4), np.float32)
    box[:, :2], box[:, 2:] = (width, height), -1
    for column, (values, extreme) in enumerate(((x, np.minimum), (y, np.minimum), (x, np.maximum), (y, np.maximum))):
        extreme.at(box[:, column], slot, values.astype(np.float32))
    boxes, centres = np.zeros((num_tags, 4), np.float32), np.zeros((num_tags, 2), np.float32)
    for tag, own in enumerate(member):
        area, *moments = sums[own].sum(axis=0)
        if area > 0:
            boxes[tag] = *box[own, :2].min(axis=0), *box[own, 2:].max(axis=0)
            centres[tag] = np.array(moments) / area
    return boxes, centres


def dense_masks(
    labels: Int[np.ndarray, "height width"], membership: Float[np.ndarray, "tag segment"]
) -> Float[np.ndarray, "tag height width"]:
    """Each tag's soft mask."""
    table = membership.copy()
    table[:, 0] = 0
    return table.take(np.maximum(labels, 0), axis=1)
