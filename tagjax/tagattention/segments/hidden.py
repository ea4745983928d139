"""The body that a tag was last seen on: remembered while it is hidden, and found again where it comes out.

The evidence of a tag's body is that of its segments, and they end where something passes in front of it. What is left in view
(the arm that holds the object, say) then explains the reads best, though far worse than the body did. So the last body stays a
hypothesis: its evidence decays like all evidence, phases at random neither raise nor lower it, and the tag counts as hidden
while it exceeds that of the best body in view by a margin. New segments near its place begin with its evidence.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ...core.constrained import Positive
from ...core.numerics import squared_distance

_NOTHING = -1e4  # evidence of no body, nats


class HiddenState(eqx.Module):
    """The last body of each tag."""

    evidence_nats: Float[Array, " tag"]
    centre_m: Float[Array, "tag 3"]
    velocity_m_s: Float[Array, "tag 3"]
    age_s: Float[Array, " tag"]  # since it was in view

    @staticmethod
    def nothing(num_tags: int) -> HiddenState:
        """No body yet."""
        zero = jnp.zeros((num_tags, 3))
        return HiddenState(jnp.full(num_tags, _NOTHING, jnp.float32), zero, zero, jnp.zeros(num_tags))


class HiddenBody(eqx.Module):
    """Stage that remembers each tag's last body. `HiddenBody()` has good values."""

    margin_nats: Positive  # by which the last body must explain the reads better than the best one in view
    reach_m: Positive  # new segments so far from its place begin with evidence lower by half the margin
    drift_m_s: Positive  # the reach grows by this while it is hidden
    stop_s: Positive  # a hidden body goes on at its last velocity, which decays with this time

    def __init__(
        self, *, margin_nats: float = 10.0, reach_m: float = 0.15, drift_m_s: float = 0.2, stop_s: float = 0.3
    ) -> None:
        """Raises `ValueError` for a value that is not positive."""
        self.margin_nats, self.reach_m = Positive(margin_nats), Positive(reach_m)
        self.drift_m_s, self.stop_s = Positive(drift_m_s), Positive(stop_s)

    def inherited(
        self,
        state: HiddenState,
        log_likelihood: Float[Array, "tag segment"],
        centre_m: Float[Array, "segment 3"],
        newborn: Bool[Array, " segment"],
    ) -> Float[Array, "tag segment"]:
        """The evidence, in which new segments near a tag's last body have its evidence where that is higher."""
        apart_m2 = squared_distance(state.centre_m, centre_m)
        reach_m2 = jnp.square(self.reach_m.value + self.drift_m_s.value * state.age_s)[:, None]
        near = state.evidence_nats[:, None] - 0.5 * self.margin_nats.value * apart_m2 / reach_m2
        return jnp.where(newborn[None], jnp.maximum(log_likelihood, near), log_likelihood)

    def step(
        self,
        state: HiddenState,
        body_nats: Float[Array, " tag"],
        centre_m: Float[Array, "tag 3"],
        velocity_m_s: Float[Array, "tag 3"],
        kept: Float[Array, ""],
        dt_s: Float[Array, ""],
    ) -> tuple[HiddenState, Bool[Array, " tag"]]:
        """The state after a frame, and which tags are hidden.

        `body_nats`, `centre_m` and `velocity_m_s` are those of the best body in view; `kept` is what evidence keeps of its
        value from the last frame to this one.
        """
        remembered = jnp.where(state.evidence_nats > 0.5 * _NOTHING, kept * state.evidence_nats, _NOTHING)
        hidden = remembered > body_nats + self.margin_nats.value
        gone = hidden[:, None]
        slowed = state.velocity_m_s * jnp.exp(-dt_s / self.stop_s.value)
        after = HiddenState(
            evidence_nats=jnp.where(hidden, remembered, body_nats),
            centre_m=jnp.where(gone, state.centre_m + slowed * dt_s, centre_m),
            velocity_m_s=jnp.where(gone, slowed, velocity_m_s),
            age_s=jnp.where(hidden, state.age_s + dt_s, 0.0),
        )
        return after, hidden
