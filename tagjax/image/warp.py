"""Warps by optical flow: bilinear gather (backward), and differentiable splat (forward) with a mask of its holes."""

from __future__ import annotations

import functools

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

_TINY = 1e-12


def _taps(
    x: Float[Array, "height width"], y: Float[Array, "height width"], shape: tuple[int, int]
) -> tuple[Int[Array, "4 height width"], Float[Array, "4 height width"]]:
    """Flat index and bilinear weight of the four pixels around each position; weight 0 outside the image."""
    height, width = shape
    x0, y0 = jnp.floor(x), jnp.floor(y)
    index, weight = [], []
    for dy in (0.0, 1.0):
        for dx in (0.0, 1.0):
            column, row = x0 + dx, y0 + dy
            inside = (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
            bilinear = (1.0 - jnp.abs(x - column)) * (1.0 - jnp.abs(y - row))
            flat = jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)
            index.append(flat.astype(jnp.int32))
            weight.append(jnp.where(inside, bilinear, 0.0))
    return jnp.stack(index), jnp.stack(weight)


def pixel_grid(
    height: int, width: int, dtype: DTypeLike = jnp.float32
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """The x (column) and y (row) coordinate of every pixel centre."""
    x, y = jnp.meshgrid(jnp.arange(width, dtype=dtype), jnp.arange(height, dtype=dtype))
    return x, y


Taps = tuple[tuple[Float[Array, "height width channel"], Float[Array, "height width"]], ...]


def gather_taps(image: Float[Array, "height width channel"], flow_px: Float[Array, "height width 2"]) -> Taps:
    """The four values around `pixel + flow`, each with its bilinear weight (0 outside), for the caller to combine.

    Four maps instead of one stack: XLA then reads and combines them in one loop, several times as fast.
    """
    height, width, channels = image.shape
    x, y = pixel_grid(height, width, flow_px.dtype)
    x, y = x + flow_px[..., 0], y + flow_px[..., 1]
    left, top = jnp.clip(jnp.floor(x), -1, width - 1), jnp.clip(jnp.floor(y), -1, height - 1)
    bordered = jnp.pad(image, ((1, 1), (1, 1), (0, 0))).reshape(-1, channels)
    corner = ((top + 1) * (width + 2) + left + 1).astype(jnp.int32)
    near = (x >= -1) & (x <= width) & (y >= -1) & (y <= height)
    taps = []
    for down in (0, 1):
        for right in (0, 1):
            column, row = left + right, top + down
            bilinear = (x - left if right else 1 - (x - left)) * (y - top if down else 1 - (y - top))
            inside = near & (column >= 0) & (column <= width - 1) & (row >= 0) & (row <= height - 1)
            value = bordered.at[corner + down * (width + 2) + right].get(mode="clip")
            taps.append((value, jnp.where(inside, bilinear, 0.0)))
    return tuple(taps)


def gather(
    image: Float[Array, "height width channel"],
    flow_px: Float[Array, "height width 2"],
) -> tuple[Float[Array, "height width channel"], Bool[Array, "height width"]]:
    """Backward warp: sample `image` at `pixel + flow`, bilinearly, over the picture's pixels only.

    Returns the samples and a mask: where these have at least half of the bilinear weight; 0 elsewhere.
    """
    taps = gather_taps(image, flow_px)
    total = functools.reduce(jnp.add, [weight for _, weight in taps])
    mixed = functools.reduce(jnp.add, [value * weight[..., None] for value, weight in taps])
    covered = total >= 0.5
    return jnp.where(covered[..., None], mixed / jnp.maximum(total, _TINY)[..., None], 0.0), covered


def splat(
    image: Float[Array, "height width channel"],
    flow_px: Float[Array, "height width 2"],
) -> tuple[Float[Array, "height width channel"], Bool[Array, "height width"]]:
    """Forward warp: move every pixel by its flow and distribute it bilinearly over the four pixels around its target.

    Where several pixels meet, they are averaged by bilinear weight. Returns the image and the mask of pixels that
    received a value; holes are 0 and False. Differentiable in image and flow.
    """
    height, width, channels = image.shape
    x, y = pixel_grid(height, width, flow_px.dtype)
    index, weight = _taps(x + flow_px[..., 0], y + flow_px[..., 1], (height, width))
    rows = jnp.concatenate([image, jnp.ones((height, width, 1), image.dtype)], axis=-1)
    contribution = (rows[None] * weight[..., None]).reshape(-1, channels + 1)
    summed = jnp.zeros((height * width, channels + 1), image.dtype).at[index.reshape(-1)].add(contribution)
    summed = summed.reshape(height, width, channels + 1)
    total = summed[..., -1]
    filled = total > _TINY
    return jnp.where(filled[..., None], summed[..., :-1] / jnp.maximum(total, _TINY)[..., None], 0.0), filled
