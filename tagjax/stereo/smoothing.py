"""Edge-aware smoothing of a disparity picture: weighted least squares whose weights are the texture that was matched.

A disparity is as accurate as the picture's slope along the row is steep. Where there is none, semi-global matching gives
the pixel a disparity of its neighbourhood all the same, and another one in the next frame. So each pixel is weighted by
its texture, and one global solve, which stops at edges of the picture, gives pixels without texture the disparity of
textured ones on the same surface. The surface's noise is averaged, so that its range does not seem to change.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from ..image.smoother import fast_global_smooth

_EDGE = 0.01  # difference of neighbours, of colours from 0 to 1, that reduces their affinity to 1/e
_TEXTURE = 8.0  # mean squared slope of a window, (grey levels a pixel)^2, at which its pixel has half its weight
_OUTLIER_PX = 1.0  # distance from the smooth disparity at which a pixel has half its weight in the second round


def smooth_disparity(
    disparity_px: Float[np.ndarray, "height width"],
    texture: Float[np.ndarray, "height width"],
    picture: UInt8[np.ndarray, "height width 3"],
    strength: float,
) -> Float[np.ndarray, "height width"]:
    """Disparities that are smooth within edges of `picture`, float32; 0 where there was none (as 0 in `disparity_px`).

    `texture` is the mean square of the slope along the row in each pixel's window, (grey levels a pixel)^2. Without an edge,
    smoothing extends over about sqrt(`strength`) pixels. The solver is the Fast Global Smoother (Min et al., IEEE TIP 2014),
    run twice: outliers count less in the second round (Cauchy's weights). Good values of `strength`: 100 to 500.
    """
    known = disparity_px > 0
    weight = np.where(known, texture / (texture + np.float32(_TEXTURE)), 0).astype(np.float32)
    smooth = _smooth(disparity_px.astype(np.float32), weight, picture, float(strength))
    return np.where(known, np.asarray(smooth), 0).astype(np.float32)


@functools.partial(jax.jit, static_argnames="strength")
def _smooth(
    disparity_px: Float[Array, "height width"],
    weight: Float[Array, "height width"],
    picture: UInt8[Array, "height width 3"],
    strength: float,
) -> Float[Array, "height width"]:
    guide, values = picture.astype(jnp.float32) / 255, disparity_px[..., None]
    smooth = fast_global_smooth(values, weight, guide, strength=strength, edge=_EDGE)[..., 0]
    again = weight / (1 + jnp.square((smooth - disparity_px) / _OUTLIER_PX))
    return fast_global_smooth(values, again, guide, strength=strength, edge=_EDGE)[..., 0]
