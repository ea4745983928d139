"""Labels carried along the backward flow from pixel to pixel, without slipping; and which pixels lie on a surface."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import entries
from ...image.warp import pixel_grid
from .cells import NO_LABEL

_DITHER_STEP = 0.7548777, 0.5698403  # the R2 sequence: powers of 1 / 1.3247180, the plastic number
_FLYING = 0.02  # neighbours on one surface differ by at most this fraction of their depth


def on_surface(depth_m: Float[Array, "height width"]) -> Bool[Array, "height width"]:
    """Pixels with depth of which at least two of four neighbours lie within 2 % of it; the others fly between surfaces."""
    bordered = jnp.pad(depth_m, 1)
    near = jnp.zeros(depth_m.shape, jnp.int32)
    for neighbour in (bordered[:-2, 1:-1], bordered[2:, 1:-1], bordered[1:-1, :-2], bordered[1:-1, 2:]):
        near = near + (jnp.abs(neighbour - depth_m) < _FLYING * depth_m).astype(jnp.int32)
    return (depth_m > 0) & (near >= 2)


def next_dither(dither_px: Float[Array, " axis"]) -> Float[Array, " axis"]:
    """The next fraction of a pixel, (x, y) in [-0.5, 0.5), of a sequence that fills the square evenly."""
    return jnp.mod(dither_px + jnp.array(_DITHER_STEP) + 0.5, 1.0) - 0.5


def carried_labels(
    last_labels: Int[Array, "height width"],
    last_depth_m: Float[Array, "height width"],
    depth_m: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    backward_px: Float[Array, "height width 2"],
    max_change_m: Float[Array, ""],
    dither_px: Float[Array, " axis"],
) -> Int[Array, "height width"]:
    """The label that the flow brings to each pixel from the same surface: a depth that differs by less than `max_change_m`.

    `dither_px`, one for all pixels, is added to sources before they are rounded to pixels. Without it labels would slip
    along a surface by the same fraction of a pixel every frame.
    """
    height, width = depth_m.shape
    column, row = pixel_grid(height, width, depth_m.dtype)
    x, y = column + backward_px[..., 0], row + backward_px[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    at_x = jnp.clip(jnp.round(x + dither_px[0]), 0, width - 1)
    at_y = jnp.clip(jnp.round(y + dither_px[1]), 0, height - 1)
    index = jnp.where(inside, at_y * width + at_x, 0.0).astype(jnp.int32)
    before_m = entries(last_depth_m.reshape(-1), index)
    same = valid & inside & (before_m > 0) & (jnp.abs(depth_m - before_m) < max_change_m)
    return jnp.where(same, entries(last_labels.reshape(-1), index), NO_LABEL)
