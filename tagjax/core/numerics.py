"""Gradient-safe elementary functions: finite value and gradient at the degenerate input as well."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

SPEED_OF_LIGHT_M_S = 299_792_458.0
"""Speed of light in vacuum, m/s (exact, SI)."""


def safe_sqrt(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root whose gradient at x <= 0 is 0 instead of infinite or NaN."""
    positive = x > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def safe_norm(x: Float[Array, "*shape axis"]) -> Float[Array, "*shape"]:
    """Euclidean norm over the last axis; its gradient at the zero vector is 0."""
    return safe_sqrt(jnp.sum(x * x, axis=-1))


def safe_divide(numerator: Float[Array, "*shape"], denominator: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Quotient that is 0, with gradient 0, where the denominator is 0."""
    nonzero = denominator != 0
    return jnp.where(nonzero, numerator / jnp.where(nonzero, denominator, 1.0), 0.0)


def safe_atan2(y: Float[Array, "*shape"], x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Angle of (x, y) in (-pi, pi]; 0 with gradient 0 at the origin, where ``arctan2`` has a NaN gradient."""
    defined = (x != 0) | (y != 0)
    return jnp.where(defined, jnp.arctan2(jnp.where(defined, y, 0.0), jnp.where(defined, x, 1.0)), 0.0)


def wrap_to_pi(angle_rad: Float[Array, "*shape"], period_rad: float = 2 * jnp.pi) -> Float[Array, "*shape"]:
    """Angle wrapped to [-period/2, period/2); gradient 1 everywhere (the jumps carry none)."""
    return angle_rad - period_rad * jax.lax.stop_gradient(jnp.floor(angle_rad / period_rad + 0.5))


def circular_mean(
    angle_rad: Float[Array, "*shape axis"], weight: Float[Array, "*#shape axis"]
) -> Float[Array, "*shape"]:
    """Direction of the weighted resultant over the last axis; 0 where the resultant vanishes."""
    return safe_atan2(jnp.sum(weight * jnp.sin(angle_rad), axis=-1), jnp.sum(weight * jnp.cos(angle_rad), axis=-1))


def log_i0(x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """log I0(x) for x >= 0, without overflow."""
    return jnp.log(jax.scipy.special.i0e(x)) + x


def logit(probability: float) -> float:
    """Log odds of a Python probability in (0, 1); for the unconstrained initial value of a parameter."""
    if not 0.0 < probability < 1.0:
        raise ValueError(f"A probability strictly between 0 and 1 is needed; found {probability}.")
    return float(jnp.log(probability) - jnp.log1p(-probability))
