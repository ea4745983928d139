"""What travels together: the motion of each segment, pooled over the neighbours that have moved with it.

A flow's errors are large for a small segment of a distant person, and small for the person. So this frame's motion is
averaged over segments nearby whose displacement over `lag_s` is the same within a tolerance, as `RigidMotion` has it. A
metre travelled together makes parts of one body of things that also move against each other, as limbs do; an object and
the arm that holds it move against each other by as much as they travel, and stay apart. New segments go on from where they
come from, or from the nearest mover, so that a body's past outlives its segments.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.constrained import Positive
from ...core.numerics import safe_norm, squared_distance
from ...core.parameters import check_positive
from .past_motion import PastMotion
from .step import SegmentFrame

_SELF = 1e-6  # weight of a segment among its neighbours where none is known, pixels
_SHORTEST_S = 0.125  # speeds are measured over at least this time


class TravelState(eqx.Module):
    """What is carried from frame to frame; new segments inherit it."""

    past: PastMotion
    displacement_m: Float[Array, "segment 3"]
    life_s: Float[Array, " segment"]


class Pooling(eqx.Module):
    """Which segments' motion is pooled with which."""

    active: Int[Array, " active"]  # the segments that move fastest
    pooled: Bool[Array, " active"]  # some motion was measured nearby
    weight: Float[Array, "active active"]  # rows sum to 1
    lagged_m: Float[Array, "active 3"]  # displacement over `lagged_s`: `lag_s`, or since birth where that is shorter
    lagged_s: Float[Array, " active"]

    def mean(self, values: Float[Array, "segment axis"]) -> Float[Array, "segment axis"]:
        """The values of the segments that are pooled, each a mean over those it is pooled with."""
        own = values[self.active]
        return values.at[self.active].set(jnp.where(self.pooled[:, None], self.weight @ own, own))


