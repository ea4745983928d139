"""From segments back to pixels: label pictures without gaps, masks, boxes and centroids."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_divide
from ...image.warp import pixel_grid
from .cells import NO_LABEL
from .labels import slot_sums

_SAME_SURFACE = 0.06  # a pixel between surfaces joins a neighbour whose depth differs by less than this fraction
_STANDS_ON = 1.15  # what stands on something is not this many times nearer than it


def filled_labels(
    labels: Int[Array, "height width"], depth_m: Float[Array, "height width"]
) -> Int[Array, "height width"]:
    """Labels in which gaps have that of the segment which they are part of.

    Pixels at the border of an object lie between two surfaces in depth and belong to no segment: they join a neighbour of
    nearly their depth. Dark clothes have no depth at all. The camera is upright, and what it sees hangs or stands: a gap
    goes to the segment above it, unless the surface below is deeper, so that one sees past the segment there.
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
    above, above_m, below_m = _around_gaps(out, depth_m)
    return jnp.where((out < 0) & (above > 0) & (below_m < _STANDS_ON * above_m), above, out)


def _around_gaps(
    labels: Int[Array, "height width"], depth_m: Float[Array, "height width"]
) -> tuple[Int[Array, "height width"], Float[Array, "height width"], Float[Array, "height width"]]:
    """The nearest label upwards and its depth, and the depth of the nearest label downwards, the pixel itself included.

    -1, 0 and infinity where there is none. Row by row: a cumulative maximum takes XLA six times as long on a CPU.
    """
    depth_m = jax.lax.stop_gradient(depth_m)

    def next_row(carry: tuple[Array, Array], row: tuple[Array, Array]) -> tuple[tuple[Array, Array], Any]:
        label, row_m = row
        found = jnp.where(label < 0, carry[0], label), jnp.where(label < 0, carry[1], row_m)
        return found, found

    nothing = jnp.full_like(labels[0], NO_LABEL)
    _, (above, above_m) = jax.lax.scan(next_row, (nothing, jnp.zeros_like(depth_m[0])), (labels, depth_m))
    deepest = nothing, jnp.full_like(depth_m[0], jnp.inf)
    _, (_, below_m) = jax.lax.scan(next_row, deepest, (labels, depth_m), reverse=True)
    return above, above_m, below_m


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
