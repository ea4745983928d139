"""The whole tracer in NumPy, with the settings of a `TagAttention`."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import TagAttention
from ...tagattention.segments.cells import NO_LABEL, NOT_NEW
from ...tagattention.segments.labels import STATIC
from ...tracing.tracer import Camera, Frame
from .background import Background, on_surface
from .body import Body, sigmoid
from .competition import Competition
from .hiding import Hidden, Whole
from .labels import Labels
from .motion import segment_motion
from .outline import boxes_and_centroids, dense_masks, filled_labels
from .reads import Confidence, Dwells, FreePaths
from .travel import Segments, Travel


@dataclasses.dataclass(frozen=True)
class NumpyTrace:
    """The output for one frame; see `SegmentTrace` and `Association`."""

    labels: Int[np.ndarray, "height width"]
    box_px: Float[np.ndarray, "tag 4"]
    centre_px: Float[np.ndarray, "tag 2"]
    membership: Float[np.ndarray, "tag segment"]
    confidence: Float[np.ndarray, " tag"]
    detected: Bool[np.ndarray, " tag"]


class NumpyTracer:
    """Holds the state; `follow` takes the next frame.

    Raises `ValueError` for a tracer with a stage that has no counterpart here.
    """

    def __init__(self, tracer: TagAttention, camera: Camera, num_tags: int) -> None:
        if tracer.attention is not None:
            raise ValueError("attention is on; expected null: the NumPy tracer has evidence of dwells only.")
        background = tracer.segments.background
        if tracer.dwell is None or tracer.body is None or background is None:
            raise ValueError(
                "dwell, body or background is off; expected all of them: the NumPy tracer cannot do without."
            )
        settings = tracer.segments.segmenter
        self.min_measured = settings.min_measured
        rays, self.antennas_m = np.asarray(camera.rays), np.asarray(camera.antennas_m)
        self.rays = np.ascontiguousarray(rays[..., 0]), np.ascontiguousarray(rays[..., 1])
        (height, width), num = self.rays[0].shape, settings.num_segments
        span = self.rays[0][0, -1] - self.rays[0][0, 0]
        self.focal_px = np.float32((width - 1) / span) if span > 0 else np.float32(1)
        self.background = Background(background, height, width)
        self.labels = Labels(settings, height, width)
        self.travel = None if tracer.travel is None else Travel(tracer.travel, num)
        self.dwells = Dwells(tracer.dwell, tracer.reader, num_tags, len(self.antennas_m), num)
        self.body = Body(tracer.body, num_tags, num)
        self.competition = None
        if tracer.competition is not None:
            self.competition = Competition(tracer.competition, self.body.value["temperature_nats"], num_tags, num)
        self.whole = None if tracer.whole is None else Whole(tracer.whole)
        self.hidden = None if tracer.hidden is None else Hidden(tracer.hidden, num_tags)
        self.free = None
        if tracer.free is not None:
            self.free = FreePaths(tracer.free, tracer.reader, num_tags, len(self.antennas_m))
        self.confidence = Confidence(tracer.detection, num_tags)
        self.time_s: np.float32 | None = None

    def follow(self, frame: Frame) -> NumpyTrace:
        """The output for the next frame, without dense masks."""
        assert frame.arrivals is not None
        assert frame.present is not None
        now_s = np.float32(frame.time_s)
        since_s = now_s if self.time_s is None else self.time_s
        depth_m, present = np.asarray(frame.depth_m), np.asarray(frame.present)
        found, labels = self.pixels(depth_m, np.asarray(frame.backward_px), now_s - since_s)
        membership, confidence = self.associate(found, labels, frame, present, since_s, now_s)
        self.time_s = now_s
        filled = filled_labels(labels, depth_m)
        box_px, centre_px = boxes_and_centroids(filled, membership > 0.5)
        detected = confidence > self.confidence.threshold
        return NumpyTrace(filled, box_px, centre_px, membership, confidence, detected)

    def masks(self, trace: NumpyTrace) -> Float[np.ndarray, "tag height width"]:
        """The soft masks of a frame."""
        return dense_masks(trace.labels, trace.membership)

    def pixels(
        self,
        depth_m: Float[np.ndarray, "height width"],
        backward_px: Float[np.ndarray, "height width 2"],
        dt_s: np.float32,
    ) -> tuple[Segments, Int[np.ndarray, "height width"]]:
        """The segments of the next frame, shared by all tags, and its labels."""
        if not np.isfinite(backward_px).all():
            backward_px = np.where(np.isfinite(backward_px), backward_px, np.float32(0))
        valid, own, background = on_surface(depth_m), self.labels, self.background
        view = background.step(depth_m, valid, backward_px, dt_s, self.focal_px)
        num, last_depth_m = len(own.area), own.depth_m
        if valid.any():
            ages = background.early_s, background.confirm_s
            change = own.step(self.rays, depth_m, valid, backward_px, view, ages, dt_s, self.focal_px)
            increment_m, motion_m, known = segment_motion(
                self.rays, self.antennas_m, own.labels, change.counted, depth_m, last_depth_m, backward_px,
                own.max_change_m(dt_s), num, self.min_measured,
            )  # fmt: skip
            own.displaced(motion_m, change.source)
            labels, area, source = own.labels, own.area, change.source
            in_front = np.bincount(labels[view.front & (labels >= 0)], minlength=num).astype(np.float32)
        else:  # a frame without depth leaves the segments as they are
            increment_m, motion_m = np.zeros((len(self.antennas_m), num), np.float32), np.zeros((num, 3), np.float32)
            labels, known = np.full(depth_m.shape, NO_LABEL, np.int32), np.arange(num) == STATIC
            area, source = np.zeros(num, np.float32), np.full(num, NOT_NEW, np.int32)
            in_front = np.zeros(num, np.float32)
        size_m = np.sqrt(own.area) * own.centre_m[:, 2] / self.focal_px
        return Segments(
            increment_m, motion_m, known, own.centre_m, area, size_m, own.life_s, own.displacement_m,
            in_front / np.maximum(area, np.float32(1)), source,
        ), labels  # fmt: skip

    def associate(
        self,
        found: Segments,
        labels: Int[np.ndarray, "height width"],
        frame: Frame,
        present: Bool[np.ndarray, " tag"],
        since_s: np.float32,
        now_s: np.float32,
    ) -> tuple[Float[np.ndarray, "tag segment"], Float[np.ndarray, " tag"]]:
        """Each tag's membership of segments and its confidence."""
        assert frame.arrivals is not None
        dt_s = now_s - since_s
        pooling = None if self.travel is None else self.travel.step(found, dt_s, now_s)
        arrivals = {name: np.asarray(values) for name, values in vars(frame.arrivals).items()}
        nats = self.dwells.step(
            arrivals, found.increment_m, found.centre_m[:, 2], found.source, since_s, now_s, found.exists
        )
        if self.hidden is not None:
            self.hidden.inherit(nats, found)
        if self.travel is not None and pooling is not None:
            self.travel.heal(pooling, nats, dt_s)
        evidence = nats - nats[:, :1]
        rival_nats = None
        if self.competition is not None:
            bodies = self.competition.bodies(found, present)
            rival_nats = bodies.evidence_of(nats).max(axis=1)
            evidence += self.competition.prior_nats(bodies, evidence)
        log_odds, place = self.body.step(evidence, found, since_s, now_s)
        membership = sigmoid(log_odds)
        if self.whole is not None:
            moved = self.body.past.since(self.whole.lag_s, found.displacement_m, found.life_s, now_s)
            self.whole.complete(membership, found, *moved)
        membership[~present] = 0
        weight = membership * found.area
        total = weight.sum(axis=1)
        divisor = np.where(total > 0, total, np.float32(1))[:, None]
        at_place = membership * place
        mass = at_place.sum(axis=1)
        some = (total > 0) & (mass > 0)
        share = at_place / np.where(some, mass, np.float32(1))[:, None]
        body_nats = np.einsum("ts,ts->t", share, nats)
        hides = np.zeros(len(total), bool)
        if self.hidden is not None:
            centre_m, motion_m = weight @ found.centre_m / divisor, weight @ found.motion_m / divisor
            kept = np.exp(-dt_s / self.dwells.memory_s)
            hides = self.hidden.out_of_view(self.rays, np.asarray(frame.depth_m), labels, membership, dt_s)
            velocity_m_s = motion_m / max(dt_s, np.float32(1e-3))
            hides &= self.hidden.step(body_nats, some, centre_m, velocity_m_s, kept, dt_s, rival_nats)
        free_nats = free_added = np.zeros(len(total), np.float32)
        if self.free is not None:
            free_added = self.free.step(arrivals, self.dwells.memory_s, since_s, now_s)
            free_nats = self.free.log_likelihood
        self.confidence.received(arrivals, free_added, since_s, now_s)
        confidence = self.confidence.of(body_nats, nats[:, STATIC], free_nats)
        shown = present & (membership > 0.5).any(axis=1) & ~hides
        confidence = np.where(shown, confidence, np.float32(0))
        if self.competition is not None:
            self.competition.membership, self.competition.confidence = membership, confidence
        return membership, confidence
