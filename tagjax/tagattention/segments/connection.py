"""Which segments are connected in space."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import squared_distance

GAP = 3.0
"""Segments touch where their middles are not further apart than this many times their mean size."""

_ROUNDS = 6
_STEPS = 16  # each as far as the gap: 2.8 m with segments of 6 cm


def touching(centre_m: Float[Array, "segment 3"], size_m: Float[Array, " segment"]) -> Bool[Array, "segment segment"]:
    """Whether two segments touch; none has to exist."""
    return squared_distance(centre_m, centre_m) < jnp.square(0.5 * GAP * (size_m[:, None] + size_m[None]))


def connected(touch: Bool[Array, "segment segment"], member: Bool[Array, " segment"]) -> Int[Array, " segment"]:
    """The largest index of a segment in each one's connected component; a segment that is no member is one by itself.

    A chain of more than some 100 segments may be split: indices are passed on six times.
    """
    touch = (touch & member[:, None] & member[None]) | jnp.eye(len(member), dtype=bool)
    index = jnp.arange(len(member), dtype=jnp.int32)

    def spread(_: Int[Array, ""], index: Int[Array, " segment"]) -> Int[Array, " segment"]:
        index = jnp.max(jnp.where(touch, index[None], -1), axis=1)
        index = index[index]
        return index[index]

    return jax.lax.fori_loop(0, _ROUNDS, spread, index)


def reached(
    touch: Bool[Array, "segment segment"], member: Bool[Array, " segment"], start: Int[Array, ""]
) -> Bool[Array, " segment"]:
    """Members that are connected with the segment `start` by members, itself included, in at most 16 steps."""
    begin, neighbours = jnp.arange(len(member)) == start, touch.astype(jnp.float32)

    def spread(_: Int[Array, ""], found: Float[Array, " segment"]) -> Float[Array, " segment"]:
        return (begin | (member & (neighbours @ found > 0))).astype(found.dtype)

    return jax.lax.fori_loop(0, _STEPS, spread, begin.astype(jnp.float32)) > 0
