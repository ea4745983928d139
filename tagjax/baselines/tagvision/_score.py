"""TagVision's phase score (IV.C): how well a trajectory explains a tag's phases, each snapshot weighted by its fit."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from ...core.numerics import safe_divide, safe_norm, safe_sqrt, wrap_to_pi
from ...radio.phase import distance_to_phase

Reference = Literal["first", "absolute"]

PHASE_NOISE_RAD = 0.1
"""Standard deviation of one phase (the paper's); the difference of two has sqrt(2) times that."""


class Snapshots(eqx.Module):
    """A tag's phases and where the candidates were at the same times, in order of time; only `valid` elements count."""

    phase_rad: Float[Array, " snapshots"]  # as measured, growing with distance
    carrier_hz: Float[Array, " snapshots"]
    distance_m: Float[Array, "candidates snapshots"]  # from each candidate to the antenna
    valid: Bool[Array, "candidates snapshots"]


def theory_rad(
    position_m: Float[Array, "*batch 3"], antenna_m: Float[Array, " 3"], carrier_hz: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """The phase 4 pi |P A| / lambda that a tag at P should have (Eq. 5), unwrapped, without the diversity term."""
    away = position_m - jnp.broadcast_to(antenna_m, position_m.shape)
    return distance_to_phase(safe_norm(away), carrier_hz)


def phase_score(
    residual_rad: Float[Array, " snapshots"],
    counted: Bool[Array, " snapshots"],
    *,
    sigma_rad: float | Float[Array, ""],
    reference: Reference = "first",
    multiple: int = 1,
) -> Float[Array, ""]:
    """s = |sum_j w_j exp(J theta_j)| / N, w_j = f(theta_j; 0, sigma) / f(0; 0, sigma), in [0, 1] (IV.C, Algorithm 1).

    `residual_rad` is measured minus theoretical phase of each snapshot. theta_j is that less the first counted one's
    ("first": the diversity term drops out), or that itself ("absolute": the term is known and taken off already),
    wrapped to [-pi, pi). The paper's weight is the density f itself: a constant factor more. With `multiple` 2
    residuals count modulo pi, which pi flips leave alone. 0 where nothing counts, or one snapshot with the first as
    reference, which says nothing. Differentiable in the residuals; those that do not count may be anything, NaN too.
    """
    dtype = residual_rad.dtype
    if reference not in ("first", "absolute"):
        raise ValueError(f"Unknown reference {reference!r}; expected 'first' or 'absolute'.")
    if multiple not in (1, 2):
        raise ValueError(f"multiple is {multiple}; expected 1, or 2 for reads with pi flips.")
    if not residual_rad.shape[0]:
        return jnp.zeros((), dtype)
    theta, least = jnp.where(counted, residual_rad, 0.0), 1
    if reference == "first":
        start = jnp.take(theta, jnp.argmax(counted))
        theta, least = theta - start[None], 2
    turned = wrap_to_pi(multiple * theta)
    sigma = jnp.broadcast_to(jnp.asarray(sigma_rad, dtype), turned.shape)
    weight = jnp.exp(-0.5 * jnp.square(turned / (multiple * sigma))) * counted.astype(dtype)
    real, imaginary = jnp.sum(weight * jnp.cos(turned)), jnp.sum(weight * jnp.sin(turned))
    number = jnp.sum(counted.astype(dtype))
    score = safe_divide(safe_sqrt(jnp.square(real) + jnp.square(imaginary)), number)
    return jnp.where(number >= least, score, 0.0)


def draw_snapshots(
    valid: Bool[Array, " snapshots"], number: int, *, key: PRNGKeyArray
) -> tuple[Int[Array, " drawn"], Bool[Array, " drawn"]]:
    """Up to `number` of the valid snapshots at random, without repetition and in order of time, and which count."""
    size = min(number, valid.shape[0])
    ticket = jnp.where(valid, jax.random.uniform(key, valid.shape), -1.0)
    best, index = jax.lax.top_k(ticket, size)
    order = jnp.argsort(index)
    return index[order], best[order] >= 0


def residuals_rad(snapshots: Snapshots, hop_slope_rad_hz: Float[Array, ""]) -> Float[Array, "candidates snapshots"]:
    """Measured minus theoretical phase, for each candidate; the reader's affine offset over channels taken off.

    `hop_slope_rad_hz` is what `rf.channels.estimate_slope` finds: the slope of the reader and that of the mean
    distance, 4 pi d / c, in one. So the theoretical phase away from the mean carrier f0 takes 4 pi / c (f - f0) times
    the deviation from the candidate's mean distance only. With slope NaN hops are taken for what they are: each read's
    own carrier, no offset (the paper does not mention hopping).
    """
    known = jnp.any(snapshots.valid, axis=0)
    dtype = snapshots.phase_rad.dtype
    carriers = jnp.where(known, snapshots.carrier_hz, 0.0)
    centre_hz = safe_divide(jnp.sum(carriers), jnp.sum(known.astype(dtype)))
    off_hz = jnp.where(known, snapshots.carrier_hz - centre_hz[None], 0.0)
    share = snapshots.valid.astype(dtype)
    distance_m = jnp.where(snapshots.valid, snapshots.distance_m, 0.0)
    mean_m = safe_divide(jnp.sum(distance_m, axis=1), jnp.sum(share, axis=1))
    affine = jnp.isfinite(hop_slope_rad_hz)
    slope = jnp.where(affine, hop_slope_rad_hz, 0.0)
    carried_m = jnp.where(affine, distance_m - mean_m[:, None], distance_m)
    theory = distance_to_phase(distance_m, jnp.broadcast_to(centre_hz, distance_m.shape))
    theory = theory + distance_to_phase(carried_m, jnp.broadcast_to(off_hz[None, :], distance_m.shape))
    return (snapshots.phase_rad - slope[None] * off_hz)[None, :] - theory


@eqx.filter_jit
def match_scores(
    snapshots: Snapshots,
    *,
    key: PRNGKeyArray,
    num_snapshots: int = 30,
    num_rounds: int = 100,
    sigma_rad: float = PHASE_NOISE_RAD * 2**0.5,
    reference: Reference = "first",
    multiple: int = 1,
    hop_slope_rad_hz: Float[Array, ""] | None = None,
) -> Float[Array, " candidates"]:
    """The mean of `phase_score` over `num_rounds` draws of `num_snapshots` random snapshots, for every candidate.

    Each round's reference is the first of its own snapshots. Candidates that were there at the same times share draws.
    """
    slope = jnp.asarray(jnp.nan, snapshots.phase_rad.dtype) if hop_slope_rad_hz is None else hop_slope_rad_hz
    residual = residuals_rad(snapshots, slope)

    def one_round(round_key: PRNGKeyArray) -> Float[Array, " candidates"]:
        def one(own: Float[Array, " snapshots"], valid: Bool[Array, " snapshots"]) -> Float[Array, ""]:
            index, counted = draw_snapshots(valid, num_snapshots, key=round_key)
            return phase_score(own[index], counted, sigma_rad=sigma_rad, reference=reference, multiple=multiple)

        return jax.vmap(one)(residual, snapshots.valid)

    return jnp.mean(jax.vmap(one_round)(jax.random.split(key, num_rounds)), axis=0)
