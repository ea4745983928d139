"""The paper's de-periodicity and motion smoothing (TagAttention, III.B), as published."""

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
"""Gravity: a larger acceleration is taken for an unwrapping error."""


def remove_jump(step_rad: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """A phase step without its jump of pi or 2 pi, by thresholds th1 = 0.5 pi and th2 = 1.5 pi."""
    size = jnp.abs(step_rad)
    jump = jnp.where(size >= TWO_PI_JUMP_RAD, 2.0 * jnp.pi, jnp.where(size >= PI_JUMP_RAD, jnp.pi, 0.0))
    return step_rad - jnp.sign(step_rad) * jump


def unwrap_paper(reads: PhaseReads) -> Float[Array, " reads"]:
    """Relative distance at every read, metres, 0 at the first (Eq. 2).

    Steps between reads of one channel are unwrapped by thresholds; at a channel change the distance stays the same. A
    step whose velocity differs from the previous measured velocity by more than 9.8 m/s^2 allows is replaced by the
    previous accepted velocity times the elapsed time. (Compared with the accepted velocity instead, one replaced step
    can cause the next, without end; only after a channel change, which measures no velocity, is the accepted one used.)
    At an invalid read the previous value is repeated.
    """

    def advance(carry, read):
        distance, velocity, raw, last_time, last_phase, last_channel, last_gap, num_reads = carry
        time, phase, carrier, channel, valid = read
        gap = jnp.maximum(time - last_time, 1e-6)
        step = phase_to_distance(remove_jump(phase - last_phase), carrier)
        same = channel == last_channel
        new_velocity = jnp.where(same, step / gap, velocity)
        exceeds_limit = jnp.abs(new_velocity - raw) / (0.5 * (gap + last_gap)) > MAX_ACCELERATION_M_S2
        # An acceleration needs two velocities.
        exceeds_limit = exceeds_limit & same & (num_reads >= 2)
        accepted_velocity = jnp.where(exceeds_limit, velocity, new_velocity)
        accepted_step = jnp.where(same, jnp.where(exceeds_limit, velocity * gap, step), 0.0)
        use = valid & (num_reads >= 1)
        moved = jnp.where(use, distance + accepted_step, distance)
        state = (
            moved,
            jnp.where(use, accepted_velocity, velocity),
            jnp.where(use, new_velocity, raw),
            jnp.where(valid, time, last_time),
            jnp.where(valid, phase, last_phase),
            jnp.where(valid, channel, last_channel),
            jnp.where(use, gap, last_gap),
            num_reads + jnp.where(valid & (same | (num_reads == 0)), 1, 0),
        )
        return state, moved

    zero = jnp.zeros((), reads.time_s.dtype)
    first = (zero, zero, zero, zero, zero, jnp.asarray(-1, reads.channel.dtype), zero + 0.02, jnp.asarray(0))
    _, distance = jax.lax.scan(
        advance, first, (reads.time_s, reads.phase_rad, reads.carrier_hz, reads.channel, reads.valid)
    )
    return distance
