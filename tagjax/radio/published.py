"""A tag's distance as TagAttention's radio side estimates it (III.B-C), in the reading of docs/published-tracer.md.

Steps are unwrapped read by read, accelerations are judged over time slots, and a quadratic is fitted, not interpolated.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .phase import phase_to_distance
from .reads import PhaseReads
from .unwrap import MAX_ACCELERATION_M_S2

SLOT_S = 0.1
"""The acceleration rule compares mean velocities over slots of at least this length."""

HALF_S = 0.07
"""Reads within this time of a frame enter its fit; the fit therefore looks so far ahead, or `WIDE_S` where reads are few."""

WIDE_S = 0.2
"""Half of the window in its place where it holds fewer than `MIN_READS` reads."""

MIN_READS = 4

_NUM_VELOCITIES = 5
_CAPACITY = 64
"""Reads of one fit; of more the latest are used."""


def unwrap_slots(reads: PhaseReads, *, slots: bool = True) -> Float[Array, " reads"]:
    """Relative distance at every read, metres, 0 at the first.

    A step between reads of one channel is that modulo pi which is nearest to 0. At a change of channel the distance goes
    on at the median of the last five velocities. With `slots`, a slot of `SLOT_S` or more, the mean velocity of which
    differs from that of the slot before by more than 9.8 m/s^2 allows, is replaced by the velocity accepted last.
    At an invalid read the previous value is repeated.
    """

    def advance(carry, read):
        distance, last_time, last_phase, last_channel, recent, num, begin_s, begin_m, raw, accepted, num_slots = carry
        time, phase, carrier, channel, valid = read
        gap = time - last_time
        step_rad = phase - last_phase
        step = phase_to_distance(step_rad - jnp.pi * jnp.round(step_rad / jnp.pi), carrier)
        same = (channel == last_channel) & (gap > 0)
        median = jnp.where(num > 0, jnp.nanmedian(jnp.where(jnp.arange(_NUM_VELOCITIES) < num, recent, jnp.nan)), 0.0)
        move = jnp.where(channel == last_channel, step, median * gap)
        started = valid & jnp.isfinite(last_time)
        distance = jnp.where(started, distance + move, distance)
        velocity = step / jnp.where(gap > 0, gap, 1.0)
        measured = started & same
        recent = jnp.where(measured, jnp.roll(recent, 1).at[0].set(velocity), recent)
        num = num + jnp.where(measured, 1, 0)
        # Slots: their own start, the velocity measured in the last one, and the one accepted.
        first = valid & ~jnp.isfinite(begin_s)
        length = time - begin_s
        closes = started & (length >= SLOT_S)
        mean = (distance - begin_m) / jnp.where(closes, length, 1.0)
        change = jnp.abs(mean - raw) / jnp.where(closes, length, 1.0)
        wrong = closes & (num_slots > 0) & (change > MAX_ACCELERATION_M_S2) & slots
        distance = jnp.where(wrong, begin_m + accepted * length, distance)
        accepted = jnp.where(closes & ~wrong, mean, accepted)
        after = (
            distance,
            jnp.where(valid, time, last_time),
            jnp.where(valid, phase, last_phase),
            jnp.where(valid, channel, last_channel),
            recent,
            num,
            jnp.where(first | closes, time, begin_s),
            jnp.where(first | closes, distance, begin_m),
            jnp.where(closes, mean, raw),
            accepted,
            num_slots + jnp.where(closes, 1, 0),
        )
        return after, distance

    zero = jnp.zeros((), reads.time_s.dtype)
    never, none = jnp.asarray(-jnp.inf, zero.dtype), jnp.asarray(0)
    start = (
        zero, never, zero, jnp.asarray(-1, reads.channel.dtype), jnp.zeros(_NUM_VELOCITIES), none,
        never, zero, zero, zero, none,
    )  # fmt: skip
    columns = (reads.time_s, reads.phase_rad, reads.carrier_hz, reads.channel, reads.valid)
    _, distance = jax.lax.scan(advance, start, columns)
    return distance


def fit_quadratic(
    time_s: Float[Array, " reads"],
    distance_m: Float[Array, " reads"],
    valid: Bool[Array, " reads"],
    query_s: Float[Array, ""],
    half_s: Float[Array, ""],
) -> tuple[Float[Array, ""], Bool[Array, ""]]:
    """Least-squares quadratic through the valid samples, at `query_s`; and whether three different times determine it.

    Times are scaled by `half_s`, and distances taken relative to their mean, before the normal equations are solved.
    """
    weight = valid.astype(distance_m.dtype)
    count = jnp.maximum(jnp.sum(weight), 1.0)
    u = jnp.where(valid, (time_s - query_s) / half_s, 0.0)
    mean = jnp.sum(weight * jnp.where(valid, distance_m, 0.0)) / count
    y = jnp.where(valid, distance_m - mean, 0.0)
    basis = jnp.stack([jnp.ones_like(u), u, u * u], axis=-1) * weight[:, None]
    normal = basis.T @ basis / count
    right = basis.T @ y / count
    known = jnp.linalg.det(normal) > 1e-7
    solved = jnp.linalg.solve(jnp.where(known, normal, jnp.eye(3)), right)
    return solved[0] + mean, known


def published_distance(
    reads: PhaseReads, query_s: Float[Array, " query"], *, causal: bool = False, slots: bool = True
) -> tuple[Float[Array, " query"], Bool[Array, " query"]]:
    """Relative distance at given times, and where it is known.

    The fit is over `HALF_S` to both sides of a time, over `WIDE_S` where that holds fewer than `MIN_READS` reads; the
    distance is unknown where that holds too few as well, and where all of its reads lie on one side of the query. With
    `causal` the same length of time ends at the query, nothing after a frame is used, and the last read may be half of it old.
    """
    distance = unwrap_slots(reads, slots=slots)
    stamps = jnp.where(reads.valid, reads.time_s, jnp.inf)

    def fit(query: Float[Array, ""], half_s: float) -> tuple[Float[Array, ""], Bool[Array, ""], Array]:
        begin, end = (query - 2 * half_s, query) if causal else (query - half_s, query + half_s)
        last = jnp.searchsorted(stamps, end, side="right")
        index = last - _CAPACITY + jnp.arange(_CAPACITY)
        at = jnp.clip(index, 0, stamps.shape[0] - 1)
        inside = (index >= 0) & reads.valid[at] & (reads.time_s[at] >= begin)
        value, known = fit_quadratic(reads.time_s[at], distance[at], inside, query, jnp.asarray(half_s))
        first = jnp.min(jnp.where(inside, reads.time_s[at], jnp.inf))
        latest = jnp.max(jnp.where(inside, reads.time_s[at], -jnp.inf))
        near = latest >= query - half_s if causal else (first <= query) & (latest >= query)
        return value, known & near, jnp.sum(inside)

    def one(query: Float[Array, ""]) -> tuple[Float[Array, ""], Bool[Array, ""]]:
        near, near_known, near_count = fit(query, HALF_S)
        wide, wide_known, wide_count = fit(query, WIDE_S)
        enough = near_known & (near_count >= MIN_READS)
        return jnp.where(enough, near, wide), enough | (wide_known & (wide_count >= MIN_READS))

    return jax.vmap(one)(query_s)
