"""Evidence without depth: how well each segment's ray explains the phases at several antennas, its depth integrated out.

In place of a segment's increments of range the stage has its ray and the change of its ray. The depth is one more thing that
is integrated out for each segment and tag: the stage begins with some depths, spread evenly in their logarithm, follows each
by a Kalman filter (`depth_filter`), and adds up each one's likelihood. Slot 0, the static background, has no motion in depth.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...core.constrained import Positive
from ...core.numerics import safe_norm, squared_distance
from ...core.parameters import check_positive
from ...radio.arrivals import Arrivals
from ...radio.phase import distance_to_phase
from ...radio.reader_model import ReaderModel
from .cells import row_sources
from .depth_filter import (
    DepthBelief,
    moved,
    ranges_at,
    settled,
    with_phase_set,
    with_phase_variance,
    with_rate,
    with_read,
)
from .dwell import in_chunks, over_chunks, past_unknown
from .labels import STATIC
from .step import SegmentFrame
from .travel import Pooling

_SHORTEST_FRAME_S = 1e-6
_NEAREST_M = 0.05  # a segment that is nearer is out of view
_CARRIER_HZ = 915e6  # before the first read; no phase has been measured then


class UnknownDepthState(eqx.Module):
    """What is known of each tag at each segment, for each depth that the stage began with."""

    belief: DepthBelief  # (tag, state, hypothesis, segment)
    log_hypothesis: Float[Array, "tag hypothesis segment"]  # decayed sum over reads, nats
    log_likelihood: Float[Array, "tag segment"]  # the same of all depths together
    fastest: Float[Array, " segment"]  # speed of the ray of late, 1/s
    seen: Bool[Array, "tag antenna"]  # the antenna has read the tag
    channel: Int[Array, " tag"]  # of the last read; -1 before the first
    carrier_hz: Float[Array, " tag"]

    def with_evidence(self, log_likelihood: Float[Array, "tag segment"]) -> UnknownDepthState:
        """The state with this evidence; what it differs by is added for every depth."""
        more = (log_likelihood - self.log_likelihood)[:, None]
        return eqx.tree_at(
            lambda s: (s.log_hypothesis, s.log_likelihood), self, (self.log_hypothesis + more, log_likelihood)
        )

    def of_tags(self) -> list[Any]:
        """The arrays with one row a tag."""
        tables = self.belief.mean, self.belief.covariance, self.log_hypothesis, self.log_likelihood
        return [*tables, self.seen, self.channel, self.carrier_hz]


class RayMotion(eqx.Module):
    """The rays of a frame's segments, and what is known of their motion since the last frame."""

    ray: Float[Array, "segment 2"]  # x / z, y / z at this frame
    turn: Float[Array, "segment 2"]  # its change
    rate: Float[Array, " segment"]  # measured rate of the log depth, 1/s: by the change of scale
    rate_variance: Float[Array, " segment"]  # infinite where nothing is measured

    @staticmethod
    def of(centre_m: Float[Array, "segment 3"], motion_m: Float[Array, "segment 3"]) -> RayMotion:
        """From places and motions with a depth, which may be nominal. Nothing is measured of the rate.

        A segment out of view has depth 0, and its ray means nothing, but has to be finite.
        """
        before = centre_m - motion_m
        ray, last = (one[:, :2] / jnp.where(one[:, 2:] > _NEAREST_M, one[:, 2:], 1.0) for one in (centre_m, before))
        return RayMotion(ray, ray - last, jnp.zeros(len(ray)), jnp.full(len(ray), jnp.inf))


