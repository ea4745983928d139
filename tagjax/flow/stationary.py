"""Stationary pixels: flow that does not explain the images better than no motion is set to zero.

In areas without texture a flow follows the sensor's noise, by pixels. Depth turns that into centimetres of motion on a
slanted floor, as much as a hand-held tag moves between two frames.
"""

from __future__ import annotations

from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..image.census import to_grey
from ..image.warp import gather, pixel_grid
from .images import check_images, to_uint8

BLOCK_PX = 7
"""Side of the square over which squared residuals are averaged, pixels."""

GAIN = 2.5
"""A flow is kept where it divides the mean squared residual of no motion by more than this."""

MILD_GAIN, MILD_BLOCK_PX = 1.75, 25
"""The same for the suffix `+rest`, which removes less motion; for a tracer, noise is worse than lost motion."""

_ROUNDING_VARIANCE = 0.25  # squared grey levels of 255: rounding alone gives 1/6 in a difference


def zero_stationary(
    flow_px: Float[np.ndarray, "height width 2"],
    first: Any,
    second: Any,
    *,
    gain: float = GAIN,
    block_px: int = BLOCK_PX,
) -> Float[np.ndarray, "height width 2"]:
    """The flow u from `first` (I) to `second` (J), pixels, zero at stationary pixels.

    A pixel is stationary where |I(x) - J(x)|^2 <= `gain` |I(x) - J(x + u)|^2 + rounding, both averaged over a block of
    brightness values. Images and errors are those of `check_images`.
    """
    images = map(to_uint8, check_images(first, second))
    one, other = (cv2.cvtColor(np.asarray(each), cv2.COLOR_RGB2GRAY).astype(np.float32) for each in images)
    height, width = one.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    flow = np.asarray(flow_px, np.float32)
    moved = cv2.remap(other, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    without_motion, with_motion = (cv2.blur(np.square(each - one), (block_px, block_px)) for each in (other, moved))
    stationary = without_motion <= gain * with_motion + _ROUNDING_VARIANCE
    return np.where(stationary[..., None], np.float32(0.0), flow)


def is_moving(
    flow_px: Float[Array, "height width 2"],
    first: Float[Array, "height width 3"],
    second: Float[Array, "height width 3"],
) -> Bool[Array, "height width"]:
    """Where `zero_stationary` keeps the flow, as a JAX function of images from 0 to 1. It carries no gradient."""
    height, width, _ = flow_px.shape
    one, other = (255 * to_grey(each) for each in (first, second))
    corner = jnp.asarray([width - 1, height - 1], flow_px.dtype)
    grid = jnp.stack(pixel_grid(height, width, flow_px.dtype), axis=-1)
    # Beyond the image its edge pixels are repeated.
    within = jnp.clip(grid + flow_px, 0, corner.reshape(1, 1, 2)) - grid
    moved = gather(other[..., None], within)[0][..., 0]
    without_motion, with_motion = (_block_mean(jnp.square(each - one)) for each in (other, moved))
    return jax.lax.stop_gradient(without_motion > GAIN * with_motion + _ROUNDING_VARIANCE)


def _block_mean(image: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """Mean over `BLOCK_PX` x `BLOCK_PX` pixels, the image mirrored at its edges."""
    padded = jnp.pad(image, BLOCK_PX // 2, mode="reflect")
    sums = jax.lax.reduce_window(padded, 0.0, jax.lax.add, (BLOCK_PX, BLOCK_PX), (1, 1), "valid")
    return sums / BLOCK_PX**2
