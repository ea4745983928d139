"""What rest explains as well has not moved: flow that only follows the noise is set to zero.

Where a picture shows little texture a flow follows the sensor's noise, by pixels. Depth turns that into centimetres of
motion on every slanted floor, which is as much as a tag in a hand moves between two frames.
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
"""Side of the square over which residuals are averaged."""

GAIN = 2.5
"""A flow that does not divide the mean squared residual of rest by this much explains noise."""

GENTLE_GAIN, GENTLE_BLOCK_PX = 1.75, 25
"""The same for a flow by itself (`+rest`), which loses less motion so; a tracer rather loses motion than takes noise."""

_LEAST_VARIANCE = 0.25  # of eight-bit brightness: rounding alone has 1/6 in a difference


def zero_stationary(
    flow_px: Float[np.ndarray, "height width 2"],
    here: Any,
    there: Any,
    *,
    gain: float = GAIN,
    block_px: int = BLOCK_PX,
) -> Float[np.ndarray, "height width 2"]:
    """The flow from `here` to `there`, zero where rest explains the pictures as well.

    Rest is kept where |I(x) - J(x)|^2 <= `gain` |I(x) - J(x + u)|^2 + rounding, both averaged over a block of the
    brightness. Takes pictures as `check_images` does, whose errors it raises.
    """
    pictures = map(to_uint8, check_images(here, there))
    one, other = (cv2.cvtColor(np.asarray(each), cv2.COLOR_RGB2GRAY).astype(np.float32) for each in pictures)
    height, width = one.shape
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    flow = np.asarray(flow_px, np.float32)
    moved = cv2.remap(other, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    rest, motion = (cv2.blur(np.square(each - one), (block_px, block_px)) for each in (other, moved))
    still = rest <= gain * motion + _LEAST_VARIANCE
    return np.where(still[..., None], np.float32(0.0), flow)


def is_moving(
    flow_px: Float[Array, "height width 2"],
    here: Float[Array, "height width 3"],
    there: Float[Array, "height width 3"],
) -> Bool[Array, "height width"]:
    """Where `zero_stationary` keeps the flow; as a function of JAX, of pictures from 0 to 1. It carries no gradient."""
    height, width, _ = flow_px.shape
    one, other = (255 * to_grey(each) for each in (here, there))
    corner = jnp.asarray([width - 1, height - 1], flow_px.dtype)
    grid = jnp.stack(pixel_grid(height, width, flow_px.dtype), axis=-1)
    # Beyond the edge the edge's pixels go on.
    within = jnp.clip(grid + flow_px, 0, corner.reshape(1, 1, 2)) - grid
    moved = gather(other[..., None], within)[0][..., 0]
    rest, motion = (_block_mean(jnp.square(each - one)) for each in (other, moved))
    return jax.lax.stop_gradient(rest > GAIN * motion + _LEAST_VARIANCE)


def _block_mean(image: Float[Array, "height width"]) -> Float[Array, "height width"]:
    """Mean over `BLOCK_PX` x `BLOCK_PX` pixels, the picture mirrored at its edges."""
    padded = jnp.pad(image, BLOCK_PX // 2, mode="reflect")
    sums = jax.lax.reduce_window(padded, 0.0, jax.lax.add, (BLOCK_PX, BLOCK_PX), (1, 1), "valid")
    return sums / BLOCK_PX**2
