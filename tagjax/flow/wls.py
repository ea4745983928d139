"""A flow smoothed by how far the ways there and back agree: what is hidden takes the flow of what it belongs to.

Where a pixel's target is hidden no picture says how it moves, and a flow there is a guess that does not lead back. So
every pixel weighs by its `consistency`, and one solve of the whole picture, which stops at the picture's edges, lets those
that agree speak for those that do not.
"""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..image.smoother import fast_global_smooth

STRENGTH = 200.0
"""Smoothing without an edge reaches some sqrt(STRENGTH) pixels."""

EDGE = 0.01
"""Difference of neighbours, of colours from 0 to 1, that weakens their affinity to 1/e."""

ROUNDS = 2
"""The second weighs anew, so that a wrong flow which leads back to its start does not pull its surroundings along."""

OUTLIER_PX = 1.0
"""Pixels from the smoothed flow at which a pixel's own weighs half, in the second round."""


def weighted_least_squares(
    flow_px: Float[Array, "height width 2"],
    confidence: Float[Array, "height width"],
    picture: Float[Array, "height width 3"],
) -> Float[Array, "height width 2"]:
    """The flow that is smooth within the picture's edges and near the given one, pixels.

    `fast_global_smooth` with `confidence` as the weights (as of disparities by consistency, Min et al., TIP 2014), then
    once more with them divided by 1 + |u - f|^2 / OUTLIER_PX^2 (Cauchy's, reweighted). `picture` from 0 to 1, the one that
    the flow lies on.
    """
    smooth, weights = flow_px, confidence
    for _ in range(ROUNDS):
        smooth = fast_global_smooth(flow_px, weights, picture, strength=STRENGTH, edge=EDGE)
        weights = confidence / (1 + jnp.sum(jnp.square(smooth - flow_px), axis=-1) / OUTLIER_PX**2)
    return smooth


def settings_key() -> str:
    """What the result depends on besides its arguments, as part of a file's name."""
    return f"{STRENGTH:g}-{EDGE:g}-{ROUNDS}-{OUTLIER_PX:g}"
