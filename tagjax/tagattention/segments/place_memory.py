"""Where a tag was last found: what appears there lately takes over the evidence, so that a body that was hidden is found again.

Of each tag the place, velocity, extent and evidence of its body are remembered. Where the body found now has clearly less
evidence, it is another one, and the remembered place moves on by itself. A segment at distance d from the place, younger
than `young_s`, has at least the remembered evidence less `loss_nats` d^2 / s^2, with s the extent of the body and what it
may have drifted. So a small object lends evidence to its own new parts alone, a person to all of the person.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.constrained import Fraction, Positive
from ...core.numerics import safe_divide, safe_sqrt

_LEAST_PIXELS = 20.0
_LEAST_EXTENT_M = 0.02


class PlaceState(eqx.Module):
    """The remembered body of each tag."""

    place_m: Float[Array, "tag 3"]
    velocity_m_s: Float[Array, "tag 3"]
    extent_m: Float[Array, " tag"]
    evidence: Float[Array, " tag"]  # nats; 0 = nothing is remembered
    hidden_s: Float[Array, " tag"]  # time since it was seen


class PlaceMemory(eqx.Module):
    """Stage that finds bodies again. `PlaceMemory()` has good values."""

    reach: Positive  # s, in extents of the body
    drift: Positive  # s grows by so many extents a second
    loss_nats: Positive
    young_s: Positive
    memory_s: Positive  # of the evidence, as that of `DwellEvidence`
    coast_s: Positive  # time constant with which a hidden body's velocity decays
    same: Fraction  # a body with less than this fraction of the remembered evidence is another one

    def __init__(
        self,
        *,
        reach: float = 1.0,
        drift: float = 1.5,
        loss_nats: float = 16.0,
        young_s: float = 0.6,
        memory_s: float = 4.0,
        coast_s: float = 1.0,
        same: float = 0.9,
    ) -> None:
        """Raises `ValueError` for a value that is not positive, or a fraction of 0 or 1."""
        self.reach = Positive(reach)
        self.drift = Positive(drift)
        self.loss_nats = Positive(loss_nats)
        self.young_s = Positive(young_s)
        self.memory_s = Positive(memory_s)
        self.coast_s = Positive(coast_s)
        self.same = Fraction(same)

    def init(self, num_tags: int) -> PlaceState:
        """Nothing is remembered."""
        zero = jnp.zeros(num_tags)
        return PlaceState(jnp.zeros((num_tags, 3)), jnp.zeros((num_tags, 3)), zero, zero, zero)

    def lend(
        self,
        state: PlaceState,
        log_likelihood: Float[Array, "tag segment"],
        centre_m: Float[Array, "segment 3"],
        area: Float[Array, " segment"],
        life_s: Float[Array, " segment"],
        dt_s: Float[Array, ""],
    ) -> tuple[PlaceState, Float[Array, "tag segment"]]:
        """The remembered places `dt_s` later, and the log likelihoods (nats) with what young segments take over there."""
        coast = jnp.exp(-dt_s / self.coast_s.value)
        state = PlaceState(
            place_m=state.place_m + state.velocity_m_s * dt_s,
            velocity_m_s=state.velocity_m_s * coast,
            extent_m=state.extent_m,
            evidence=state.evidence * jnp.exp(-dt_s / self.memory_s.value),
            hidden_s=state.hidden_s + dt_s,
        )
        scale = _LEAST_EXTENT_M + state.extent_m * (self.reach.value + self.drift.value * state.hidden_s)
        apart = jnp.sum(jnp.square(centre_m[None] - state.place_m[:, None]), axis=-1) / jnp.square(scale)[:, None]
        lent = log_likelihood[:, :1] + state.evidence[:, None] - self.loss_nats.value * apart
        young = (area > 0) & (jnp.arange(area.shape[0]) > 0) & (life_s <= self.young_s.value)
        takes = young[None] & (state.evidence > 0)[:, None]
        return state, jnp.where(takes, jnp.maximum(log_likelihood, lent), log_likelihood)

    def update(
        self,
        state: PlaceState,
        log_odds: Float[Array, "tag segment"],
        evidence: Float[Array, "tag segment"],
        centre_m: Float[Array, "segment 3"],
        velocity_m_s: Float[Array, "segment 3"],
        area: Float[Array, " segment"],
    ) -> PlaceState:
        """The memory after a frame whose bodies have these log odds (`Bodies.log_odds`)."""
        weight = jax.nn.sigmoid(log_odds) * jnp.where(jnp.arange(area.shape[0]) > 0, area, 0.0)[None]
        total = jnp.sum(weight, axis=1)
        share = safe_divide(weight, jnp.broadcast_to(total[:, None], weight.shape))
        place_m = share @ centre_m
        spread = jnp.sum(share * jnp.sum(jnp.square(centre_m[None] - place_m[:, None]), axis=-1), axis=1)
        found = jnp.sum(share * evidence, axis=1)
        seen = (found > self.same.value * state.evidence) & (total > _LEAST_PIXELS)
        return PlaceState(
            place_m=jnp.where(seen[:, None], place_m, state.place_m),
            velocity_m_s=jnp.where(seen[:, None], share @ velocity_m_s, state.velocity_m_s),
            extent_m=jnp.where(seen, safe_sqrt(spread), state.extent_m),
            evidence=jnp.where(seen, found, state.evidence),
            hidden_s=jnp.where(seen, 0.0, state.hidden_s),
        )
