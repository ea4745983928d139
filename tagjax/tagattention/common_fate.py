"""Common fate: what belongs to one thing comes as far, in the same direction, whoever hears of it.

A tag's phases tell of its distance alone, in which a forearm moves nearly as the hand does. The camera sees motion in all
directions, where the arm turns about the elbow and what it holds does not. So once a tag's object is found, its segments'
own motion in space tells what else belongs to it (the Gestalt law of common fate; Wertheimer, 1923).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .propagation import log_likelihood_ratio


def shared_shift(
    shift_m: Float[Array, "rows columns 3"],
    weight: Float[Array, "rows columns"],
    spread_m: Float[Array, ""],
    slack: Float[Array, ""],
    *,
    num_iterations: int = 3,
) -> Float[Array, " 3"]:
    """How far the thing has come: the mode of weighted shifts next to their mean, by Gaussian mean shift.

    The kernel's variance is spread^2 + (slack |shift|)^2. Without any weight it is 0. No gradient goes through it.
    """

    def mean(weight: Float[Array, "rows columns"]) -> Float[Array, " 3"]:
        return jnp.einsum("rc,rcx->x", weight, shift_m) / jnp.maximum(jnp.sum(weight), 1e-6)

    def move(shared: Float[Array, " 3"], _: None):
        alike = fate_attention(shift_m, shared, spread_m, slack)
        # Where nothing is near, all is: the mean stays what it was.
        return mean(weight * (alike + 1e-9)), None

    shared, _ = jax.lax.scan(move, mean(weight), None, length=num_iterations)
    return jax.lax.stop_gradient(shared)


def fate_attention(
    shift_m: Float[Array, "rows columns 3"],
    shared_m: Float[Array, " 3"],
    spread_m: Float[Array, ""],
    slack: Float[Array, ""],
) -> Float[Array, "rows columns"]:
    """exp(-|u - u*|^2 / (2 (spread^2 + slack^2 |u*|^2))): 1 for what comes as far as the thing itself."""
    variance = jnp.square(spread_m) + jnp.square(slack) * jnp.sum(jnp.square(shared_m))
    return jnp.exp(-jnp.sum(jnp.square(shift_m - shared_m[None, None]), axis=-1) / (2.0 * variance))


def common_fate(
    shift_m: Float[Array, "rows columns 3"],
    known: Float[Array, "rows columns"],
    log_odds: Float[Array, "rows columns"],
    *,
    spread_m: Float[Array, ""],
    slack: Float[Array, ""],
    floor: Float[Array, ""],
) -> Float[Array, "rows columns"]:
    """Log-likelihood ratio, at most 0, of each segment to belong to what the best of them move with.

    Segments weigh as many pixels as `known` says, times the odds by which they fall short of the best one's. Where a
    shift is not known, fewer than one pixel, nothing is said.
    """
    there = known > 1.0
    best = jnp.max(jnp.where(there, log_odds, -1e3))
    weight = jnp.where(there, known * jnp.exp(jnp.minimum(log_odds - best, 0.0)), 0.0)
    shared = shared_shift(shift_m, jax.lax.stop_gradient(weight), spread_m, slack)
    attention = fate_attention(shift_m, shared, spread_m, slack)
    return jnp.where(there, log_likelihood_ratio(attention, jnp.ones(()), floor), 0.0)
