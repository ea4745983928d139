"""Memory of the still background: what a pixel knew of the surface behind whatever passes in front of it.

A static camera sees the same far surface again once a walker has passed. The surface's range and its log odds are
kept per pixel, so that it does not come back as something nobody knows (TagAttention starts such holes from nothing).
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float


class Background(eqx.Module):
    """The farthest surface seen at each pixel, and each tag's log odds of it."""

    distance_m: Float[Array, "height width"]  # 0 = none seen yet
    log_odds: Float[Array, "tag height width"]


def empty_background(num_tags: int, height: int, width: int) -> Background:
    """Nothing seen."""
    return Background(jnp.zeros((height, width)), jnp.zeros((num_tags, height, width)))


def _noise_m(distance_m: Float[Array, "height width"]) -> Float[Array, "height width"]:
    # Three times the axial noise of structured light (Nguyen et al., 2012).
    return 0.006 * jnp.square(distance_m)


def _tolerance_m(distance_m: Float[Array, "height width"]) -> Float[Array, "height width"]:
    # ... and half a hand.
    return 0.05 + _noise_m(distance_m)


def _shows(
    background: Background,
    distance_m: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    within_m: Float[Array, "height width"],
) -> Bool[Array, "height width"]:
    return valid & (background.distance_m > 0) & (jnp.abs(distance_m - background.distance_m) <= within_m)


def is_background(
    background: Background, distance_m: Float[Array, "height width"], valid: Bool[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Pixels that show the surface remembered for them."""
    return _shows(background, distance_m, valid, _tolerance_m(distance_m))


def shows_rest(
    background: Background, distance_m: Float[Array, "height width"], valid: Bool[Array, "height width"]
) -> Bool[Array, "height width"]:
    """Pixels whose range is the remembered one to within the sensor's noise."""
    return _shows(background, distance_m, valid, _noise_m(distance_m))


def remember(
    background: Background,
    distance_m: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    log_odds: Float[Array, "tag height width"],
) -> Background:
    """One frame on: a farther surface replaces the one remembered, the same one is averaged, a nearer one is ignored."""
    same = is_background(background, distance_m, valid)
    farther = valid & (distance_m > background.distance_m + _tolerance_m(distance_m))
    mean = 0.9 * background.distance_m + 0.1 * distance_m
    return Background(
        jnp.where(farther, distance_m, jnp.where(same, mean, background.distance_m)),
        jnp.where((same | farther)[None], log_odds, background.log_odds),
    )


def in_front(
    background: Background, distance_m: Float[Array, "height width"], valid: Bool[Array, "height width"]
) -> Float[Array, "height width"]:
    """1 for pixels that show something nearer than the surface remembered, -1 for that surface, 0 if nobody knows.

    The mean of 3 x 3 pixels: at outlines the depth flickers between front and back.
    """
    known = valid & (background.distance_m > 0)
    nearer = known & (distance_m < background.distance_m - _tolerance_m(distance_m))
    same = is_background(background, distance_m, valid)
    told = jnp.pad(nearer.astype(distance_m.dtype) - same.astype(distance_m.dtype), 1, mode="edge")
    rows = told[:-2] + told[1:-1] + told[2:]
    return (rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]) / 9.0
