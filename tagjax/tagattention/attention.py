"""Top-down attention (TagAttention, Eqs. 4-6): how well each pixel's motion agrees with the tag's.

Those of the paper take one pixel's motion vector with leading batch axes, and the validity of its samples; with every
sample valid they are the paper's equations to the letter.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.numerics import safe_divide, safe_sqrt
from ..radio.coherence import coherence, phase_residual
from ..radio.reads import PhaseReads


def centre_first(
    motion_m: Float[Array, "*batch window"], valid: Bool[Array, "*batch window"]
) -> Float[Array, "*batch window"]:
    """Motion relative to the window's first frame (rho of the paper); 0 where a sample or the first is unknown."""
    return jnp.where(valid & valid[..., :1], motion_m - motion_m[..., :1], 0.0)


def att_rbf(
    rho_m: Float[Array, "*batch window"],
    rd_m: Float[Array, "*#batch window"],
    valid: Bool[Array, "*batch window"],
    alpha_m2: Float[Array, "*#batch"],
) -> Float[Array, "*batch"]:
    """Radial-basis attention exp(-||rho - rd||^2 / (2 alpha)) in (0, 1] (Eq. 4).

    Unknown samples are left out and the sum scaled to the whole window, so that alpha keeps its meaning.
    """
    return jnp.exp(-misfit_m2(rho_m, rd_m, valid) / (2.0 * alpha_m2))


def misfit_m2(
    rho_m: Float[Array, "*batch window"], rd_m: Float[Array, "*#batch window"], valid: Bool[Array, "*batch window"]
) -> Float[Array, "*batch"]:
    """||rho - rd||^2 over the valid samples, scaled to the whole window."""
    weight = valid.astype(rho_m.dtype)
    squared = jnp.sum(weight * jnp.square(rho_m - rd_m), axis=-1)
    return squared * rho_m.shape[-1] / jnp.maximum(jnp.sum(weight, axis=-1), 1.0)


def att_corr(
    rho_m: Float[Array, "*batch window"], rd_m: Float[Array, "*#batch window"], valid: Bool[Array, "*batch window"]
) -> Float[Array, "*batch"]:
    """Correlation attention relu(corr(rho, rd)) in [0, 1] (Eq. 5); 0 where either does not vary."""
    weight = valid.astype(rho_m.dtype)
    count = jnp.maximum(jnp.sum(weight, axis=-1, keepdims=True), 1.0)
    rho = weight * (rho_m - jnp.sum(weight * rho_m, axis=-1, keepdims=True) / count)
    rd = weight * (rd_m - jnp.sum(weight * rd_m, axis=-1, keepdims=True) / count)
    covariance = jnp.sum(rho * rd, axis=-1)
    scale = safe_sqrt(_varying(jnp.sum(rho * rho, axis=-1))) * safe_sqrt(_varying(jnp.sum(rd * rd, axis=-1)))
    return jnp.clip(jax.nn.relu(safe_divide(covariance, scale)), 0.0, 1.0)


def _varying(squares_m2: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Sums of squares below (0.1 um)^2 taken for none: rounding, whose quotients have no finite gradient."""
    return jnp.where(squares_m2 > 1e-14, squares_m2, 0.0)


def attention(
    rbf: Float[Array, "*batch"], corr: Float[Array, "*batch"], beta: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """Att_RF = beta Att_rbf + (1 - beta) Att_corr (Eq. 6)."""
    return beta * rbf + (1.0 - beta) * corr


def _first_of_channel(reads: PhaseReads) -> Array:
    """Reads grouped by channel within the buffer: each read's group is the index of the channel's first read."""
    same = reads.channel[:, None] == reads.channel[None, :]
    return jnp.argmax(same & reads.valid[None, :], axis=1)


def coherent_score(
    rho_m: Float[Array, "rows columns window"],
    reads: PhaseReads,
    time_s: Float[Array, " window"],
    *,
    doubled_angle: bool,
) -> Float[Array, "rows columns"]:
    """Coherence of raw reads with motion known at frame times, linear in between; in [0, 1]."""
    upper = jnp.clip(jnp.searchsorted(time_s, reads.time_s), 1, time_s.shape[0] - 1)
    span = time_s[upper] - time_s[upper - 1]
    fraction = jnp.clip((reads.time_s - time_s[upper - 1]) / jnp.where(span > 0, span, 1.0), 0.0, 1.0)
    share = fraction[None, None]
    distance = rho_m[..., upper - 1] * (1.0 - share) + rho_m[..., upper] * share
    residual = phase_residual(reads.phase_rad[None, None], reads.carrier_hz[None, None], distance)
    weight = reads.valid.astype(rho_m.dtype) / (jnp.square(reads.sigma_rad) + 0.1)
    return coherence(
        residual,
        weight[None, None],
        _first_of_channel(reads)[None, None],
        num_channels=reads.channel.shape[0],
        multiple=2 if doubled_angle else 1,
    )
