"""Soft ternary census transform and its distance: a comparison of images that is invariant to brightness.

After Meister et al. (UnFlow, AAAI 2018, Eq. 4-5) with the constants of its published code.
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Offset = tuple[int, int]
"""(rows down, columns right) from a pixel to the neighbour that it is compared with."""

_SOFTNESS = 0.81
"""Squared difference, in grey levels of 255, at which the soft sign is about 0.7."""

_DISTANCE = 0.1

GREY = np.asarray([0.299, 0.587, 0.114], np.float32)
"""Weights of red, green and blue in luma (ITU-R BT.601)."""


def to_grey(image: Float[Array, "height width 3"]) -> Float[Array, "height width"]:
    """Luma of an RGB image."""
    return jnp.sum(image * jnp.asarray(GREY, image.dtype).reshape(1, 1, 3), axis=-1)


def census_offsets(radius: int, stride: int = 1) -> tuple[Offset, ...]:
    """Offsets to half of the neighbours within a square of (2 radius + 1)^2 pixels, every `stride`-th of them.

    The other half is redundant: comparing a with b is comparing b with a at another pixel. Raises `ValueError` for a
    radius or stride below 1.
    """
    if radius < 1 or stride < 1:
        raise ValueError(f"The census has radius {radius} and stride {stride}; expected at least 1 for both.")
    reach = range(-radius, radius + 1)
    half = [(dy, dx) for dy in reach for dx in reach if (dy, dx) > (0, 0)]
    return tuple(half[::stride])


def ternary(grey: Float[Array, "height width"], offsets: Sequence[Offset]) -> Float[Array, "offset height width"]:
    """Soft sign of each neighbour's difference: d / sqrt(0.81 + d^2), d in levels of 255. `grey` is 0 to 1.

    Beyond the image, border pixels are repeated.
    """
    height, width = grey.shape
    reach = max(max(abs(dy), abs(dx)) for dy, dx in offsets)
    padded = jnp.pad(255.0 * grey, reach, mode="edge")
    centre = padded[reach : reach + height, reach : reach + width]

    def compare(offset: Offset) -> Array:
        top, left = reach + offset[0], reach + offset[1]
        difference = jax.lax.slice(padded, (top, left), (top + height, left + width)) - centre
        return difference * jax.lax.rsqrt(_SOFTNESS + difference * difference)

    return jnp.stack([compare(offset) for offset in offsets])


def census_distance(
    first: Float[Array, "height width"], second: Float[Array, "height width"], offsets: Sequence[Offset]
) -> Float[Array, "height width"]:
    """Mean over the neighbours of d^2 / (0.1 + d^2), d the difference of the soft signs: 0 (equal) to 1."""
    difference = ternary(first, offsets) - ternary(second, offsets)
    squared = difference * difference
    return jnp.mean(squared / (_DISTANCE + squared), axis=0)
