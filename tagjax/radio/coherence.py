"""How well a distance over time explains raw phase reads, without any unwrapping: coherence, and likelihood."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from ..core.numerics import SPEED_OF_LIGHT_M_S, log_i0, safe_atan2, safe_sqrt


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


def phase_likelihood(
    residual_rad: Float[Array, "*batch reads"],
    concentration: Float[Array, "*#batch reads"],
    channel: Int[Array, "*#batch reads"],
    *,
    num_channels: int,
    flip_share: float,
    num_iterations: int = 3,
) -> Float[Array, "*batch"]:
    """Log likelihood ratio of reads to phases at random, offsets profiled out and pi flips marginalised, in nats.

    sum_c max_o sum_{r in c} log [(1 - q) exp(k_r cos(e_r - o)) + q exp(-k_r cos(e_r - o))] / I0(k_r): von Mises noise of concentration k_r (0 for what is no read), flips of probability q = `flip_share` in
    (0, 1), each channel's offset o the most likely one. The doubled angle gives it modulo pi, and expectation-maximisation
    of the flips from both ends refines it. It carries no gradient, since the likelihood is stationary there. Without reads 0.
    """
    residual_rad, concentration, channel = jnp.broadcast_arrays(residual_rad, concentration, channel)
    member = jax.nn.one_hot(channel, num_channels, dtype=residual_rad.dtype)
    fixed = jax.lax.stop_gradient(residual_rad)
    log_odds = jnp.log1p(-flip_share) - jnp.log(flip_share)

    def of_channels(values: Float[Array, "*batch reads"]) -> Float[Array, "*batch channels"]:
        return jnp.einsum("...r,...rc->...c", values, member)

    def of_reads(values: Float[Array, "*batch channels"]) -> Float[Array, "*batch reads"]:
        return jnp.einsum("...c,...rc->...r", values, member)

    def direction(weight: Float[Array, "*batch reads"], multiple: float) -> Float[Array, "*batch channels"]:
        angle = multiple * fixed
        return safe_atan2(of_channels(weight * jnp.sin(angle)), of_channels(weight * jnp.cos(angle))) / multiple

    def likelihood(offset: Float[Array, "*batch channels"]) -> Float[Array, "*batch channels"]:
        for _ in range(num_iterations):
            towards = concentration * jnp.cos(fixed - of_reads(offset))
            offset = direction(concentration * jnp.tanh(towards + 0.5 * log_odds), 1.0)
        towards = concentration * jnp.cos(residual_rad - of_reads(jax.lax.stop_gradient(offset)))
        either = jnp.logaddexp(towards + jnp.log1p(-flip_share), jnp.log(flip_share) - towards)
        return of_channels(either - log_i0(concentration))

    half = direction(concentration, 2.0)
    return jnp.sum(jnp.maximum(likelihood(half), likelihood(half + jnp.pi)), axis=-1)
