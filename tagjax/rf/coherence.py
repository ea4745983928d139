"""Coherent phase score: how well a distance over time explains raw phase reads, without any unwrapping."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from .._numerics import SPEED_OF_LIGHT_M_S, safe_sqrt


def phase_residual(
    phase_rad: Float[Array, "*#batch reads"],
    carrier_hz: Float[Array, "*#batch reads"],
    distance_m: Float[Array, "*batch reads"],
) -> Float[Array, "*batch reads"]:
    """phi - 4 pi f d / c: constant within a channel if the distance is right up to a constant."""
    return phase_rad - (4 * jnp.pi / SPEED_OF_LIGHT_M_S) * carrier_hz * distance_m


def coherence(
    residual_rad: Float[Array, "*batch reads"],
    weight: Float[Array, "*#batch reads"],
    channel: Int[Array, "*#batch reads"],
    *,
    num_channels: int,
    multiple: int = 1,
) -> Float[Array, "*batch"]:
    """sum_c |sum_{r in c} w_r exp(j m residual_r)| / sum_r w_r, in [0, 1]; 0 without reads.

    Generalises TagVision's coherent matching score to hopping reads: the unknown phase offset of each channel c is
    profiled out by the magnitude. `multiple` m = 2 takes the doubled angle, which pi flips leave alone.
    """
    angle = multiple * residual_rad
    member = jax.nn.one_hot(channel, num_channels, dtype=residual_rad.dtype) * weight[..., None]
    member = jnp.broadcast_to(member, (*angle.shape, num_channels))
    real = jnp.einsum("...r,...rc->...c", jnp.cos(angle), member)
    imaginary = jnp.einsum("...r,...rc->...c", jnp.sin(angle), member)
    total = jnp.sum(jnp.broadcast_to(weight, angle.shape), axis=-1)
    magnitude = jnp.sum(safe_sqrt(real * real + imaginary * imaginary), axis=-1)
    return jnp.where(total > 0, magnitude / jnp.where(total > 0, total, 1.0), 0.0)
