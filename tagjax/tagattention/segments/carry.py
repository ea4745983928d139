"""Labels carried along the backward flow from pixel to pixel, without slipping; and which pixels lie on a surface."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_norm
from ...image.warp import pixel_grid
from .cells import NO_LABEL

_FLYING = 0.02  # neighbours on one surface differ by at most this fraction of their depth
_MAX_OFFSET_PX = 1.0


def on_surface(depth_m: Float[Array, "height width"]) -> Bool[Array, "height width"]:
    """Pixels with depth of which at least two of four neighbours lie within 2 % of it; the others fly between surfaces."""
    bordered = jnp.pad(depth_m, 1)
    near = jnp.zeros(depth_m.shape, jnp.int32)
    for neighbour in (bordered[:-2, 1:-1], bordered[2:, 1:-1], bordered[1:-1, :-2], bordered[1:-1, 2:]):
        near = near + (jnp.abs(neighbour - depth_m) < _FLYING * depth_m).astype(jnp.int32)
    return (depth_m > 0) & (near >= 2)


def carried_labels(
    last_labels: Int[Array, "height width"],
    last_offset_x_px: Float[Array, "height width"],
    last_offset_y_px: Float[Array, "height width"],
    last_depth_m: Float[Array, "height width"],
    rays: Float[Array, "height width 3"],
    depth_m: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    backward_px: Float[Array, "height width 2"],
    max_change_m: Float[Array, ""],
) -> tuple[
    Int[Array, "height width"],
    Float[Array, "height width"],
    Float[Array, "height width"],
    Bool[Array, "height width"],
]:
    """The label that the flow brings to each pixel from the last frame's same surface, the offset of its point (x, y),
    and whether the pixel nearest to the flow's source shows that surface, so that motion can be measured there.

    It is that of the pixel whose point, its offset included, is nearest to the flow's source. Without offsets, what
    rounding leaves out would add up, and labels would slip along a surface by up to half a pixel a frame.
    """
    height, width = depth_m.shape
    column, row = pixel_grid(height, width, depth_m.dtype)
    x, y = column + backward_px[..., 0], row + backward_px[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = jnp.where(inside, x, 0.0), jnp.where(inside, y, 0.0)
    length = safe_norm(rays)
    before_m, range_m = (length * last_depth_m).reshape(-1), length * depth_m

    def source(x: Float[Array, "height width"], y: Float[Array, "height width"]) -> tuple[Array, Array]:
        at_x, at_y = jnp.clip(jnp.round(x), 0, width - 1), jnp.clip(jnp.round(y), 0, height - 1)
        index = (at_y * width + at_x).astype(jnp.int32)
        before = before_m[index]
        apart = jnp.abs(range_m - before)
        return index, valid & inside & (before > 0) & (apart < max_change_m)

    offset_x, offset_y = last_offset_x_px.reshape(-1), last_offset_y_px.reshape(-1)
    plain, same_plain = source(x, y)
    index, same = source(x - offset_x[plain], y - offset_y[plain])
    index = jnp.where(same, index, plain)
    same = same | same_plain
    most = _MAX_OFFSET_PX
    labels = jnp.where(same, last_labels.reshape(-1)[index], NO_LABEL)
    left_x = (index % width).astype(x.dtype) + offset_x[index] - x
    left_y = (index // width).astype(x.dtype) + offset_y[index] - y
    return labels, jnp.clip(left_x, -most, most), jnp.clip(left_y, -most, most), same_plain
