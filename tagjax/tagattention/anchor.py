"""The range anchor: a Bayes filter over the one number that the radio cannot tell, the range at which the tag began.

The radio gives r(t), the distance travelled since the start; the tag's range is r(t) + b with the same b for the
whole recording. Whatever agrees with the tag at any time votes for its b, and the belief over b says, at any later
time, at which range to look: after an occlusion, at a standstill, and against a neighbour who moves alike elsewhere.
It extends the matching of TagAttention (Eqs. 4-6) from a window of frames to all of the past.
"""

from __future__ import annotations

import math

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

BIN_M = 0.1
"""Width of a bin of the belief, metres: finer than what a person or a bag is deep."""

LEAK = 1e-3
"""Share of the belief that is given back to ignorance every frame: a cycle slip can be recovered from."""

LOST_SPEED_M_S = 0.5
"""While a tag is not heard, its range is taken to wander by this much per second (rms)."""

_SHARPNESS = 4.0


class Anchor(eqx.Module):
    """Distance travelled at the window's frames, and log probabilities of the starting range in bins of `BIN_M`."""

    travelled_m: Float[Array, "*batch window"]
    belief: Float[Array, "*batch bins"]

    @classmethod
    def unknown(cls, *batch: int, num_window: int, num_bins: int) -> Anchor:
        """Nothing travelled, nothing known."""
        return cls(jnp.zeros((*batch, num_window)), jnp.full((*batch, num_bins), -math.log(num_bins), float))


def _start_m(anchor: Anchor) -> Float[Array, " bins"]:
    return (jnp.arange(anchor.belief.shape[0], dtype=anchor.belief.dtype) + 0.5) * BIN_M


def lost_drift_m(time_s: Float[Array, " window"]) -> Float[Array, ""]:
    """How far the range of a tag that is not heard may wander in the last frame's time, metres."""
    return LOST_SPEED_M_S * (time_s[-1] - time_s[-2])


def move_anchor(
    anchor: Anchor, relative_m: Float[Array, " window"], heard: Bool[Array, ""], drift_m: Float[Array, ""]
) -> Anchor:
    """One frame on. The new window's shape is laid over what it shares with the last one: only the mean error adds up.

    A tag that was not heard stays where it was. The belief spreads by `drift_m` (rms) and leaks by `LEAK`.
    """
    held = jnp.concatenate([anchor.travelled_m[1:], anchor.travelled_m[-1:]])
    travelled = jnp.where(heard, relative_m + jnp.mean(held[:-1] - relative_m[:-1]), held)
    probability = jnp.exp(anchor.belief)
    # A random walk on the bins with this variance a frame; beyond 0.3 it would not be one.
    aside = jnp.minimum(0.5 * jnp.square(drift_m / BIN_M), 0.3)
    padded = jnp.pad(probability, 1, mode="edge")
    spread = (1.0 - 2.0 * aside) * probability + aside * (padded[:-2] + padded[2:])
    return Anchor(travelled, jnp.log((1.0 - LEAK) * spread / jnp.sum(spread) + LEAK / spread.shape[0]))


def votes(
    anchor: Anchor,
    range_m: Float[Array, " segments"],
    evidence: Float[Array, " segments"],
    present: Bool[Array, " segments"],
    width_m: Float[Array, ""],
    unseen: Float[Array, ""],
) -> Float[Array, " bins"]:
    """Log likelihood of every starting range b: the best evidence among the segments at range r(t) + b.

    A soft maximum of evidence - ((range - r(t) - b) / width)^2 / 2, and of `unseen`, for the object may be hidden.
    Segments that are not `present` have no vote.
    """
    start = _start_m(anchor)
    away = (range_m[None, :] - anchor.travelled_m[-1] - start[:, None]) / width_m
    score = jnp.where(present[None, :], evidence[None, :] - 0.5 * jnp.square(away), -1e3)
    score = jnp.concatenate([score, jnp.broadcast_to(unseen, (start.shape[0], 1))], axis=1)
    return jax.nn.logsumexp(_SHARPNESS * score, axis=1) / _SHARPNESS


def update_belief(anchor: Anchor, vote: Float[Array, " bins"], weight: Float[Array, ""]) -> Anchor:
    """Bayes' rule with a likelihood tempered by `weight`: windows of neighbouring frames share most of their data."""
    return Anchor(anchor.travelled_m, jax.nn.log_softmax(anchor.belief + weight * vote))


def joined(anchor: Anchor, other: Anchor) -> Anchor:
    """What two anchors believe together of the range now, each by frames of its own: Bayes' rule, on the first one's bins.

    Ranges that the other one has no bin for are as likely to it as what it has ruled out.
    """
    start = _start_m(anchor)
    least = LEAK / start.shape[0]
    range_m = start + anchor.travelled_m[-1] - other.travelled_m[-1]
    told = jnp.interp(range_m, start, jnp.exp(other.belief), left=least, right=least)
    return Anchor(anchor.travelled_m, jax.nn.log_softmax(anchor.belief + jnp.log(jnp.maximum(told, least))))


def log_density(
    anchor: Anchor, range_m: Float[Array, "height width"], depth_m: Float[Array, ""], limit: Float[Array, ""]
) -> Float[Array, "height width"]:
    """Log density of the belief at each pixel's range against knowing nothing, for an object about `depth_m` deep.

    Bounded by `limit` both ways; 0 everywhere while nothing is known.
    """
    num_bins = anchor.belief.shape[0]
    start = _start_m(anchor)
    kernel = jnp.exp(-0.5 * jnp.square((start[:, None] - start[None, :]) / depth_m))
    kernel = kernel / jnp.sum(kernel, axis=1, keepdims=True)
    density = jnp.log(jnp.sum(kernel * jnp.exp(anchor.belief)[None, :], axis=1) * num_bins + 1e-6)
    bounded = limit * jnp.tanh(density / limit)
    at = jnp.clip((range_m - anchor.travelled_m[-1]) / BIN_M - 0.5, 0.0, num_bins - 1.001)
    lower = jnp.floor(at)
    index = lower.astype(jnp.int32)
    return bounded[index] * (1.0 - (at - lower)) + bounded[index + 1] * (at - lower)
