"""Attention propagation (TagAttention, Eq. 7) as a log-odds filter with a velocity gate and forgetting."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.numerics import safe_divide


def radio_speed(relative_m: Float[Array, "*batch window"], time_s: Float[Array, " window"]) -> Float[Array, "*batch"]:
    """Absolute speed |rd_last - rd_first| / (t_last - t_first) over the window (below Eq. 7), m/s; 0 if no time passed."""
    return safe_divide(jnp.abs(relative_m[..., -1] - relative_m[..., 0]), time_s[-1] - time_s[0])


def velocity_gate(
    speed_m_s: Float[Array, "*batch"], threshold_m_s: Float[Array, ""], width_m_s: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """sigmoid((v - v0) / width): the step Theta(v - v0) of Eq. 7 as width -> 0."""
    return jax.nn.sigmoid((speed_m_s - threshold_m_s) / width_m_s)


def log_likelihood_ratio(
    attention: Float[Array, "*batch"], background: Float[Array, "*#batch"], floor: Float[Array, ""]
) -> Float[Array, "*batch"]:
    """log((a + floor) / (a0 + floor)): evidence of an attention a for the object against the background class.

    a0 is the attention at which a pixel is as likely background; `floor` bounds what one wrong frame can do. With
    a0 = 1 and floor -> 0 this is the log a of Eq. 7.
    """
    return jnp.log(attention + floor) - jnp.log(background + floor)


def propagate(
    carried: Float[Array, "*batch"],
    evidence: Float[Array, "*#batch"],
    gate: Float[Array, "*#batch"],
    forgetting: Float[Array, ""],
) -> Float[Array, "*batch"]:
    """l' = forgetting^gate * warp(l) + gate * evidence.

    Eq. 7 with forgetting = 1. A closed gate leaves the map as it is: what rests is remembered, not forgotten.
    """
    return forgetting**gate * carried + gate * evidence
