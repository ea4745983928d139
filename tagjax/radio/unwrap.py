"""The paper's de-periodicity and motion smoothing (TagAttention, III.B), to the letter."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from .phase import phase_to_distance
from .reads import PhaseReads

PI_JUMP_RAD = 0.5 * jnp.pi
"""th1: a larger step is a pi jump."""

TWO_PI_JUMP_RAD = 1.5 * jnp.pi
"""th2: a larger step is a 2 pi jump."""

MAX_ACCELERATION_M_S2 = 9.8
"""Gravity: a larger acceleration is taken for a wrong jump."""


def remove_jump(step_rad: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """A phase step with a jump of pi or 2 pi taken out, by thresholds th1 = 0.5 pi and th2 = 1.5 pi."""
    size = jnp.abs(step_rad)
    jump = jnp.where(size >= TWO_PI_JUMP_RAD, 2.0 * jnp.pi, jnp.where(size >= PI_JUMP_RAD, jnp.pi, 0.0))
    return step_rad - jnp.sign(step_rad) * jump


def unwrap_paper(reads: PhaseReads) -> Float[Array, " reads"]:
    """Relative distance at every read, metres, 0 at the first (Eq. 2).

    Steps between reads of one channel are unwrapped by thresholds; at a channel change the distance is held. A step
    whose velocity differs from the one before by more than 9.8 m/s^2 allows is replaced by the previous velocity
    times the elapsed time. (Measured against the previous kept velocity instead, one refusal can lead to the next for
    good; only after a channel change, which measures none, is it the kept one.) Invalid reads repeat the value before them.
    """

    def advance(carry, read):
        distance, velocity, raw, last_time, last_phase, last_channel, last_gap, seen = carry
        time, phase, carrier, channel, valid = read
        gap = jnp.maximum(time - last_time, 1e-6)
        step = phase_to_distance(remove_jump(phase - last_phase), carrier)
        same = channel == last_channel
        new_velocity = jnp.where(same, step / gap, velocity)
        too_much = jnp.abs(new_velocity - raw) / (0.5 * (gap + last_gap)) > MAX_ACCELERATION_M_S2
        # There is no acceleration before there are two velocities.
        too_much = too_much & same & (seen >= 2)
        kept_velocity = jnp.where(too_much, velocity, new_velocity)
        kept_step = jnp.where(same, jnp.where(too_much, velocity * gap, step), 0.0)
        use = valid & (seen >= 1)
        moved = jnp.where(use, distance + kept_step, distance)
        state = (
            moved,
            jnp.where(use, kept_velocity, velocity),
            jnp.where(use, new_velocity, raw),
            jnp.where(valid, time, last_time),
            jnp.where(valid, phase, last_phase),
            jnp.where(valid, channel, last_channel),
            jnp.where(use, gap, last_gap),
            seen + jnp.where(valid & (same | (seen == 0)), 1, 0),
        )
        return state, moved

    zero = jnp.zeros((), reads.time_s.dtype)
    first = (zero, zero, zero, zero, zero, jnp.asarray(-1, reads.channel.dtype), zero + 0.02, jnp.asarray(0))
    _, distance = jax.lax.scan(
        advance, first, (reads.time_s, reads.phase_rad, reads.carrier_hz, reads.channel, reads.valid)
    )
    return distance
