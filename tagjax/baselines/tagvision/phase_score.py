"""TagVision's phase score (IV.C): agreement of a trajectory with a tag's phases, each snapshot weighted by its fit."""

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
    """A tag's phases and the candidates' distances at the same times, in order of time; only `valid` elements count."""

    phase_rad: Float[Array, " snapshots"]  # as measured, growing with distance
    carrier_hz: Float[Array, " snapshots"]
    distance_m: Float[Array, "candidates snapshots"]  # from each candidate to the antenna
    valid: Bool[Array, "candidates snapshots"]


def theory_rad(
    position_m: Float[Array, "*batch 3"], antenna_m: Float[Array, " 3"], carrier_hz: Float[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """The theoretical phase 4 pi |P A| / lambda of a tag at P (Eq. 5), unwrapped, without the diversity term."""
    offset_m = position_m - jnp.broadcast_to(antenna_m, position_m.shape)
    return distance_to_phase(safe_norm(offset_m), carrier_hz)


def phase_score(
    residual_rad: Float[Array, " snapshots"],
    counted: Bool[Array, " snapshots"],
    *,
    sigma_rad: float | Float[Array, ""],
    reference: Reference = "first",
    angle_multiple: int = 1,
) -> Float[Array, ""]:
    """s = |sum_j w_j exp(J theta_j)| / N, w_j = f(theta_j; 0, sigma) / f(0; 0, sigma), in [0, 1] (IV.C, Algorithm 1).

    `residual_rad` is the measured minus the theoretical phase of each snapshot. theta_j is the residual minus that of
    the first counted snapshot ("first": the diversity term cancels), or the residual itself ("absolute": the term is
    known and already subtracted), wrapped to [-pi, pi). The paper's weight is the density f itself: a constant factor.
    With `angle_multiple` 2 residuals are compared modulo pi, which makes the score invariant to pi flips. The score is
    0 without a counted snapshot, and with a single one as its own reference. It is differentiable in the residuals;
    those that do not count may have any value, NaN included.
    """
    dtype = residual_rad.dtype
    if reference not in ("first", "absolute"):
        raise ValueError(f"reference is {reference!r}; expected 'first' or 'absolute'.")
    if angle_multiple not in (1, 2):
        raise ValueError(f"angle_multiple is {angle_multiple}; expected 1, or 2 for reads with pi flips.")
    if not residual_rad.shape[0]:
        return jnp.zeros((), dtype)
    theta, min_count = jnp.where(counted, residual_rad, 0.0), 1
    if reference == "first":
        first = jnp.take(theta, jnp.argmax(counted))
        theta, min_count = theta - first[None], 2
    scaled = wrap_to_pi(angle_multiple * theta)
    sigma = jnp.broadcast_to(jnp.asarray(sigma_rad, dtype), scaled.shape)
    weight = jnp.exp(-0.5 * jnp.square(scaled / (angle_multiple * sigma))) * counted.astype(dtype)
    real, imaginary = jnp.sum(weight * jnp.cos(scaled)), jnp.sum(weight * jnp.sin(scaled))
    number = jnp.sum(counted.astype(dtype))
    score = safe_divide(safe_sqrt(jnp.square(real) + jnp.square(imaginary)), number)
    return jnp.where(number >= min_count, score, 0.0)


def draw_snapshots(
    valid: Bool[Array, " snapshots"], number: int, *, key: PRNGKeyArray
) -> tuple[Int[Array, " drawn"], Bool[Array, " drawn"]]:
    """Up to `number` random valid snapshots, without repetition and in order of time, and which of them are valid."""
    size = min(number, valid.shape[0])
    ticket = jnp.where(valid, jax.random.uniform(key, valid.shape), -1.0)
    best, index = jax.lax.top_k(ticket, size)
    order = jnp.argsort(index)
    return index[order], best[order] >= 0


def residuals_rad(snapshots: Snapshots, hop_slope_rad_hz: Float[Array, ""]) -> Float[Array, "candidates snapshots"]:
    """Measured minus theoretical phase, for each candidate, with the reader's affine phase offset over channels
    subtracted.

    `hop_slope_rad_hz` is the sum of the reader's slope and that of the mean distance, 4 pi d / c, as the hops show it.
    The theoretical phase at f - f0 from the mean carrier f0 is therefore 4 pi / c (f - f0) times the deviation from the
    candidate's mean distance. With slope NaN the theoretical phase uses each read's own carrier and no offset (the
    paper does not mention hopping).
    """
    known = jnp.any(snapshots.valid, axis=0)
    dtype = snapshots.phase_rad.dtype
    carriers = jnp.where(known, snapshots.carrier_hz, 0.0)
    centre_hz = safe_divide(jnp.sum(carriers), jnp.sum(known.astype(dtype)))
    off_hz = jnp.where(known, snapshots.carrier_hz - centre_hz[None], 0.0)
    valid = snapshots.valid.astype(dtype)
    distance_m = jnp.where(snapshots.valid, snapshots.distance_m, 0.0)
    mean_m = safe_divide(jnp.sum(distance_m, axis=1), jnp.sum(valid, axis=1))
    affine = jnp.isfinite(hop_slope_rad_hz)
    slope = jnp.where(affine, hop_slope_rad_hz, 0.0)
    deviation_m = jnp.where(affine, distance_m - mean_m[:, None], distance_m)
    theory = distance_to_phase(distance_m, jnp.broadcast_to(centre_hz, distance_m.shape))
    theory = theory + distance_to_phase(deviation_m, jnp.broadcast_to(off_hz[None, :], distance_m.shape))
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
    angle_multiple: int = 1,
    hop_slope_rad_hz: Float[Array, ""] | None = None,
) -> Float[Array, " candidates"]:
    """The mean of `phase_score` over `num_rounds` draws of `num_snapshots` random snapshots, for every candidate.

    Each round's reference is the first of its own snapshots. Candidates seen at the same times have the same draws.
    """
    slope = jnp.asarray(jnp.nan, snapshots.phase_rad.dtype) if hop_slope_rad_hz is None else hop_slope_rad_hz
    residual = residuals_rad(snapshots, slope)

    def one_round(round_key: PRNGKeyArray) -> Float[Array, " candidates"]:
        def one(own: Float[Array, " snapshots"], valid: Bool[Array, " snapshots"]) -> Float[Array, ""]:
            index, counted = draw_snapshots(valid, num_snapshots, key=round_key)
            return phase_score(
                own[index], counted, sigma_rad=sigma_rad, reference=reference, angle_multiple=angle_multiple
            )

        return jax.vmap(one)(residual, snapshots.valid)

    return jnp.mean(jax.vmap(one_round)(jax.random.split(key, num_rounds)), axis=0)
