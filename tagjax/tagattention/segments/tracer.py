"""TagAttention on segments: the composition of its stages.

A frame passes through them in this order:

1. `segments`: depth and flow -> persistent segments and each one's motion (shared by all tags);
2. `travel`: what moves together -> motion that is pooled, and pasts that outlive a segment (shared as well);
3. `dwell`, with the `reader`'s noise model: this frame's reads -> evidence for each tag at each segment; where nothing
   measures depth, `unknown_depth` finds it;
4. `competition`: the other tags' bodies and evidence -> where this tag hardly is;
5. `body`: evidence and motion in space -> which segments belong to the rigid body that carries the tag;
6. `whole`: what is connected with a body that walks, and gets on as it does -> the whole of it;
7. `hidden`: the last body -> its evidence where it comes out again, and whether the tag is out of view;
8. `free`: the reads -> evidence for a path that nothing in view follows;
9. `detection`: evidence for that body, against its rivals, and how recent it is -> the confidence that the tag is on it.
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
from ...radio.arrivals import Arrivals
from ...radio.reader_model import ReaderModel
from ...tracing.status import Status
from ...tracing.tracer import AbstractSmoother, Camera, Frame, Trace
from .association import Association, SegmentTrace
from .attention import AttentionEvidence, AttentionState
from .body import BodyState, CarryingBody, LaterBody
from .competition import Competition, CompetitionState
from .cut import cut_segments
from .detection import Detection, Explanations, RecentReads, best_of_segments
from .dwell import DwellEvidence, DwellState
from .free_path import FreePath, FreePathState
from .given import without_joined
from .hidden import HiddenBody, HiddenState
from .hindsight import Hindsight
from .labels import STATIC
from .outline import (
    dense_masks,
    filled_labels,
    joined_boxes,
    joined_centroids,
    segment_boxes,
    segment_centroids,
)
from .state import TagAttentionState, TagState, last_s, of_tags, times
from .step import SegmentFrame, SegmentTracker
from .travel import Pooling, TravellingTogether
from .unknown_depth import RayMotion, UnknownDepth, UnknownDepthState
from .whole import WholeBody

CAMERA_MOVED_FRACTION = 0.8
"""Of the static background that shows another depth, in two frames: the camera moved. People in front of it cover less."""


class TagAttention(AbstractSmoother):
    """Traces every tag by the segments that move as its phases say. `TagAttention()` has good values.

    None is a stage that is off. Without `body` the segments that explain the reads best are the object (`cut_segments`).
    Raises `ValueError` without any evidence, for `hidden` and `free`, which need dwells, without them, and for `whole` and
    `competition` without a body.
    """

    segments: SegmentTracker = eqx.field(default_factory=SegmentTracker)
    travel: TravellingTogether | None = eqx.field(default_factory=TravellingTogether)
    reader: ReaderModel = eqx.field(default_factory=ReaderModel)
    dwell: DwellEvidence | None = eqx.field(default_factory=DwellEvidence)
    unknown_depth: UnknownDepth | None = None
    attention: AttentionEvidence | None = None
    body: CarryingBody | None = eqx.field(default_factory=CarryingBody)
    competition: Competition | None = eqx.field(default_factory=Competition)
    whole: WholeBody | None = eqx.field(default_factory=WholeBody)
    hidden: HiddenBody | None = eqx.field(default_factory=HiddenBody)
    free: FreePath | None = eqx.field(default_factory=FreePath)
    detection: Detection = eqx.field(default_factory=Detection)

    def __check_init__(self) -> None:
        if self.dwell is None and self.attention is None:
            raise ValueError("dwell and attention are both off; expected at least one: nothing else uses the reads.")
        if self.hidden is not None and self.dwell is None:
            raise ValueError("hidden is on and dwell is off; expected dwell for it. Set hidden to null.")
        if self.free is not None and self.dwell is None:
            raise ValueError("free is on and dwell is off; expected dwell, whose memory it shares. Set free to null.")
        if self.unknown_depth is not None and self.dwell is None:
            raise ValueError("unknown_depth is on and dwell is off; expected dwell, whose memory it has.")
        if self.body is not None and self.travel is None:
            raise ValueError(
                "body is on and travel is off; expected travel, which carries on the motion of new segments. For no pooling of "
                "evidence set travel.heal_s to a long time, such as 1.0e9."
            )
        if self.whole is not None and self.body is None:
            raise ValueError("whole is on and body is off; expected a body that it completes. Set whole to null.")
        if self.competition is not None and self.body is None:
            raise ValueError(
                "competition is on and body is off; expected bodies that compete. Set competition to null."
            )

    def init(self, camera: Camera, frame: Frame) -> TagAttentionState:
        """The state before the first frame."""
        assert frame.present is not None
        num_tags, num_window = frame.present.shape[-1], frame.radio.relative_m.shape[-1]
        return TagAttentionState(
            segments=self.segments.init(camera),
            tags=self.no_reads(num_tags, camera.antennas_m.shape[0], num_window, frame.time_s),
            background_lost=jnp.zeros(()),
            camera_moved=jnp.zeros((), bool),
        )

    def no_reads(self, num_tags: int, num_antennas: int, num_window: int, time_s: Float[Array, ""]) -> TagState:
        """The state of the tags before the first frame: what `associate` begins with."""
        num_segments = self.segments.segmenter.num_segments
        dwell = attention = None
        if self.unknown_depth is not None:
            dwell = self.unknown_depth.init(num_tags, num_antennas, num_segments)
        elif self.dwell is not None:
            dwell = DwellState.nothing(num_tags, num_antennas, num_segments)
        if self.attention is not None:
            attention = AttentionState.nothing(num_tags, num_antennas, num_segments, num_window, time_s)
        return TagState(
            time_s=jnp.full_like(time_s, jnp.nan),
            travel=None if self.travel is None else self.travel.init(num_segments),
            dwell=dwell,
            attention=attention,
            body=None if self.body is None else self.body.init(num_tags, num_segments),
            competition=None if self.competition is None else CompetitionState.nothing(num_tags, num_segments),
            hidden=None if self.hidden is None else HiddenState.nothing(num_tags),
            free=None if self.free is None else self.free.init(num_tags, num_antennas),
            recent=RecentReads.nothing(num_tags),
        )

    def step(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, Trace]:
        """The next state, and the `Trace` of this frame with dense masks."""
        state, out = self.follow(camera, state, frame)
        tags = out.tags
        return state, Trace(
            mask=dense_masks(out.labels, tags.membership),
            box_px=out.box_px,
            centre_px=out.centre_px,
            centre_m=tags.centre_m,
            step_m=tags.step_m,
            confidence=tags.confidence,
            detected=tags.detected,
            status=tags.status,
            evidence=tags.evidence(),
        )

    def follow(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, SegmentTrace]:
        """The next state and the output on segments, without dense masks."""
        dt_s, later = frame.time_s - last_s(state.tags, frame), frame.backward_message
        moves_later = None if later is None else later.moves()
        segments, found = self.segments.step(
            camera, state.segments, frame.depth_m, frame.backward_px, dt_s, frame.objects, moves_later
        )
        tags, out = self.associate(camera, state.tags, found, frame)
        labels = filled_labels(found.labels, frame.depth_m)
        if frame.objects is not None:
            labels = without_joined(labels, frame.objects, found.area.shape[0])
        num_segments, member = found.area.shape[0], out.membership > 0.5
        # A single frame's wrong depth is no motion; a deeper surface is accepted as background within two or three.
        lost = jnp.minimum(state.background_lost, found.background_lost) > CAMERA_MOVED_FRACTION
        after = TagAttentionState(segments, tags, found.background_lost, state.camera_moved | lost)
        return after, SegmentTrace(
            labels=labels,
            box_px=joined_boxes(segment_boxes(labels, num_segments), member),
            centre_px=joined_centroids(segment_centroids(labels, num_segments), member),
            tags=out,
        )

    def backward_step(
        self, camera: Camera, state: TagAttentionState, frame: Frame
    ) -> tuple[TagAttentionState, Hindsight]:
        """The next state on the time-reversed recording, and what it knows for the forward pass."""
        dt_s = frame.time_s - last_s(state.tags, frame)
        segments, found = self.segments.step(
            camera, state.segments, frame.depth_m, frame.backward_px, dt_s, frame.objects
        )
        tags, out = self.associate(camera, state.tags, found, frame)
        after = TagAttentionState(segments, tags, found.background_lost, state.camera_moved)
        return after, self.hindsight(found, tags, out)

    def hindsight(self, found: SegmentFrame, tags: TagState, out: Association) -> Hindsight:
        """What the backward pass hands over at a frame, from its segments, and its state and bodies after this frame."""
        evidence = jnp.zeros_like(out.membership)
        if tags.dwell is not None:
            evidence = evidence + tags.dwell.log_likelihood
        if self.attention is not None and tags.attention is not None:
            evidence = evidence + self.attention.weight.value * tags.attention.log_likelihood
        return Hindsight(
            labels=found.labels,
            evidence=evidence,
            recent=tags.recent,
            free_nats=jnp.zeros(out.confidence.shape) if tags.free is None else tags.free.log_likelihood,
            body=None if tags.body is None else LaterBody(tags.body.membership, tags.body.fastest_m_s),
            member=jnp.any(out.membership > 0.5, axis=0),
        )

    def compact(self, message: Hindsight) -> Hindsight:
        """The message in half as many bytes."""
        return message.compact()

    def associate(
        self, camera: Camera, state: TagState, found: SegmentFrame, frame: Frame
    ) -> tuple[TagState, Association]:
        """The next state of the tags and their bodies, from a frame's segments and reads.

        With a `backward_message` the bodies are found by the later reads as well; what is carried on to the next frame rests
        on the reads up to this one.
        """
        assert frame.arrivals is not None
        assert frame.present is not None
        now_s, since_s = frame.time_s, last_s(state, frame)
        dt_s = now_s - since_s
        travel, pooling = state.travel, None
        if self.travel is not None and travel is not None:
            travel, found, pooling = self.travel.step(travel, found, since_s, now_s)
        dwell, attention, own = self._evidence(camera, state, found, pooling, frame)
        later: Hindsight | None = frame.backward_message
        evidence, later_body = own, None
        if later is not None:
            later_evidence, later_body = later.on(found.labels)
            evidence = own + later_evidence
        prior_nats, rival_nats = self._competition(state.competition, evidence, own, found, frame.present)
        body, membership, place = self._bodies(state.body, evidence, prior_nats, found, since_s, now_s, later_body)
        membership = jnp.where(frame.present[:, None], membership, 0.0).astype(found.area.dtype)
        weight = membership * found.area[None]
        total = jnp.sum(weight, axis=1)

        def mean(values: Float[Array, "... segment"]) -> Float[Array, "tag ..."]:
            return safe_divide(weight @ values, jnp.broadcast_to(total[:, None], (total.shape[0], values.shape[-1])))

        # Parts that move against the tag's place (legs, say) belong to the body, and have less evidence than the place.
        at_place = membership * place
        mass = jnp.sum(at_place, axis=1)
        some = (total > 0) & (mass > 0)
        body_nats, own_nats = (safe_divide(jnp.sum(at_place * nats, axis=1), mass) for nats in (evidence, own))
        centre_m, hidden, hides = mean(found.centre_m), state.hidden, jnp.zeros(total.shape, bool)
        if self.hidden is not None and hidden is not None and self.dwell is not None:
            velocity_m_s = mean(found.motion_m) / jnp.maximum(dt_s, 1e-3)
            kept = jnp.exp(-dt_s / self.dwell.memory_s.value)
            unseen = self.hidden.out_of_view(camera, hidden, frame.depth_m, found.labels, membership, dt_s)
            hidden, remembered = self.hidden.step(
                hidden, own_nats, some, centre_m, velocity_m_s, kept, dt_s, rival_nats
            )
            hides = remembered & unseen
        free, free_nats, free_added = self._free(state, frame, since_s)
        recent = self.detection.received(state.recent, frame.arrivals, free_added, since_s, now_s)
        around = recent if later is None else jax.tree.map(jnp.add, recent, later.recent)
        if later is not None:
            free_nats = free_nats + later.free_nats
        nats = Explanations(body_nats, evidence[:, STATIC], free_nats)
        confidence = self.detection.confidence(nats, around)
        in_view = jnp.any(membership > 0.5, axis=1)
        confidence = jnp.where(frame.present & in_view & ~hides, confidence, 0.0)
        detected = self.detection.detected(confidence)
        reasons = nats
        if hidden is not None:  # remembered by the reads up to this frame
            reasons = Explanations(
                body=jnp.where(hides, hidden.evidence_nats, nats.body),
                stationary=jnp.where(hides, own[:, STATIC], nats.stationary),
                free=nats.free,
            )
        status = self.detection.status(reasons, around, detected, in_view, hides)
        competition = (
            None if state.competition is None else CompetitionState(membership, jax.lax.stop_gradient(confidence))
        )
        return TagState(now_s, travel, dwell, attention, body, competition, hidden, free, recent), Association(
            membership=membership,
            place=place,
            centre_m=centre_m,
            step_m=mean(found.increment_m.T),
            nats=nats,
            confidence=confidence,
            detected=detected,
            status=jnp.where(frame.present, status, jnp.int8(Status.UNKNOWN)),
            best_nats=best_of_segments(evidence, found.in_view),
        )

    def _evidence(
        self, camera: Camera, state: TagState, found: SegmentFrame, pooling: Pooling | None, frame: Frame
    ) -> tuple[DwellState | UnknownDepthState | None, AttentionState | None, Float[Array, "tag segment"]]:
        """The states of the stages that use reads, and their evidence."""
        assert frame.arrivals is not None
        assert frame.present is not None
        now_s, since_s = frame.time_s, last_s(state, frame)
        dt_s = now_s - since_s
        dwell, attention = state.dwell, state.attention
        evidence = jnp.zeros((frame.present.shape[0], found.area.shape[0]))
        if self.dwell is not None and dwell is not None:
            dwell, evidence = self._of_reads(camera, dwell, found, pooling, frame.arrivals, since_s, now_s)
            if self.hidden is not None and state.hidden is not None:
                evidence = self.hidden.inherited(state.hidden, evidence, found.centre_m, found.source > -2)
            if self.travel is not None and pooling is not None:
                evidence = self.travel.heal(pooling, evidence, dt_s)
            dwell = dwell.with_evidence(evidence)
        if self.attention is not None and attention is not None:
            attention, agreed = self.attention.step(
                attention, frame.radio, found.increment_m, found.known, found.source, since_s, now_s
            )
            evidence = evidence + self.attention.weight.value * agreed
        return dwell, attention, evidence

    def _free(
        self, state: TagState, frame: Frame, since_s: Float[Array, ""]
    ) -> tuple[FreePathState | None, Float[Array, " tag"], Float[Array, " tag"]]:
        """The state of the free paths, their evidence, and what this frame's reads have added to it; 0 without the stage."""
        if self.free is None or state.free is None or self.dwell is None:
            nothing = jnp.zeros(state.recent.number.shape)
            return None, nothing, nothing
        assert frame.arrivals is not None
        after, added = self.free.step(
            self.reader, state.free, frame.arrivals, self.dwell.memory_s.value, since_s, frame.time_s
        )
        return after, after.log_likelihood, added

    def _of_reads(
        self,
        camera: Camera,
        state: DwellState | UnknownDepthState,
        found: SegmentFrame,
        pooling: Pooling | None,
        arrivals: Arrivals,
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> tuple[DwellState | UnknownDepthState, Float[Array, "tag segment"]]:
        """The state after the frame's reads, and their evidence: from the segments' ranges, or from their rays alone."""
        assert self.dwell is not None
        if self.unknown_depth is None:
            assert isinstance(state, DwellState)
            return self.dwell.step(
                self.reader, state, arrivals, found.increment_m, found.centre_m[:, 2], found.source,
                since_s, now_s, found.area > 0,
            )  # fmt: skip
        assert isinstance(state, UnknownDepthState)
        motion_m = found.motion_m if pooling is None else pooling.mean(found.motion_m)
        motion = RayMotion.of(found.centre_m, motion_m)
        if pooling is not None:
            motion = self.unknown_depth.with_scale(motion, state, found, pooling, now_s - since_s)
        return self.unknown_depth.step(
            self.reader,
            self.dwell.memory_s.value,
            state,
            arrivals,
            camera.antennas_m,
            motion,
            found.source,
            since_s,
            now_s,
        )

    def _competition(
        self,
        state: CompetitionState | None,
        log_likelihood: Float[Array, "tag segment"],
        own: Float[Array, "tag segment"],
        found: SegmentFrame,
        present: Bool[Array, " tag"],
    ) -> tuple[Float[Array, "tag segment"] | None, Float[Array, " tag"] | None]:
        """What the other tags leave each tag, nats, and the best `own` evidence for a body of any tag; None without the stage."""
        if self.competition is None or state is None or self.body is None:
            return None, None
        evidence = log_likelihood - log_likelihood[:, STATIC : STATIC + 1]
        temperature_nats = self.body.temperature_nats.value
        last = self.competition.bodies(state, found, present)
        prior = self.competition.log_prior(last, evidence, found, temperature_nats)
        rival_nats = jax.lax.stop_gradient(jnp.max(last.evidence_of(own), axis=1))
        return temperature_nats * prior, rival_nats

    def _bodies(
        self,
        state: BodyState | None,
        log_likelihood: Float[Array, "tag segment"],
        prior_nats: Float[Array, "tag segment"] | None,
        found: SegmentFrame,
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
        later: LaterBody | None = None,
    ) -> tuple[BodyState | None, Float[Array, "tag segment"], Float[Array, "tag segment"]]:
        """The state of the bodies, the probability that each segment belongs to each tag's, and that of the tag's place."""
        if self.body is None or state is None:
            membership = cut_segments(log_likelihood, found.in_view)
            return None, membership, membership * found.area[None]
        evidence = log_likelihood - log_likelihood[:, STATIC : STATIC + 1]
        if prior_nats is not None:
            evidence = evidence + prior_nats
        state, bodies = self.body.step(state, evidence, found, since_s, now_s, later)
        membership = jax.nn.sigmoid(bodies.log_odds)
        if self.whole is not None:
            moved = state.past.since(self.whole.lag_s, found.displacement_m, found.life_s, now_s)
            membership = self.whole.completed(membership, found, *moved)
        return state, membership, bodies.place

    def camera_moved(self, state: TagAttentionState) -> Bool[Array, ""]:
        """Whether in two frames one after the other nearly all of the static background showed another depth."""
        return state.camera_moved

    def finish(self, state: Any) -> Any:
        """The state itself: it holds no buffer of a frame."""
        return state

    def with_tags(self, camera: Camera, state: TagAttentionState, source: Int[Array, " tag"]) -> TagAttentionState:
        """The state for other tags: `source` is each one's place among the present ones, -1 for a new tag."""
        num_window = 1 if state.tags.attention is None else state.tags.attention.num_window
        fresh = self.no_reads(source.shape[0], camera.antennas_m.shape[0], num_window, state.tags.time_s)

        def moved(new: Array, old: Array) -> Array:
            known = (source >= 0).reshape(-1, *[1] * (new.ndim - 1))
            return jnp.where(known, old[jnp.maximum(source, 0)], new)

        leaves = [moved(new, old) for new, old in zip(of_tags(fresh), of_tags(state.tags), strict=True)]
        return eqx.tree_at(lambda one: one.tags, state, eqx.tree_at(of_tags, state.tags, leaves))

    def shifted(self, state: TagAttentionState, by_s: Float[Array, ""]) -> TagAttentionState:
        """The state with all times later by `by_s`: for another origin of time."""
        later = eqx.tree_at(times, state.tags, [one + by_s for one in times(state.tags)])
        return eqx.tree_at(lambda one: one.tags, state, later)

    def physical(self) -> dict[str, float]:
        """The learnable parameters in physical units, by dotted name."""
        return named_values(self)

    def with_physical(self, values: Mapping[str, float]) -> TagAttention:
        """The tracer with these parameters in place of its own. Raises `ValueError` for other names, or impossible values."""
        return with_named_values(self, values)
