"""Phase splicing (Tagview, IV.A, Fig. 4): the short parts that a phase modulo 2 pi is split into, put together."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import wrap_to_pi


def splice_phase(
    phase_rad: Float[Array, " reads"], valid: Bool[Array, " reads"], period_rad: float
) -> Float[Array, " reads"]:
    """The phase without its jumps: each step becomes the shortest one modulo `period_rad` (2 pi; pi where reads flip).

    theta_i = theta_{i-1} + wrap(phi_i - phi_{i-1}). Right as long as the tag moves by less than an eighth of a
    wavelength times period / pi between reads. Reads that are not valid repeat the last one before them (0 at first).
    Gradient: the identity, since whole periods carry none. No reads give none.
    """
    if not phase_rad.shape[0]:
        return phase_rad
    last = _last_valid(valid)
    held = jnp.where(last >= 0, phase_rad[jnp.maximum(last, 0)], 0.0)
    begun = (last[1:] >= 0) & (last[:-1] >= 0)
    step = jnp.where(begun, wrap_to_pi(held[1:] - held[:-1], period_rad), 0.0)
    first = jnp.where(jnp.any(valid), phase_rad[jnp.argmax(valid)], 0.0)
    spliced = first + jnp.concatenate([jnp.zeros_like(phase_rad[:1]), jnp.cumsum(step)])
    return jnp.where(last >= 0, spliced, 0.0)


def pieces(
    time_s: Float[Array, " reads"],
    channel: Int[Array, " reads"],
    valid: Bool[Array, " reads"],
    *,
    max_gap_s: float,
    break_at_hops: bool,
) -> Int[Array, " reads"]:
    """Number of the piece that each read belongs to, from 0: what lies between two breaks keeps one phase constant.

    A new piece begins after a gap of more than `max_gap_s`, over which splicing is a guess, and, if `break_at_hops`,
    where the channel changes, since every channel has a phase constant of its own. Reads that are not valid belong to
    the piece before them.
    """
    last = _last_valid(valid)
    at = jnp.maximum(last, 0)
    apart = time_s[at[1:]] - time_s[at[:-1]] > max_gap_s
    if break_at_hops:
        apart = apart | (channel[at[1:]] != channel[at[:-1]])
    begun = (last[1:] >= 0) & (last[:-1] >= 0)
    return jnp.concatenate([jnp.zeros_like(at[:1]), jnp.cumsum(apart & begun).astype(at.dtype)])


def _last_valid(valid: Bool[Array, " reads"]) -> Int[Array, " reads"]:
    """Index of the newest valid read up to each one; -1 before the first."""
    index = jnp.where(valid, jnp.arange(valid.shape[0], dtype=jnp.int32), jnp.int32(-1))
    return jnp.maximum.accumulate(index)
