"""The backscatter phase model (TagAttention, Eqs. 1-2): phi = 4 pi f L / c + offset, reported modulo 2 pi."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.numerics import SPEED_OF_LIGHT_M_S


def distance_to_phase(
    distance_m: Float[Array, "*batch"], carrier_hz: Float[Array, "*#batch"]
) -> Float[Array, "*batch"]:
    """Unwrapped phase 4 pi f L / c of a tag at distance L (there and back), radians."""
    return (4 * jnp.pi / SPEED_OF_LIGHT_M_S) * carrier_hz * distance_m


def phase_to_distance(phase_rad: Float[Array, "*batch"], carrier_hz: Float[Array, "*#batch"]) -> Float[Array, "*batch"]:
    """Distance L = phi c / (4 pi f) (Eq. 1) that an unwrapped phase (difference) stands for, metres."""
    return phase_rad * SPEED_OF_LIGHT_M_S / (4 * jnp.pi * carrier_hz)
