"""Hermite interpolation of unevenly spaced samples (Tagview, IV.B): to bring reads and frames to the same times."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...core.numerics import safe_divide


def interpolate(
    time_s: Float[Array, " knots"],
    value: Float[Array, " knots"],
    valid: Bool[Array, " knots"],
    at_s: Float[Array, " at"],
) -> Float[Array, " at"]:
    """Monotone cubic Hermite interpolation (Fritsch and Butland, 1984; SciPy's PCHIP), `value` held beyond the ends.

    Times do not fall; of equal ones the last counts. Valid knots come first, padding after them. One knot gives a
    constant, two a line, none 0. Finite gradients throughout: a knot at which the secants change sign has slope 0.
    """
    size = value.shape[0]
    if size < 2:
        return jnp.broadcast_to(jnp.sum(jnp.where(valid, value, 0.0)), at_s.shape)
    count = jnp.sum(valid).astype(jnp.int32)
    final = jnp.maximum(count - 1, 0)
    time_s, value = jnp.where(valid, time_s, time_s[final]), jnp.where(valid, value, value[final])
    width = time_s[1:] - time_s[:-1]
    secant = safe_divide(value[1:] - value[:-1], width)
    slope = _slopes(width, secant, final)
    knots = jnp.where(valid, time_s, jnp.inf)
    left = jnp.clip(jnp.searchsorted(knots, at_s, side="right").astype(jnp.int32) - 1, 0, jnp.maximum(final - 1, 0))
    inside = jnp.clip(at_s, time_s[0], time_s[final])
    share = jnp.clip(safe_divide(inside - time_s[left], width[left]), 0.0, 1.0)
    rest = 1.0 - share
    # Written from the nearer knot's value, so that large phases lose no digits.
    bend = share * rest * width[left] * (rest * slope[left] - share * slope[left + 1])
    rise = share * share * (3.0 - 2.0 * share) * (value[left + 1] - value[left])
    return jnp.where(count > 0, value[left] + rise + bend, 0.0)


def _slopes(width: Float[Array, " gaps"], secant: Float[Array, " gaps"], final: Array) -> Float[Array, " knots"]:
    """Derivative at each knot: weighted harmonic mean of the secants beside it, one-sided at the two ends."""
    before, after = secant[:-1], secant[1:]
    outer, inner = 2.0 * width[1:] + width[:-1], width[1:] + 2.0 * width[:-1]
    same = before * after > 0
    mean = safe_divide(
        jnp.where(same, (outer + inner) * before * after, 0.0), jnp.where(same, outer * after + inner * before, 0.0)
    )
    slope = jnp.concatenate([secant[:1], mean, secant[-1:]])
    lone = final < 2
    at = jnp.maximum(final - 1, 0)
    second = jnp.minimum(1, width.shape[0] - 1)
    ahead = _end_slope(width[0], width[second], secant[0], secant[second])
    behind = _end_slope(width[at], width[jnp.maximum(at - 1, 0)], secant[at], secant[jnp.maximum(at - 1, 0)])
    slope = slope.at[0].set(jnp.where(lone, secant[0], ahead))
    return slope.at[final].set(jnp.where(lone, secant[0], behind))


def _end_slope(near: Array, far: Array, secant: Array, further: Array) -> Array:
    """Three-point derivative at an end, kept to the shape of the data (as in SciPy)."""
    slope = safe_divide((2.0 * near + far) * secant - near * further, near + far)
    slope = jnp.where(slope * secant <= 0, 0.0, slope)
    limit = (secant * further <= 0) & (jnp.abs(slope) > 3.0 * jnp.abs(secant))
    return jnp.where(limit, 3.0 * secant, slope)
