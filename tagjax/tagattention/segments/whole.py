"""What walks is one body: all that is connected with the tag's body and travels is part of it.

The parts of a walking person move against each other, so that no rigid motion holds them together. But all of them get
on, while the arm of someone who stays in place goes to and fro: over two thirds of a second its net displacement is small.
So where most of a tag's body travels, the segments that travel too, and are connected with it by segments that travel,
belong to it. Segments on legs hardly live for so long: those that are younger than that belong as well. What is not in
front of the surface that has been seen at rest there is a shadow on it, and no part of a body. Dark clothes have no depth and
leave a gap. What stands upright has its parts above each other, so a gap may be higher than it may be wide.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.constrained import Fraction, Positive
from ...core.numerics import safe_divide, safe_norm
from ...core.parameters import check_positive
from .connection import connected, touching
from .step import SegmentFrame

_FEW = 256  # segments that may belong to bodies that travel; in a crowd there are more
_UPRIGHT = 0.65  # heights count so much where segments are connected: a gap may be 1.5 times as high as wide
_MOST = 0.95  # probability that a connected segment belongs to the body


class WholeBody(eqx.Module):
    """Stage that completes bodies that travel. `WholeBody()` has good values."""

    travel_m_s: Positive  # net displacement over `lag_s`, above which a segment travels
    share: Fraction  # a body travels where so much of it does, connected and in front
    lag_s: float = eqx.field(static=True)
    num_active: int = eqx.field(static=True)  # segments that are looked at: those that most likely travel

    def __init__(
        self,
        *,
        travel_m_s: float = 0.2,
        share: float = 0.5,
        lag_s: float = 0.67,
        num_active: int = 1024,
    ) -> None:
        """Raises `ValueError` for a value that is not positive, or a share that is not between 0 and 1."""
        check_positive(lag_s=lag_s)
        if num_active < 1:
            raise ValueError(f"num_active is {num_active}; expected at least 1.")
        self.travel_m_s, self.share = Positive(travel_m_s), Fraction(share)
        self.lag_s, self.num_active = float(lag_s), num_active

    def completed(
        self,
        membership: Float[Array, "tag segment"],
        found: SegmentFrame,
        moved_m: Float[Array, "segment 3"],
        elapsed_s: Float[Array, " segment"],
    ) -> Float[Array, "tag segment"]:
        """The membership (probabilities) with all of each body that travels.

        `moved_m` is each segment's displacement over `elapsed_s`: about `lag_s`, or since its birth where that is shorter. A young
        segment has not travelled yet.
        """
        num_segments = found.area.shape[0]
        exists = found.in_view
        speed_m_s = safe_norm(moved_m) / jnp.maximum(elapsed_s, self.lag_s)
        limit_m_s = self.travel_m_s.value
        travels = jnp.where(exists, jax.nn.sigmoid((speed_m_s - limit_m_s) / (0.2 * limit_m_s)), 0.0)
        in_front = exists & (found.front > 0.5)
        joins = jnp.where(in_front, jnp.where(found.life_s < self.lag_s, 1.0, travels), 0.0)
        _, at = jax.lax.top_k(jax.lax.stop_gradient(joins), min(self.num_active, num_segments))
        body = self._connected(flattened(found.centre_m)[at], found.size_m[at], joins[at] > 0.5)

        least = jax.nn.sigmoid(-self.share.value / 0.1)  # a body of which nothing travels takes nothing along

        def of_tag(own: Float[Array, " segment"]) -> Float[Array, " segment"]:
            weight = own * found.area
            of_body = jax.ops.segment_sum((weight * travels * joins)[at], body, at.shape[0])
            most = jnp.argmax(of_body).astype(body.dtype)
            share = safe_divide(of_body[most], jnp.sum(weight))
            goes = (jax.nn.sigmoid((share - self.share.value) / 0.1) - least) / (1.0 - least)
            same = body == most
            more = jnp.where(same, _MOST * goes * joins[at], 0.0)
            return own.at[at].set(1.0 - (1.0 - own[at]) * (1.0 - more))

        return jax.vmap(of_tag)(membership)

    def _connected(
        self, centre_m: Float[Array, "active 3"], size_m: Float[Array, " active"], member: Bool[Array, " active"]
    ) -> Int[Array, " active"]:
        """`connected`, which costs the square of the number of segments, of the first few alone where these are all members."""
        num_active, few = len(centre_m), min(_FEW, len(centre_m))

        def of_few(_: None) -> Int[Array, " active"]:
            index = jnp.arange(num_active, dtype=jnp.int32)
            return index.at[:few].set(connected(touching(centre_m[:few], size_m[:few]), member[:few]))

        return jax.lax.cond(
            jnp.sum(member) <= few, of_few, lambda _: connected(touching(centre_m, size_m), member), operand=None
        )


def flattened(centre_m: Float[Array, "segment 3"]) -> Float[Array, "segment 3"]:
    """The places with lower heights (y, down): their distances decide what is connected."""
    return centre_m * jnp.array([[1.0, _UPRIGHT, 1.0]], centre_m.dtype)
