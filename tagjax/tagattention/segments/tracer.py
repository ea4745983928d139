"""TagAttention on segments: the composition of its stages.

A frame passes through them in this order:

1. `segments`: depth and flow -> persistent segments and each one's motion (shared by all tags);
2. `dwell`, with the `reader`'s noise model: this frame's reads -> evidence for each tag at each segment;
3. `body`: evidence and motion in space -> which segments belong to the body that carries the tag;
4. `hidden`: the last body -> its evidence where it comes out again, and whether the tag is out of view;
5. `detection`: evidence for that body, and how recent it is -> the probability that the tag is on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.constrained import named_values, with_named_values
from ...core.numerics import safe_divide
from ...radio.reader_model import ReaderModel
from ...tracing.tracer import AbstractTracer, Camera, Frame, Trace
from .attention import AttentionEvidence, AttentionState
from .body import BodyState, CarryingBody
from .detection import Detection
from .dwell import DwellEvidence, DwellState
from .hidden import HiddenBody, HiddenState
from .labels import STATIC
from .outline import (
    dense_masks,
    filled_labels,
    joined_boxes,
    joined_centroids,
    segment_boxes,
    segment_centroids,
)
from .step import SegmentTracker, SegmentTrackerState


class TagAttentionState(eqx.Module):
    """What is carried from frame to frame."""

    time_s: Float[Array, ""]  # of the last frame; NaN before the first
    segments: SegmentTrackerState
    dwell: DwellState
    attention: AttentionState | None
    body: BodyState
    hidden: HiddenState | None
    num_reads: Float[Array, " tag"]  # recent ones, as `Detection.received` counts them


class SegmentTrace(eqx.Module):
    """The output for one frame, for every tag, on segments; `TagAttention.step` makes dense masks of it."""

    labels: Int[Array, "height width"]  # slot of each pixel, -1 = none
    membership: Float[Array, "tag segment"]  # probability that a segment belongs to the tag's body
    box_px: Float[Array, "tag 4"]
    centre_px: Float[Array, "tag 2"]
    centre_m: Float[Array, "tag 3"]
    step_m: Float[Array, "tag antenna"]
    body_nats: Float[Array, " tag"]  # evidence of the reads that the tag moves with the body, against phases at random
    stationary_nats: Float[Array, " tag"]  # ... that it is stationary
    num_reads: Float[Array, " tag"]  # recent ones, as `Detection.received` counts them
    confidence: Float[Array, " tag"]
    detected: Bool[Array, " tag"]


class TagAttention(AbstractTracer):
    """Traces every tag by the segments that move as its phases say. `TagAttention()` has good values; None is a stage that is off."""

    segments: SegmentTracker = eqx.field(default_factory=SegmentTracker)
    reader: ReaderModel = eqx.field(default_factory=ReaderModel)
    dwell: DwellEvidence = eqx.field(default_factory=DwellEvidence)
    attention: AttentionEvidence | None = None
    body: CarryingBody = eqx.field(default_factory=CarryingBody)
    hidden: HiddenBody | None = eqx.field(default_factory=HiddenBody)
    detection: Detection = eqx.field(default_factory=Detection)

    def init(self, camera: Camera, frame: Frame) -> TagAttentionState:
        """The state before the first frame."""
        assert frame.present is not None
        num_tags, num_antennas = frame.present.shape[-1], camera.antennas_m.shape[0]
        num_segments = self.segments.segmenter.num_segments
        return TagAttentionState(
            time_s=jnp.asarray(jnp.nan, frame.time_s.dtype),
            segments=self.segments.init(camera),
            dwell=DwellState.nothing(num_tags, num_antennas, num_segments),
            attention=self._no_attention(frame, num_segments),
            body=self.body.init(num_tags, num_segments),
            hidden=None if self.hidden is None else HiddenState.nothing(num_tags),
            num_reads=jnp.zeros(num_tags),
        )

    def follow(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, SegmentTrace]:
        """The next state and the output on segments, without dense masks."""
        assert frame.arrivals is not None
        assert frame.present is not None
        now_s = frame.time_s
        since_s = jnp.where(jnp.isfinite(state.time_s), state.time_s, now_s)
        segments, found = self.segments.step(camera, state.segments, frame.depth_m, frame.backward_px, now_s - since_s)
        dwell, log_likelihood = self.dwell.step(
            self.reader, state.dwell, frame.arrivals, found.increment_m, found.source, since_s, now_s
        )
        hidden = state.hidden
        if self.hidden is not None and hidden is not None:
            log_likelihood = self.hidden.inherited(hidden, log_likelihood, found.centre_m, found.source > -2)
            dwell = eqx.tree_at(lambda d: d.log_likelihood, dwell, log_likelihood)
        attention = state.attention
        if self.attention is not None and attention is not None:
            attention, agreed = self.attention.step(
                attention, frame.radio, found.increment_m, found.known, found.source, since_s, now_s
            )
            log_likelihood = log_likelihood + self.attention.weight.value * agreed
        evidence = log_likelihood - log_likelihood[:, STATIC : STATIC + 1]
        body, bodies = self.body.step(
            state.body, evidence, found.centre_m, found.area, found.life_s, found.displacement_m, found.source,
            since_s, now_s,
        )  # fmt: skip
        membership = jnp.where(frame.present[:, None], jax.nn.sigmoid(bodies.log_odds), 0.0)
        weight = membership * found.area[None]
        total = jnp.sum(weight, axis=1)

        def mean(values: Float[Array, "... segment"]) -> Float[Array, "tag ..."]:
            return safe_divide(weight @ values, jnp.broadcast_to(total[:, None], (total.shape[0], values.shape[-1])))

        body_nats = safe_divide(jnp.sum(weight * log_likelihood, axis=1), total)
        body_nats = jnp.where(total > 0, body_nats, -1e4)
        hides = jnp.zeros(total.shape, bool)
        if self.hidden is not None and hidden is not None:
            dt_s = now_s - since_s
            velocity = mean(found.motion_m) / jnp.maximum(dt_s, 1e-3)
            kept = jnp.exp(-dt_s / self.dwell.memory_s.value)
            hidden, hides = self.hidden.step(hidden, body_nats, mean(found.centre_m), velocity, kept, dt_s)
        num_reads = self.detection.received(state.num_reads, frame.arrivals, since_s, now_s)
        confidence = self.detection.confidence(body_nats, log_likelihood[:, STATIC], num_reads)
        labels = filled_labels(found.labels, frame.depth_m)
        num_segments = found.area.shape[0]
        member = membership > 0.5
        box_px = joined_boxes(segment_boxes(labels, num_segments), member)
        confidence = jnp.where(frame.present & jnp.any(member, axis=1) & ~hides, confidence, 0.0)
        out = SegmentTrace(
            labels=labels,
            membership=membership,
            box_px=box_px,
            centre_px=joined_centroids(segment_centroids(labels, num_segments), member),
            centre_m=mean(found.centre_m),
            step_m=mean(found.increment_m.T),
            body_nats=body_nats,
            stationary_nats=log_likelihood[:, STATIC],
            num_reads=num_reads,
            confidence=confidence,
            detected=self.detection.detected(confidence),
        )
        return TagAttentionState(now_s, segments, dwell, attention, body, hidden, num_reads), out

    def _no_attention(self, frame: Frame, num_segments: int) -> AttentionState | None:
        if self.attention is None:
            return None
        num_tags, num_antennas, num_window = frame.radio.relative_m.shape
        return AttentionState.nothing(num_tags, num_antennas, num_segments, num_window)

    def step(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, Trace]:
        """The next state, and the `Trace` of this frame with dense masks."""
        state, out = self.follow(camera, state, frame)
        return state, Trace(
            mask=dense_masks(out.labels, out.membership),
            box_px=out.box_px,
            centre_px=out.centre_px,
            centre_m=out.centre_m,
            step_m=out.step_m,
            confidence=out.confidence,
            detected=out.detected,
        )

    def finish(self, state: Any) -> Any:
        """The state itself: it holds no buffer of a frame."""
        return state

    def with_tags(self, camera: Camera, state: TagAttentionState, source: Int[Array, " tag"]) -> TagAttentionState:
        """The state for other tags: `source` is each one's place among the present ones, -1 for a new tag."""
        num_tags, num_segments = source.shape[0], self.segments.segmenter.num_segments
        fresh = (
            DwellState.nothing(num_tags, camera.antennas_m.shape[0], num_segments),
            jnp.zeros((num_tags, num_segments)),
            jnp.zeros(num_tags),
        )

        def moved(new: Array, old: Array) -> Array:
            known = (source >= 0).reshape(-1, *[1] * (new.ndim - 1))
            return jnp.where(known, old[jnp.maximum(source, 0)], new)

        def per_tag(one: TagAttentionState) -> list[Any]:
            dwell = one.dwell
            found = [dwell.real, dwell.imaginary, dwell.read_m, dwell.channel, dwell.log_likelihood]
            found += [one.body.membership, one.num_reads]
            return found + ([one.attention.log_likelihood] if one.attention is not None else [])

        dwell, table, row = fresh
        new = [dwell.real, dwell.imaginary, dwell.read_m, dwell.channel, dwell.log_likelihood, table, row, table]
        old = per_tag(state)
        return eqx.tree_at(per_tag, state, [moved(one, other) for one, other in zip(new, old, strict=False)])

    def shifted(self, state: TagAttentionState, by_s: Float[Array, ""]) -> TagAttentionState:
        """The state with all times later by `by_s`: for another origin of time."""

        def times(one: TagAttentionState) -> list[Any]:
            found = [one.time_s, one.body.past.time_s]
            return found + ([one.attention.time_s] if one.attention is not None else [])

        return eqx.tree_at(times, state, [one + by_s for one in times(state)])

    def physical(self) -> dict[str, float]:
        """The learnable parameters in physical units, by dotted name."""
        return named_values(self)

    def with_physical(self, values: Mapping[str, float]) -> TagAttention:
        """The tracer with these parameters in place of its own. Raises `ValueError` for other names, or impossible values."""
        return with_named_values(self, values)
