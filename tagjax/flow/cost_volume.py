"""Cost volumes: correlation of each pixel's feature with those around it in the other image."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

_TILE = 16
"""Columns per matrix product; fastest of 8, 16 and 32 on two CPU cores."""


def normalise_features(
    first: Float[Array, "height width channel"], second: Float[Array, "height width channel"]
) -> tuple[Float[Array, "height width channel"], Float[Array, "height width channel"]]:
    """Both maps minus their common mean, divided by their common standard deviation (UFlow, Jonschkowski et al., 2020)."""
    count = first.size + second.size
    mean = (jnp.sum(first) + jnp.sum(second)) / count
    first, second = first - mean, second - mean
    variance = (jnp.sum(first * first) + jnp.sum(second * second)) / count
    scale = jax.lax.rsqrt(variance + 1e-6)
    return first * scale, second * scale


def cost_volume(
    first: Float[Array, "height width channel"], second: Float[Array, "height width channel"], radius: int
) -> Float[Array, "height width displacement"]:
    """Mean over channels of `first` times `second` moved by each (dy, dx), |dy|, |dx| <= radius; 0 beyond the border.

    Displacement (dy, dx) is channel (dy + radius) (2 radius + 1) + dx + radius. Rows are cut into tiles of columns;
    the products of a tile with the tile and its margin are one matrix product, of which the diagonal band is kept:
    on CPUs four to eight times faster than a product for each displacement.
    """
    height, width, channels = first.shape
    reach = 2 * radius + 1
    tiles = -(-width // _TILE)
    extent = _TILE + 2 * radius
    spare = tiles * _TILE - width
    left = jnp.pad(first, ((0, 0), (0, spare), (0, 0))).reshape(height * tiles, _TILE, channels)
    padded = jnp.pad(second, ((radius, radius), (radius, radius + spare), (0, 0)))
    strips = jnp.stack([padded[:, k * _TILE : k * _TILE + extent] for k in range(tiles)], axis=1)
    bands = []
    for dy in range(reach):
        right = strips[dy : dy + height].reshape(height * tiles, extent, channels)
        product = jnp.einsum("btc,bsc->bts", left, right).reshape(height * tiles, _TILE * extent)
        # With rows longer by one, element (t, t + j) moves to (t, j).
        skewed = jnp.pad(product, ((0, 0), (0, _TILE))).reshape(height * tiles, _TILE, extent + 1)
        bands.append(skewed[:, :, :reach])
    volume = jnp.concatenate(bands, axis=-1).reshape(height, tiles * _TILE, reach * reach)
    return volume[:, :width] / channels
