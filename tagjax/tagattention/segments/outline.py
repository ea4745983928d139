"""From segments back to pixels: label pictures without gaps, masks, boxes and centroids."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_divide
from ...image.warp import pixel_grid
from .cells import NO_LABEL
from .labels import slot_sums

_SAME_SURFACE = 0.06  # a pixel between surfaces joins a neighbour whose depth differs by less than this fraction


def filled_labels(
    labels: Int[Array, "height width"], depth_m: Float[Array, "height width"]
) -> Int[Array, "height width"]:
    """Labels in which pixels without one, but with depth, have that of a neighbour of nearly their depth.

    Pixels at the border of an object lie between two surfaces in depth and belong to no segment.
    """
    out, padded, bordered = labels, jnp.pad(labels, 1, constant_values=NO_LABEL), jnp.pad(depth_m, 1)
    for rows, columns in (
        (slice(1, -1), slice(None, -2)),
        (slice(1, -1), slice(2, None)),
        (slice(None, -2), slice(1, -1)),
        (slice(2, None), slice(1, -1)),
    ):
        beside, apart = padded[rows, columns], jnp.abs(bordered[rows, columns] - depth_m)
        joins = (out < 0) & (beside >= 0) & (depth_m > 0) & (apart < _SAME_SURFACE * depth_m)
        out = jnp.where(joins, beside, out)
    return out


def segment_boxes(labels: Int[Array, "height width"], num_segments: int) -> Float[Array, "segment 4"]:
    """The box x0 y0 x1 y1 of each segment's pixels, inclusive; x0 > x1 for a segment without pixels."""
    height, width = labels.shape
    x, y = pixel_grid(height, width, jnp.float32)
    slot = jnp.where(labels >= 0, labels, num_segments).reshape(-1)

    def highest(values: Float[Array, "height width"]) -> Float[Array, " segment"]:
        return jax.ops.segment_max(values.reshape(-1), slot, num_segments)

    box = jnp.stack([-highest(-x), -highest(-y), highest(x), highest(y)], axis=-1)
    nothing = jnp.array([width, height, -1, -1], jnp.float32)
    return jnp.where(jnp.isfinite(box[:, :1]), box, nothing)


def joined_boxes(boxes_px: Float[Array, "segment 4"], member: Bool[Array, "tag segment"]) -> Float[Array, "tag 4"]:
    """The box around all member segments; zeros where there are none."""
    first = jnp.min(jnp.where(member[..., None], boxes_px[None, :, :2], jnp.inf), axis=1)
    last = jnp.max(jnp.where(member[..., None], boxes_px[None, :, 2:], -jnp.inf), axis=1)
    some = jnp.all(first <= last, axis=-1, keepdims=True)
    return jnp.where(some, jnp.concatenate([first, last], axis=-1), 0.0)


def segment_centroids(labels: Int[Array, "height width"], num_segments: int) -> Float[Array, "segment 3"]:
    """The area of each segment and the sums of its x and y, pixels."""
    height, width = labels.shape
    x, y = pixel_grid(height, width, jnp.float32)
    return jnp.stack(slot_sums([jnp.ones_like(x), x, y], labels >= 0, labels, num_segments), axis=-1)


def joined_centroids(sums: Float[Array, "segment 3"], member: Bool[Array, "tag segment"]) -> Float[Array, "tag 2"]:
    """The centroid of all member segments from their `segment_centroids`, pixels; 0 where there are none."""
    total = member.astype(sums.dtype) @ sums
    return safe_divide(total[:, 1:], jnp.broadcast_to(total[:, :1], (total.shape[0], 2)))


def dense_masks(
    labels: Int[Array, "height width"], probability: Float[Array, "tag segment"]
) -> Float[Array, "tag height width"]:
    """Each tag's soft mask: the probability of the pixel's segment; 0 without a segment, and on the background (slot 0)."""
    table = probability.at[:, 0].set(0.0)
    masks = jnp.take(table, jnp.maximum(labels, 0), axis=1, mode="clip")
    return jnp.where(labels[None] > 0, masks, 0.0)
