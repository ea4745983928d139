"""The body that carries a tag: the radio finds its place, and the rigid motion of segments its extent.

Two questions are kept apart. Which body carries the tag is a question to the reads: the place of the tag is distributed
over segments as exp(evidence / temperature). What belongs to that body is a question to the camera: segments whose motion
in space is that of the place (`RigidMotion`), and whose neighbours belong to it. The two alternate for a few rounds, as in
expectation maximisation. Then what is not connected with the place is left out.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ...core.constrained import Positive
from ...core.numerics import safe_divide, safe_norm, squared_distance
from ...core.parameters import check_positive
from .connection import reached, touching
from .past_motion import PastMotion
from .rigid import RigidMotion
from .step import SegmentFrame

_TINY = 1e-9
_APART = -30.0  # log odds of what is not looked at
_SEEN_S = 0.5  # after the first frame; before, hardly anything has been seen at rest


class BodyState(eqx.Module):
    """What is carried from frame to frame."""

    past: PastMotion
    membership: Float[Array, "tag segment"]  # log odds that the segment belongs to the tag's body, remembered
    fastest_m_s: Float[Array, " segment"]  # highest speed of late, remembered
    age_s: Float[Array, ""]  # time since the first frame


class LaterBody(eqx.Module):
    """Offline smoothing: what the backward pass remembers of later frames, as in `BodyState`."""

    membership: Float[Array, "tag segment"]
    fastest_m_s: Float[Array, " segment"]


class Bodies(eqx.Module):
    """Each tag's body at one frame."""

    log_odds: Float[Array, "tag segment"]  # that the segment belongs to the body; very negative for segments at rest
    place: Float[Array, "tag segment"]  # probability of the tag's place among moving segments; sums to 1, or 0 if none
    speed_m_s: Float[Array, " segment"]


