"""Top-down attention (TagAttention, Eqs. 4-6): how well each pixel's motion agrees with the tag's.

All functions take one pixel's motion vector with leading batch axes, and the validity of its samples; with every
sample valid they are the paper's equations to the letter.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._numerics import safe_divide, safe_sqrt


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
