"""Where each pixel comes from: pixels move along the rounded flow, the nearest surface wins, and small holes are filled."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...image.warp import pixel_grid

NOWHERE = -1
"""The source of a pixel that none moves to."""

HOLE_PX = 3
"""A hole takes its source from a pixel within so many rows and columns."""


def nearest_source(
    forward_px: Float[Array, "height width 2"], range_m: Float[Array, "height width"]
) -> Int[Array, "height width"]:
    """For each pixel of the new frame the flat index of the pixel of the last frame that moves there; `NOWHERE` for none.

    `forward_px` and `range_m` (0 = missing) are of the last frame. Of several pixels with one target that of the smallest
    range is kept, of equal ranges that of the smallest index. A pixel of unknown range moves nowhere.
    """
    height, width = range_m.shape
    x, y = pixel_grid(height, width, forward_px.dtype)
    column, row = jnp.round(x + forward_px[..., 0]), jnp.round(y + forward_px[..., 1])
    moves = (range_m > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    num = height * width
    target = jnp.where(moves, row * width + column, num).astype(jnp.int32).reshape(-1)
    distance = range_m.reshape(-1)
    nearest = jnp.full(num + 1, jnp.inf, distance.dtype).at[target].min(distance)
    index = jnp.arange(num, dtype=jnp.int32)
    winner = jnp.where(distance <= nearest[target], index, num)
    source = jnp.full(num + 1, num, jnp.int32).at[target].min(winner)[:num]
    return jnp.where(source < num, source, NOWHERE).reshape(height, width)


def filled(
    source: Int[Array, "height width"],
    last_range_m: Float[Array, "height width"],
    range_m: Float[Array, "height width"],
    max_step_m: Float[Array, ""],
) -> Int[Array, "height width"]:
    """Sources with holes filled: a hole takes the source of the pixel within `HOLE_PX` that carries the range most like its own.

    `last_range_m` is the range of the last frame, which a source carries along; `range_m` that of the new frame. Ranges
    that differ by more than `max_step_m`, and missing ones, fill no hole. Of equally good neighbours the nearest is taken.
    """
    height, width = source.shape
    carried = jnp.where(source >= 0, last_range_m.reshape(-1)[jnp.maximum(source, 0)], jnp.inf)
    pad = ((HOLE_PX, HOLE_PX), (HOLE_PX, HOLE_PX))
    carried, sources = jnp.pad(carried, pad, constant_values=jnp.inf), jnp.pad(source, pad, constant_values=NOWHERE)
    span = range(-HOLE_PX, HOLE_PX + 1)
    best = jnp.full(source.shape, jnp.inf, range_m.dtype)
    found = jnp.full(source.shape, NOWHERE, source.dtype)
    for dy, dx in sorted(((dy, dx) for dy in span for dx in span), key=lambda at: (at[0] ** 2 + at[1] ** 2, at)):
        here = slice(HOLE_PX + dy, HOLE_PX + dy + height), slice(HOLE_PX + dx, HOLE_PX + dx + width)
        gap = jnp.abs(carried[here] - range_m)
        better = (gap < best) & (gap <= max_step_m) & (range_m > 0)
        best, found = jnp.where(better, gap, best), jnp.where(better, sources[here], found)
    return jnp.where(source >= 0, source, found)


def moved(
    image: Float[Array, "height width channel"], source: Int[Array, "height width"], fill: Float[Array, " channel"]
) -> tuple[Float[Array, "height width channel"], Bool[Array, "height width"]]:
    """An image of the last frame at the pixels of the new one, `fill` where these have no source; and where they have one."""
    known = source >= 0
    values = image.reshape(-1, image.shape[-1])[jnp.maximum(source, 0)]
    return jnp.where(known[..., None], values, fill[None, None]), known
