"""Warps by optical flow: bilinear gather, and differentiable forward splat that marks its holes."""

from __future__ import annotations

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
            share = (1.0 - jnp.abs(x - column)) * (1.0 - jnp.abs(y - row))
            flat = jnp.clip(row, 0, height - 1) * width + jnp.clip(column, 0, width - 1)
            index.append(flat.astype(jnp.int32))
            weight.append(jnp.where(inside, share, 0.0))
    return jnp.stack(index), jnp.stack(weight)


def pixel_grid(
    height: int, width: int, dtype: DTypeLike = jnp.float32
) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
    """The x (column) and y (row) coordinate of every pixel centre."""
    x, y = jnp.meshgrid(jnp.arange(width, dtype=dtype), jnp.arange(height, dtype=dtype))
    return x, y


def gather_taps(
    image: Float[Array, "height width channel"], flow_px: Float[Array, "height width 2"]
) -> tuple[Float[Array, "4 height width channel"], Float[Array, "4 height width"]]:
    """The four values around `pixel + flow` with their bilinear weights (0 outside), for a caller's own mixture."""
    height, width, channels = image.shape
    x, y = pixel_grid(height, width, flow_px.dtype)
    index, weight = _taps(x + flow_px[..., 0], y + flow_px[..., 1], (height, width))
    values = jnp.take(image.reshape(-1, channels), index.reshape(-1), axis=0)
    return values.reshape(4, height, width, channels), weight


def gather(
    image: Float[Array, "height width channel"],
    flow_px: Float[Array, "height width 2"],
    valid: Bool[Array, "height width"] | None = None,
) -> tuple[Float[Array, "height width channel"], Bool[Array, "height width"]]:
    """Backward warp: sample `image` at `pixel + flow`, bilinearly, over valid pixels only.

    Returns the samples and where they rest on valid pixels by at least half of their weight; 0 elsewhere.
    """
    values, weight = gather_taps(image, flow_px)
    if valid is not None:
        known, _ = gather_taps(valid.astype(image.dtype)[..., None], flow_px)
        weight = weight * known[..., 0]
    total = jnp.sum(weight, axis=0)
    mixed = jnp.sum(values * weight[..., None], axis=0) / jnp.maximum(total, _TINY)[..., None]
    covered = total >= 0.5
    return jnp.where(covered[..., None], mixed, 0.0), covered


def splat(
    image: Float[Array, "height width channel"],
    flow_px: Float[Array, "height width 2"],
    importance: Float[Array, "height width"] | None = None,
) -> tuple[Float[Array, "height width channel"], Bool[Array, "height width"]]:
    """Forward warp: move every pixel by its flow and spread it bilinearly over the four pixels it lands on.

    Where several land, they are averaged by bilinear weight times `importance` (all 1 if None; use
    exp(-depth / scale) to let the nearer win, 0 to leave a pixel out: softmax splatting). Returns the image and where
    anything landed; holes are 0 and False. Differentiable in image, flow and importance.
    """
    height, width, channels = image.shape
    x, y = pixel_grid(height, width, flow_px.dtype)
    index, weight = _taps(x + flow_px[..., 0], y + flow_px[..., 1], (height, width))
    if importance is not None:
        weight = weight * importance[None]
    rows = jnp.concatenate([image, jnp.ones((height, width, 1), image.dtype)], axis=-1)
    contribution = (rows[None] * weight[..., None]).reshape(-1, channels + 1)
    summed = jnp.zeros((height * width, channels + 1), image.dtype).at[index.reshape(-1)].add(contribution)
    summed = summed.reshape(height, width, channels + 1)
    total = summed[..., -1]
    filled = total > _TINY
    return jnp.where(filled[..., None], summed[..., :-1] / jnp.maximum(total, _TINY)[..., None], 0.0), filled
