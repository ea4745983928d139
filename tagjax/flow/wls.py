"""Edge-preserving smoothing of a flow with forward-backward consistency as weights: occluded pixels are filled.

The flow of an occluded pixel cannot be measured, and an estimate there is inconsistent with the backward flow. So every
pixel is weighted by its `consistency`, and one global solve, which stops at image edges, fills inconsistent pixels from
consistent ones on the same surface.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..image.smoother import fast_global_smooth

STRENGTH = 200.0
"""Smoothing without an edge extends over about sqrt(STRENGTH) pixels."""

EDGE = 0.01
"""Difference of neighbours, of colours from 0 to 1, that reduces their affinity to 1/e."""

ROUNDS = 2
"""Number of solves; the second has new weights, so that a wrong but consistent flow does not affect its neighbours."""

OUTLIER_PX = 1.0
"""Distance from the smoothed flow, pixels, at which a pixel has half its weight in the second round."""


def weighted_least_squares(
    flow_px: Float[Array, "height width 2"],
    confidence: Float[Array, "height width"],
    image: Float[Array, "height width 3"],
) -> Float[Array, "height width 2"]:
    """The flow that is smooth within image edges and near the given flow, pixels.

    `fast_global_smooth` with `confidence` as the weights (as of disparities by consistency, Min et al., TIP 2014), then
    once more with them divided by 1 + |u - f|^2 / OUTLIER_PX^2 (Cauchy's, reweighted). `image`, from 0 to 1, is
    the first image of the flow.
    """
    smooth, weights = flow_px, confidence
    for _ in range(ROUNDS):
        smooth = fast_global_smooth(flow_px, weights, image, strength=STRENGTH, edge=EDGE)
        weights = confidence / (1 + jnp.sum(jnp.square(smooth - flow_px), axis=-1) / OUTLIER_PX**2)
    return smooth


def settings_key() -> str:
    """The constants that the result depends on, as part of a cache key."""
    return f"{STRENGTH:g}-{EDGE:g}-{ROUNDS}-{OUTLIER_PX:g}"