class UnknownDepth(eqx.Module):
    """Stage that is used in place of dwells where nothing measures depth. `UnknownDepth()` has good values.

    The frames' depth is nominal (`flow.nominal_depth`), and so are places and steps of a `Trace`. Calibrated antennas are needed,
    at least two of them for rays to be told apart without the change of scale. Measured on simulated recordings only.
    """

    settle_s: Positive  # a motion in depth is forgotten within this time
    rate_per_speed: (
        Positive  # standard deviation of the log depth's rate, per speed of the ray: 1 = all directions alike
    )
    still_rate: Positive  # the same of a ray at rest, 1/s
    drift_m: Positive  # variance of a change of range, m^2, for each metre: reflections, and errors of the ray's motion
    hop_rad: Positive  # what a hop changes in the phase of one antenna against the others: reflections
    scale_error: Positive | None  # error of the scale's change, of that of independent segments; None: it is not used
    scale_reach: Positive  # segments within this distance of rays (1 = the focal length) are one thing
    scale_floor: Positive  # standard deviation of the log depth's rate by the scale, where segments agree, 1/s
    min_m: float = eqx.field(static=True)
    max_m: float = eqx.field(static=True)
    num_depths: int = eqx.field(static=True)
    fast_s: float = eqx.field(static=True)  # the ray's speed is the fastest of about this time

    def __init__(
        self,
        *,
        settle_s: float = 0.3,
        rate_per_speed: float = 1.0,
        still_rate: float = 0.05,
        drift_m: float = 2e-4,
        hop_rad: float = 0.3,
        scale_error: float | None = 2.0,
        scale_reach: float = 0.15,
        scale_floor: float = 0.05,
        min_m: float = 1.0,
        max_m: float = 7.0,
        num_depths: int = 6,
        fast_s: float = 0.7,
    ) -> None:
        """Raises `ValueError` for a value that is not positive, or depths that do not grow."""
        self.settle_s, self.rate_per_speed = Positive(settle_s), Positive(rate_per_speed)
        self.still_rate, self.drift_m, self.hop_rad = Positive(still_rate), Positive(drift_m), Positive(hop_rad)
        self.scale_error = None if scale_error is None else Positive(scale_error)
        self.scale_reach, self.scale_floor = Positive(scale_reach), Positive(scale_floor)
        check_positive(min_m=min_m, max_m=max_m, fast_s=fast_s)
        if num_depths < 1 or not min_m < max_m:
            raise ValueError(
                f"num_depths is {num_depths}, min_m {min_m}, max_m {max_m}; expected at least 1 depth, and min_m below max_m."
            )
        self.min_m, self.max_m, self.num_depths, self.fast_s = float(min_m), float(max_m), num_depths, float(fast_s)

    def _depths(self) -> tuple[Float[Array, " hypothesis"], Float[Array, ""]]:
        """The log depths that the stage begins with, and their standard deviation: half of what lies between two."""
        low, high = np.log(self.min_m), np.log(self.max_m)
        step = (high - low) / self.num_depths
        depths = low + step * (np.arange(self.num_depths) + 0.5)
        return jnp.asarray(depths, jnp.float32), jnp.asarray(0.5 * step, jnp.float32)

    def init(self, num_tags: int, num_antennas: int, num_segments: int) -> UnknownDepthState:
        """Before the first read."""
        log_depth, std = self._depths()
        size, shape = 2 + num_antennas, (self.num_depths, num_segments)
        mean = jnp.zeros((num_tags, size, *shape)).at[:, 0].set(log_depth[:, None])
        own = jnp.where(jnp.arange(num_segments) == STATIC, 0.0, jnp.square(std))
        covariance = jnp.zeros((num_tags, size, size, *shape)).at[:, 0, 0].set(own)
        return UnknownDepthState(
            belief=DepthBelief(mean, covariance),
            log_hypothesis=jnp.zeros((num_tags, *shape)),
            log_likelihood=jnp.zeros((num_tags, num_segments)),
            fastest=jnp.zeros(num_segments),
            seen=jnp.zeros((num_tags, num_antennas), bool),
            channel=jnp.full(num_tags, -1, jnp.int32),
            carrier_hz=jnp.full(num_tags, _CARRIER_HZ),
        )

    def step(
        self,
        reader: ReaderModel,
        memory_s: Float[Array, ""],
        state: UnknownDepthState,
        arrivals: Arrivals,
        antennas_m: Float[Array, "antenna 3"],
        motion: RayMotion,
        newborn_source: Int[Array, " segment"],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> tuple[UnknownDepthState, Float[Array, "tag segment"]]:
        """The state after the frame at `now_s`, and the evidence against phases at random, nats.

        The motion is since the frame at `since_s`; `arrivals` and `newborn_source` as in `DwellEvidence.step`.
        """
        moving = jnp.arange(motion.ray.shape[0]) != STATIC
        turn = jnp.where(moving[:, None], motion.turn, 0.0)
        before, frame_s = motion.ray - turn, jnp.maximum(now_s - since_s, _SHORTEST_FRAME_S)
        state = self._started(state, newborn_source)
        fastest = jnp.maximum(safe_norm(turn) / frame_s, jnp.exp(-frame_s / self.fast_s) * state.fastest)
        fastest = jnp.where(moving, fastest, 0.0)
        rate_std = jnp.where(moving, self.rate_per_speed.value * fastest + self.still_rate.value, 0.0)
        rate_variance = jnp.where(moving, motion.rate_variance, jnp.inf)
        belief = jax.vmap(lambda one: with_rate(one, motion.rate[None], rate_variance[None]))(state.belief)
        log_hypothesis = jnp.exp(-(now_s - since_s) / memory_s) * state.log_hypothesis

        def gone_on(
            belief: DepthBelief, carrier_hz: Float[Array, ""], from_s: Float[Array, ""], to_s: Float[Array, ""]
        ) -> DepthBelief:
            """One tag's belief of the time `to_s`, within the frame."""
            elapsed_s = jnp.maximum(to_s - from_s, 0.0)
            wave = reader.multiple * distance_to_phase(jnp.ones_like(carrier_hz), carrier_hz)
            places = [before + jnp.clip((at - since_s) / frame_s, 0.0, 1.0) * turn for at in (from_s, to_s)]
            log_depth, rate = belief.mean[0], belief.mean[1]
            last = ranges_at(log_depth, places[0], antennas_m, wave)
            now = ranges_at(log_depth + elapsed_s * rate, places[1], antennas_m, wave)
            now = eqx.tree_at(lambda one: one.slope, now, jnp.where(moving[None, None], now.slope, 0.0))
            last = eqx.tree_at(lambda one: one.slope, last, jnp.where(moving[None, None], last.slope, 0.0))
            error = wave * self.drift_m.value * jnp.abs(now.phase - last.phase)
            return settled(moved(belief, last, now, elapsed_s, error), elapsed_s, rate_std[None], self.settle_s.value)

        def updated(carry, one: Arrivals):
            belief, seen, channel, carrier_hz, time_s, evidence = carry
            at = one.tag
            own = gone_on(jax.tree.map(lambda table: table[at], belief), carrier_hz[at], time_s[at], one.time_s)
            antenna = (jnp.arange(antennas_m.shape[0]) == one.antenna).astype(own.mean.dtype)
            hops, unseen = one.channel != channel[at], ~seen[at, one.antenna]
            own = self._hopped(reader, own, hops, carrier_hz[at], one.carrier_hz, motion.ray, antennas_m)
            variance = 1.0 / reader.concentration(one.rssi_dbm, fastest[None] * jnp.exp(own.mean[0]))
            phase_rad = reader.multiple * one.phase_rad
            shifted = jnp.where(unseen, antenna, jnp.ones_like(antenna))
            begun = with_phase_set(own, antenna, phase_rad, variance, shifted)
            read, nats = with_read(own, antenna, phase_rad, variance, reader.outlier.value)
            new = hops | unseen
            own = jax.tree.map(lambda a, b: jnp.where(new, a, b), begun, read)
            fresh = jnp.exp(-jnp.maximum(now_s - one.time_s, 0.0) / memory_s)
            # An antenna that is first read after a hop says nothing of the phases at the others.
            kept = seen[at] & ~(hops & unseen)
            return (
                jax.tree.map(lambda table, row: table.at[at].set(row), belief, own),
                seen.at[at].set(kept | (antenna > 0)),
                channel.at[at].set(one.channel),
                carrier_hz.at[at].set(one.carrier_hz),
                time_s.at[at].set(jnp.maximum(one.time_s, time_s[at])),
                evidence.at[at].add(jnp.where(new, 0.0, fresh * nats)),
            )

        def add(carry, reads: tuple[Arrivals]):
            return jax.lax.cond(reads[0].valid, lambda: updated(carry, *reads), lambda: carry), None

        times = jnp.broadcast_to(since_s, state.channel.shape)
        begin = belief, state.seen, state.channel, state.carrier_hz, times, log_hypothesis
        after = over_chunks(add, begin, in_chunks((arrivals,)))
        belief, seen, channel, carrier_hz, times, log_hypothesis = after
        belief = jax.vmap(gone_on, in_axes=(0, 0, 0, None))(belief, carrier_hz, times, now_s)
        log_likelihood = jax.nn.logsumexp(log_hypothesis, axis=1) - float(np.log(self.num_depths))
        after = UnknownDepthState(belief, log_hypothesis, log_likelihood, fastest, seen, channel, carrier_hz)
        return after, log_likelihood

    def with_scale(
        self,
        motion: RayMotion,
        state: UnknownDepthState,
        found: SegmentFrame,
        pooling: Pooling,
        dt_s: Float[Array, ""],
    ) -> RayMotion:
        """The motion with the rate of the log depth that the change of scale gives: what nears grows.

        Around each segment the displacements of the rays over the pooling's lag are fitted by a shift and a scale, over the
        segments that have moved alike. Measurements of frames within one lag are the same, and count as one. A motion whose
        speed was not steady over the lag says little of the present rate.
        """
        if self.scale_error is None:
            return motion
        at = pooling.active
        ray, elapsed_s = motion.ray[at], jnp.maximum(pooling.lagged_s, _SHORTEST_FRAME_S)
        turned = RayMotion.of(found.centre_m[at], pooling.lagged_m).turn
        length = safe_norm(turned)
        further = jnp.maximum(length[:, None], length[None])
        near = squared_distance(ray, ray) / jnp.square(self.scale_reach.value)
        alike = squared_distance(turned, turned) / jnp.square(0.002 + 0.3 * further)
        whole = elapsed_s > 0.8 * jnp.max(elapsed_s)
        size = jnp.where(whole & (found.area[at] > 0), found.area[at], 0.0)
        weight = jnp.exp(-0.5 * (near + alike)) * size[None]
        weight = weight / jnp.maximum(jnp.sum(weight, axis=1, keepdims=True), 1e-9)
        middle, shift = weight @ ray, weight @ turned
        around, apart = ray[None] - middle[:, None], turned[None] - shift[:, None]
        spread = jnp.maximum(jnp.sum(weight * jnp.sum(around * around, axis=-1), axis=1), 1e-9)
        scale = jnp.sum(weight * jnp.sum(around * apart, axis=-1), axis=1) / spread
        left = apart - scale[:, None, None] * around
        error = 0.5 * jnp.sum(weight * jnp.sum(left * left, axis=-1), axis=1)
        number = 1.0 / jnp.maximum(jnp.sum(weight * weight, axis=1), 1e-9)
        unsteady = state.fastest[row_sources(found.source)[at]] - length / elapsed_s
        variance = jnp.square(self.scale_error.value) * error / (spread * number * jnp.square(elapsed_s))
        variance = variance + jnp.square(self.scale_floor.value) + jnp.square(self.rate_per_speed.value * unsteady)
        variance = variance * jnp.maximum(elapsed_s / jnp.maximum(dt_s, _SHORTEST_FRAME_S), 1.0)
        rate = jnp.log1p(-jnp.clip(scale, -0.5, 0.5)) / elapsed_s
        variance = jnp.where(whole & (size > 0) & (number > 3.0), variance, jnp.inf)
        return RayMotion(
            motion.ray, motion.turn, motion.rate.at[at].set(rate), motion.rate_variance.at[at].set(variance)
        )

    def _hopped(
        self,
        reader: ReaderModel,
        belief: DepthBelief,
        hops: Bool[Array, ""],
        last_hz: Float[Array, ""],
        carrier_hz: Float[Array, ""],
        ray: Float[Array, "segment 2"],
        antennas_m: Float[Array, "antenna 3"],
    ) -> DepthBelief:
        """The belief on another carrier: differences of range have other phases there, and reflections change."""
        more_hz = jnp.where(hops, carrier_hz - last_hz, 0.0)
        wave = reader.multiple * distance_to_phase(jnp.ones_like(more_hz), more_hz)
        mean = belief.mean.at[2:].add(ranges_at(belief.mean[0], ray, antennas_m, wave).phase)
        variance = jnp.where(hops, jnp.square(reader.multiple * self.hop_rad.value), 0.0)
        each = jnp.broadcast_to(variance, (antennas_m.shape[0], 1, 1))
        return DepthBelief(mean, with_phase_variance(belief.covariance, each))

    def _started(self, state: UnknownDepthState, newborn_source: Int[Array, " segment"]) -> UnknownDepthState:
        """The state with new segments' rows: a tag that was at rest until now has a known phase, and any depth."""
        source = row_sources(newborn_source)
        of_sources = lambda table: jnp.take(table, source, axis=-1)  # noqa: E731
        fresh = past_unknown(newborn_source)
        log_depth, std = self._depths()
        mean, covariance = of_sources(state.belief.mean), of_sources(state.belief.covariance)
        begun = covariance.at[:, :2].set(0.0).at[:, :, :2].set(0.0).at[:, 0, 0].set(jnp.square(std))
        evidence = of_sources(state.log_hypothesis)
        unknown = jnp.maximum(of_sources(state.log_likelihood), 0.0)[:, None]
        rows = fresh[None, None]  # of tags and depths
        depths = jnp.where(rows, log_depth[None, :, None], mean[:, 0])
        mean = mean.at[:, 0].set(depths).at[:, 1].set(jnp.where(rows, 0.0, mean[:, 1]))
        belief = DepthBelief(mean, jnp.where(rows[None, None], begun, covariance))
        return eqx.tree_at(
            lambda s: (s.belief, s.log_hypothesis, s.fastest),
            state,
            (belief, jnp.where(rows, unknown, evidence), jnp.where(fresh, 0.0, state.fastest[source])),
        )
