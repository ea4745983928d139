"""The body that a tag was last seen on: remembered while it is hidden, and found again where it comes out.

The evidence of a tag's body is that of its segments, and they end where something passes in front of it. What is left in view
(the arm that holds the object, say) then explains the reads best, though far worse than the body did. So the last body is
remembered while its evidence, which decays like all evidence, exceeds that of the best body in view by a margin. New
segments near its place begin with its evidence. Bodies lose evidence for other reasons too, when their best segments end.
So the tag counts as hidden only where the camera does not see its place: the place is out of the picture, or something
else is in front of it.
"""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.constrained import Positive
from ...core.numerics import squared_distance
from ...tracing.tracer import Camera

_NOTHING = -1e4  # evidence of no body, nats
_IN_FRONT_M = 0.05  # a surface so much nearer than a place hides it
_NEAREST_M = 0.1  # places nearer to the camera, or behind it, are out of the picture


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
        return HiddenState(jnp.full(num_tags, _NOTHING, float), zero, zero, jnp.zeros(num_tags))


class HiddenBody(eqx.Module):
    """Stage that remembers each tag's last body. `HiddenBody()` has good values."""

    margin_nats: Positive  # a last body is remembered where it explains the reads better than the best in view by this
    reach_m: Positive  # new segments so far from its place begin with evidence lower by half the margin
    drift_m_s: Positive  # the reach grows by this while it is remembered
    stop_s: Positive  # a remembered body goes on at its last velocity, which decays with this time

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

    def predicted(
        self, state: HiddenState, dt_s: Float[Array, ""]
    ) -> tuple[Float[Array, "tag 3"], Float[Array, "tag 3"]]:
        """Place and velocity of each tag's last body at this frame, if it is hidden."""
        velocity_m_s = state.velocity_m_s * jnp.exp(-dt_s / self.stop_s.value)
        return state.centre_m + velocity_m_s * dt_s, velocity_m_s

    def out_of_view(
        self,
        camera: Camera,
        state: HiddenState,
        depth_m: Float[Array, "height width"],
        labels: Int[Array, "height width"],
        membership: Float[Array, "tag segment"],
        dt_s: Float[Array, ""],
    ) -> Bool[Array, " tag"]:
        """Whether the camera does not see the place of each tag's last body, by this frame's depth and labels.

        What probably belongs to the body in view (`membership`) does not hide it.
        """
        place_m, _ = self.predicted(state, dt_s)
        height, width = depth_m.shape
        x, y = camera.pixels_of(place_m)
        inside = (place_m[:, 2] > _NEAREST_M) & (x > -0.5) & (x < width - 0.5) & (y > -0.5) & (y < height - 0.5)
        column = jnp.clip(jnp.round(x), 0, width - 1).astype(jnp.int32)
        row = jnp.clip(jnp.round(y), 0, height - 1).astype(jnp.int32)
        seen_m, slot = depth_m[row, column], labels[row, column]
        own = jnp.take_along_axis(membership, jnp.maximum(slot, 0)[:, None], axis=1)[:, 0] > 0.5
        in_front = (seen_m > 0) & (seen_m < place_m[:, 2] - _IN_FRONT_M) & ~(own & (slot >= 0))
        return in_front | ~inside

    def step(
        self,
        state: HiddenState,
        body_nats: Float[Array, " tag"],
        in_view: Bool[Array, " tag"],
        centre_m: Float[Array, "tag 3"],
        velocity_m_s: Float[Array, "tag 3"],
        kept: Float[Array, ""],
        dt_s: Float[Array, ""],
        rival_nats: Float[Array, " tag"] | None = None,
    ) -> tuple[HiddenState, Bool[Array, " tag"]]:
        """The state after a frame, and which last bodies are remembered: those with more evidence than the best in view.

        `body_nats`, `centre_m` and `velocity_m_s` are those of the best body in view, if any is; `kept` is what evidence keeps of its
        value from the last frame to this one. `rival_nats` is the best evidence for a body of any tag that is in view: a last body
        that explains the reads as well may be that one, which this tag has left to another.
        """
        body_nats = jnp.where(in_view, body_nats, _NOTHING)
        remembered = jnp.where(state.evidence_nats > 0.5 * _NOTHING, kept * state.evidence_nats, _NOTHING)
        in_view_nats = body_nats if rival_nats is None else jnp.maximum(body_nats, rival_nats)
        kept_on = remembered > in_view_nats + self.margin_nats.value
        place_m, slowed_m_s = self.predicted(state, dt_s)
        after = HiddenState(
            evidence_nats=jnp.where(kept_on, remembered, body_nats),
            centre_m=jnp.where(kept_on[:, None], place_m, centre_m),
            velocity_m_s=jnp.where(kept_on[:, None], slowed_m_s, velocity_m_s),
            age_s=jnp.where(kept_on, state.age_s + dt_s, 0.0),
        )
        return after, kept_on