class CarryingBody(eqx.Module):
    """Stage that finds each tag's body among the segments that move. `CarryingBody()` has good values."""

    rigid: RigidMotion
    temperature_nats: Positive  # of the tag's place: errors of the increments are common to many reads
    fit_nats: Positive  # of a segment's weight in the rigid fit, by its evidence below the place's
    evidence_nats: Positive  # less evidence than the place's counts against membership by its difference over this,
    most_against: Positive  # but at most so much, nats: parts of a body that turns have less evidence than the place
    prior: Float[Array, ""]  # log odds of membership before any evidence
    neighbour_m: Positive  # segments within this distance are neighbours
    neighbours: Positive  # log odds of a segment whose neighbours are all members (minus it: all others)
    extent: Positive  # a segment so many standard deviations of the body from its middle has log odds lower by 0.5
    moving_m_s: Positive  # a segment that has been slower than this of late is no place for a tag that moves
    memory_s: Positive  # of membership and speed
    num_active: int = eqx.field(static=True)  # segments that are looked at: the fastest, and remembered members
    num_rounds: int = eqx.field(static=True)
    speed_s: float = eqx.field(static=True)  # time over which speeds are measured
    # A segment that is younger, or displaced by more over the longest of `rigid.lags_s`, is a place only in front of what
    # has been seen at rest.
    young_s: float = eqx.field(static=True)
    slid_m: float = eqx.field(static=True)

    def __init__(
        self,
        rigid: RigidMotion | None = None,
        *,
        temperature_nats: float = 8.0,
        fit_nats: float = 15.0,
        evidence_nats: float = 30.0,
        most_against: float = 4.0,
        prior: float = -1.0,
        neighbour_m: float = 0.08,
        neighbours: float = 2.0,
        extent: float = 2.0,
        moving_m_s: float = 0.06,
        memory_s: float = 1.0,
        num_active: int = 384,
        num_rounds: int = 3,
        speed_s: float = 0.25,
        young_s: float = 1.5,
        slid_m: float = 0.15,
    ) -> None:
        """Raises `ValueError` for a value that is not positive."""
        self.rigid = RigidMotion() if rigid is None else rigid
        self.temperature_nats = Positive(temperature_nats)
        self.fit_nats = Positive(fit_nats)
        self.evidence_nats = Positive(evidence_nats)
        self.most_against = Positive(most_against)
        self.prior = jnp.asarray(prior, jnp.float32)
        self.neighbour_m = Positive(neighbour_m)
        self.neighbours = Positive(neighbours)
        self.extent = Positive(extent)
        self.moving_m_s = Positive(moving_m_s)
        self.memory_s = Positive(memory_s)
        for name, value in (("num_active", num_active), ("num_rounds", num_rounds)):
            if value < 1:
                raise ValueError(f"{name} is {value}; expected at least 1.")
        check_positive(speed_s=speed_s, young_s=young_s, slid_m=slid_m)
        self.num_active, self.num_rounds = num_active, num_rounds
        self.speed_s, self.young_s, self.slid_m = float(speed_s), float(young_s), float(slid_m)

    def init(self, num_tags: int, num_segments: int) -> BodyState:
        """The state before the first frame."""
        span_s = max(self.speed_s, *self.rigid.lags_s)
        past = PastMotion.nothing(num_segments, span_s=span_s)
        return BodyState(past, jnp.zeros((num_tags, num_segments)), jnp.zeros(num_segments), jnp.zeros(()))

    def step(
        self,
        state: BodyState,
        evidence: Float[Array, "tag segment"],
        found: SegmentFrame,
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
        later: LaterBody | None = None,
    ) -> tuple[BodyState, Bodies]:
        """The state after the frame at `now_s`, and each tag's body.

        `evidence` is that of the reads for a tag at a segment against one at rest, nats. Displacement and life of a new
        segment go on from those of the slot it comes from, as `TravellingTogether` has them. What is remembered of `later` frames counts
        as what is remembered of earlier ones does, and is not carried on.
        """
        centre_m, area, life_s, displacement_m = found.centre_m, found.area, found.life_s, found.displacement_m
        num_segments, newborn_source = area.shape[0], found.source
        newborn = newborn_source > -2
        inherited = jnp.where((newborn_source > 0)[None], state.membership[:, jnp.maximum(newborn_source, 0)], 0.0)
        membership = jnp.where(newborn[None], inherited, state.membership)
        past = state.past.inherited(newborn_source).add(displacement_m, now_s)
        moved_m, time_s = past.since(self.speed_s, displacement_m, life_s, now_s)
        # A segment's first frames show more noise than motion: half the time counts at least.
        speed_m_s = safe_norm(moved_m) / jnp.maximum(time_s, 0.5 * self.speed_s)
        # What paused a moment ago may still carry the tag.
        keep = jnp.exp(-(now_s - since_s) / self.memory_s.value)
        source = jnp.where(newborn, newborn_source, jnp.arange(num_segments, dtype=newborn_source.dtype))
        before_m_s = jnp.where(source > 0, state.fastest_m_s[jnp.maximum(source, 0)], 0.0)
        age_s = state.age_s + (now_s - since_s)
        lags_s = jnp.array(self.rigid.lags_s, centre_m.dtype)
        lagged_m, elapsed_s = jax.vmap(lambda lag_s: past.since(lag_s, displacement_m, life_s, now_s))(lags_s)
        uncovered = life_s < jnp.minimum(self.young_s, age_s - _SEEN_S)
        slid = (age_s > _SEEN_S) & (safe_norm(lagged_m[-1]) > self.slid_m)
        behind = (found.front < 0.5) & (uncovered | slid)
        own_m_s = fastest_m_s = jnp.where(behind, 0.0, jnp.maximum(speed_m_s, keep * before_m_s))
        memories = [membership]
        if later is not None:
            fastest_m_s = jnp.where(behind, 0.0, jnp.maximum(own_m_s, later.fastest_m_s))
            memories.append(later.membership)
        exists = found.in_view
        rank = jnp.where(exists, fastest_m_s + 0.1 * jnp.max(sum(memories), axis=0, initial=0.0), -jnp.inf)
        _, active = jax.lax.top_k(jax.lax.stop_gradient(rank), min(self.num_active, num_segments))
        there = exists[active]
        centre, size = centre_m[active], jnp.where(there, area[active], 0.0)

        close = squared_distance(centre, centre) < jnp.square(self.neighbour_m.value)
        touch = touching(centre, found.size_m[active])
        near = jnp.where(close, size[None], 0.0)
        near = safe_divide(near, jnp.broadcast_to(jnp.sum(near, axis=1, keepdims=True), near.shape))

        before_m = centre[None] - lagged_m[:, active]
        known = (elapsed_s[:, active] >= 0.8 * lags_s[:, None]) & there[None]
        width = 0.3 * self.moving_m_s.value
        moving = jax.nn.log_sigmoid((fastest_m_s[active] - self.moving_m_s.value) / width)

        def of_tag(own: Float[Array, " active"], *memories: Float[Array, " active"]) -> tuple[Array, Array, Array]:
            smooth = near @ own
            level = jnp.where(there, smooth / self.temperature_nats.value + 4.0 * moving, -jnp.inf)
            top = jnp.max(level, initial=-1e30)
            place = size * jnp.exp(level - top)
            place = place / (jnp.sum(place) + _TINY)
            peak = jnp.argmax(close.astype(place.dtype) @ place)  # the largest sum, not mean: a lone sliver is no body
            reach_m = 2.0 * self.neighbour_m.value
            start = place * jnp.exp(_distance_log(centre, centre[peak], jnp.square(reach_m)))
            start = start / (jnp.sum(start) + _TINY)
            below = smooth - start @ smooth
            against = jnp.clip(below / self.evidence_nats.value, -self.most_against.value, 0.0)
            trusted = jnp.exp(jnp.clip(below / self.fit_nats.value, -20.0, 0.0))
            # A memory that the place of the tag disagrees with is of another body.
            memory, *later = (jnp.where(jnp.sum(start * one) > 0, one, 0.0) for one in memories)
            remembered = sum(later, memory)

            def alternate(
                last: tuple[Float[Array, " active"], ...], _: None
            ) -> tuple[tuple[Float[Array, " active"], ...], None]:
                weight = last[0]
                ratio = self.rigid.log_ratio(weight * trusted, before_m, known, centre)
                middle, spread_m2 = _spread(weight, centre)
                apart = _distance_log(
                    centre, middle, self.extent.value**2 * spread_m2 + jnp.square(self.neighbour_m.value)
                )
                alone = ratio + self.prior + against + remembered + apart
                log_odds = alone + self.neighbours.value * (2.0 * (near @ jax.nn.sigmoid(alone)) - 1.0)
                weight = size * jax.nn.sigmoid(log_odds)
                # The place itself always counts.
                return (weight + 0.2 * jnp.sum(weight) * start, log_odds, ratio), None

            # A loop, not the rounds one after another: it is compiled once.
            begin = start, jnp.zeros_like(own), jnp.zeros_like(own)
            (_, log_odds, ratio), _ = jax.lax.scan(alternate, begin, None, length=self.num_rounds)
            # A body is one connected thing. Whatever else moves as it does belongs to something else.
            member = log_odds > 0
            log_odds = jnp.where(member & ~reached(touch, member, peak), -log_odds, log_odds)  # continuous at 0
            after = keep * memory + (1.0 - keep) * jnp.clip(ratio + against, -4.0, 4.0)
            return log_odds, place, jnp.clip(after, -4.0, 4.0)

        log_odds, place, remembered = jax.vmap(of_tag)(*(rows[:, active] for rows in (evidence, *memories)))
        shape = membership.shape
        # Segments that are not looked at forget as well.
        membership = (keep * membership).at[:, active].set(jnp.where(there[None], remembered, 0.0))
        return BodyState(past, membership, own_m_s, age_s), Bodies(
            log_odds=jnp.full(shape, _APART).at[:, active].set(jnp.where(there[None], log_odds, _APART)),
            place=jnp.zeros(shape).at[:, active].set(jnp.where(there[None], place, 0.0)),
            speed_m_s=speed_m_s,
        )


def _spread(
    weight: Float[Array, " segment"], centre_m: Float[Array, "segment 3"]
) -> tuple[Float[Array, " 3"], Float[Array, ""]]:
    """Weighted mean and variance (of all three coordinates together, m^2) of segments; 0 without weight."""
    share = safe_divide(weight, jnp.broadcast_to(jnp.sum(weight), weight.shape))
    middle_m = share @ centre_m
    return middle_m, share @ jnp.sum(jnp.square(centre_m.T - middle_m[:, None]), axis=0)


def _distance_log(
    centre_m: Float[Array, "segment 3"], from_m: Float[Array, " 3"], variance_m2: Float[Array, ""]
) -> Float[Array, " segment"]:
    """Exponent of a normal distribution about a point."""
    return -0.5 * jnp.sum(jnp.square(centre_m.T - from_m[:, None]), axis=0) / variance_m2