class TravellingTogether(eqx.Module):
    """Stage that pools motion. `TravellingTogether()` has good values, the same for hand-held objects and people.

    Chosen on simulated training recordings, where scores change little for `reach_m` 0.2 to 0.3, `lag_s` 0.5 to 0.8 and
    `travel_per_m` 0.2 to 0.4.
    """

    reach_m: Positive  # standard deviation of the neighbourhood
    noise_m: Positive  # displacements that differ by this are the same
    noise_fraction: Positive  # ... by this fraction of the displacement
    travel_per_m: Positive  # ... by this times the displacement squared
    heal_s: Positive  # evidence is pooled as well, with this time constant
    num_active: int = eqx.field(static=True)
    num_newborn: int = eqx.field(static=True)  # segments from nowhere that are looked at, the largest
    lag_s: float = eqx.field(static=True)
    adopt_m: float = eqx.field(static=True)  # a segment from nowhere goes on from a mover within this distance
    mover_m_s: float = eqx.field(static=True)  # speed of such a mover

    def __init__(
        self,
        *,
        reach_m: float = 0.25,
        noise_m: float = 0.004,
        noise_fraction: float = 0.08,
        travel_per_m: float = 0.4,
        adopt_m: float = 0.3,
        mover_m_s: float = 0.3,
        heal_s: float = 0.3,
        num_active: int = 384,
        num_newborn: int = 128,
        lag_s: float = 0.5,
    ) -> None:
        """Raises `ValueError` for a value that is not positive."""
        for name, count in (("num_active", num_active), ("num_newborn", num_newborn)):
            if count < 1:
                raise ValueError(f"{name} is {count}; expected at least 1.")
        check_positive(lag_s=lag_s, adopt_m=adopt_m, mover_m_s=mover_m_s)
        self.reach_m = Positive(reach_m)
        self.noise_m = Positive(noise_m)
        self.noise_fraction = Positive(noise_fraction)
        self.travel_per_m = Positive(travel_per_m)
        self.heal_s = Positive(heal_s)
        self.num_active, self.num_newborn = num_active, num_newborn
        self.lag_s, self.adopt_m, self.mover_m_s = float(lag_s), float(adopt_m), float(mover_m_s)

    def init(self, num_segments: int) -> TravelState:
        """The state before the first frame."""
        past = PastMotion.nothing(num_segments, span_s=self.lag_s)
        return TravelState(past, jnp.zeros((num_segments, 3)), jnp.zeros(num_segments))

    def step(
        self,
        state: TravelState,
        found: SegmentFrame,
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> tuple[TravelState, SegmentFrame, Pooling]:
        """The state after the frame at `now_s`; its segments with pooled motion and inherited past; and the pooling.

        Of the segments, `increment_m` is pooled; `displacement_m` and `life_s` go on from the past of what a segment comes
        from; `source` has movers nearby for segments that came from nowhere.
        """
        increment_m, motion_m, known, centre_m = found.increment_m, found.motion_m, found.known, found.centre_m
        area, source = found.area, found.source
        num_segments, dt_s = area.shape[0], now_s - since_s
        newborn = source > -2
        moved_m = jnp.where(newborn[:, None], 0.0, motion_m)
        before = _inherit(state, source)
        lagged_m, elapsed_s = before.past.since(
            self.lag_s, before.displacement_m + moved_m, before.life_s + dt_s, now_s
        )
        speed = safe_norm(lagged_m) / jnp.maximum(elapsed_s, _SHORTEST_S)
        num_active = min(self.num_active, num_segments)
        fastest, active = jax.lax.top_k(jax.lax.stop_gradient(jnp.where(found.in_view, speed, -1.0)), num_active)
        there = fastest >= 0
        source = self._adopted(
            source, centre_m, jnp.where(found.in_view, area, 0.0), active, there & (fastest > 0), newborn, speed
        )

        # How far they have travelled is taken as given: each frame's pooling depends on it sharply, and it on the pooling of
        # all frames before, so that the gradient through both grows beyond bounds.
        centre, lagged = centre_m[active], jax.lax.stop_gradient(lagged_m[active])
        measured = there & known[active] & ~newborn[active]
        weight = self._kernel(centre, lagged) * jnp.where(measured, area[active], 0.0)[None]
        total = jnp.sum(weight, axis=1)
        weight = (weight + _SELF * jnp.eye(num_active)) / (total + _SELF)[:, None]
        pooled = there & (total > 1.0)
        pooling = Pooling(active, pooled, weight, lagged, elapsed_s[active])
        motion_m = pooling.mean(motion_m)
        own = increment_m[:, active]
        increment_m = increment_m.at[:, active].set(jnp.where(pooled[None], own @ weight.T, own))

        after = _inherit(state, source)
        displacement_m = after.displacement_m + jnp.where(newborn[:, None], 0.0, motion_m)
        past = after.past.add(displacement_m, now_s)
        after = TravelState(past, displacement_m, after.life_s + dt_s)
        found = eqx.tree_at(
            lambda one: (one.increment_m, one.displacement_m, one.life_s, one.source),
            found,
            (increment_m, displacement_m, after.life_s, source),
        )
        return after, found, pooling

    def heal(
        self, pooling: Pooling, log_likelihood: Float[Array, "tag segment"], dt_s: Float[Array, ""]
    ) -> Float[Array, "tag segment"]:
        """Evidence drawn to that of what travels together, so that a new segment's wrong inheritance does not last."""
        part = 1.0 - jnp.exp(-dt_s / self.heal_s.value)
        own = log_likelihood[:, pooling.active]
        healed = own + part * (own @ pooling.weight.T - own)
        return log_likelihood.at[:, pooling.active].set(jnp.where(pooling.pooled[None], healed, own))

    def _kernel(
        self, centre_m: Float[Array, "active 3"], lagged_m: Float[Array, "active 3"]
    ) -> Float[Array, "active active"]:
        apart = squared_distance(centre_m, centre_m)
        against = squared_distance(lagged_m, lagged_m)
        length = safe_norm(lagged_m)
        further = jnp.maximum(length[:, None], length[None])
        variance = (
            jnp.square(self.noise_m.value)
            + jnp.square(self.noise_fraction.value * further)
            + jnp.square(self.travel_per_m.value * jnp.square(further))
        )
        return jnp.exp(-0.5 * (apart / jnp.square(self.reach_m.value) + against / variance))

    def _adopted(
        self,
        source: Int[Array, " segment"],
        centre_m: Float[Array, "segment 3"],
        area: Float[Array, " segment"],
        active: Int[Array, " active"],
        there: Bool[Array, " active"],
        newborn: Bool[Array, " segment"],
        speed_m_s: Float[Array, " segment"],
    ) -> Int[Array, " segment"]:
        """The sources, with the nearest mover for new segments that have none."""
        lost = jnp.where(newborn & (source <= 0), area, 0.0)
        size, at = jax.lax.top_k(jax.lax.stop_gradient(lost), min(self.num_newborn, lost.shape[0]))
        apart = squared_distance(centre_m[at], centre_m[active])
        mover = there & ~newborn[active] & (speed_m_s[active] > self.mover_m_s)
        apart = jnp.where(mover[None], apart, jnp.inf)
        found = (size > 0) & (jnp.min(apart, axis=1) < self.adopt_m**2)
        nearest = active[jnp.argmin(apart, axis=1)].astype(source.dtype)
        return source.at[at].set(jnp.where(found, nearest, source[at]))


def _inherit(state: TravelState, source: Int[Array, " segment"]) -> TravelState:
    """The state with new segments' rows from their sources, 0 for those without."""
    at, has, none = jnp.maximum(source, 0), source > 0, (source > -2) & (source <= 0)
    displacement = jnp.where(has[:, None], state.displacement_m[at], state.displacement_m)
    life = jnp.where(has, state.life_s[at], state.life_s)
    return TravelState(
        state.past.inherited(source), jnp.where(none[:, None], 0.0, displacement), jnp.where(none, 0.0, life)
    )
