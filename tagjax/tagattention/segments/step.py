"""One frame of the tracer's pixel side: background, labels, and the motion of each segment."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...tracing.tracer import Camera, stored
from .background import Background, BackgroundState, BackgroundView
from .carry import on_surface
from .cells import NO_LABEL
from .increments import segment_motion
from .labels import STATIC, Labelling, Segmenter, SegmentState


class SegmentFrame(eqx.Module):
    """The segments of a frame, shared by all tags. Slot 0 is the static background; unused slots have area 0.

    Several frames have a leading axis of time.
    """

    labels: Int[Array, "*time height width"]  # slot of each pixel, -1 = none
    increment_m: Float[Array, "*time antenna segment"]  # change of the range since the last frame, 0 where not known
    motion_m: Float[Array, "*time segment 3"]  # camera frame, 0 where not known
    known: Bool[Array, "*time segment"]
    centre_m: Float[Array, "*time segment 3"]  # camera frame
    area: Float[Array, "*time segment"]  # pixels
    size_m: Float[Array, "*time segment"]  # side of a square of this area at its depth
    life_s: Float[Array, "*time segment"]  # since birth
    displacement_m: Float[Array, "*time segment 3"]  # since birth
    moved: Bool[Array, "*time segment"]  # was ever displaced by `labels.moved_m`
    front: Float[Array, "*time segment"]  # fraction of its pixels in front of all that has been seen at rest there
    source: Int[Array, "*time segment"]  # slot of the last frame that a new segment comes from, -1 = none; -2 = not new
    num_unplaced: Int[Array, "*time"]  # new segments that found no free slot
    background_lost: Float[
        Array, "*time"
    ]  # fraction of the confirmed background that shows another depth: near 1, the camera moved

    @property
    def in_view(self) -> Bool[Array, " segment"]:
        """Of one frame: the segments that it shows, without the static background."""
        return (self.area > 0) & (jnp.arange(self.area.shape[0]) != STATIC)


class SegmentTrackerState(eqx.Module):
    """What is carried from frame to frame."""

    background: BackgroundState | None
    segments: SegmentState


class SegmentTracker(eqx.Module):
    """Persistent segments of whatever moves, from depth and backward flow. `SegmentTracker()` has good values.

    Without a `background` nothing is static: every pixel belongs to a segment.
    """

    background: Background | None = eqx.field(default_factory=Background)
    segmenter: Segmenter = eqx.field(default_factory=Segmenter)

    def init(self, camera: Camera) -> SegmentTrackerState:
        """The state before the first frame. Raises `ValueError` where the first frame would need too many slots."""
        height, width, _ = camera.rays.shape
        background = None if self.background is None else self.background.init(height, width)
        return SegmentTrackerState(background, self.segmenter.init(height, width))

    def step(
        self,
        camera: Camera,
        state: SegmentTrackerState,
        depth_m: Float[Array, "height width"],
        backward_px: Float[Array, "height width 2"],
        dt_s: Float[Array, ""],
        objects: Int[Array, "height width"] | None = None,
        moves_later: Bool[Array, "height width"] | None = None,
    ) -> tuple[SegmentTrackerState, SegmentFrame]:
        """The next frame, `dt_s` after the last; `depth_m` is z, 0 = missing.

        `backward_px` lies on the pixels of this frame and points to the last one; where it is not finite it counts as 0. A
        frame without depth has no labels, and leaves the segments as they are. Only `increment_m` and `motion_m` have
        gradients, in depth and flow. Given `objects` are segments in place of its own (`Frame.objects`).
        Pixels of `moves_later`, which offline smoothing knows to move, are not static.
        """
        backward_px = jnp.where(jnp.isfinite(backward_px), backward_px, 0.0)
        valid, focal = on_surface(depth_m), focal_px(camera)
        background, view = None, BackgroundView.nothing(*depth_m.shape)
        if self.background is not None and state.background is not None:
            background, view = self.background.step(state.background, depth_m, valid, backward_px, dt_s, focal)
        if moves_later is not None:
            view = view.without(moves_later)
        seen = jnp.any(valid)

        def looked() -> tuple[SegmentState, Labelling]:
            return self.segmenter.step(
                state.segments, camera.rays, depth_m, valid, backward_px, view, dt_s, focal, objects
            )

        nothing = Labelling.nothing(depth_m.shape[0], depth_m.shape[1], self.segmenter.num_segments)
        segments, found = jax.lax.cond(seen, looked, lambda: (state.segments, nothing))
        labels, counted = stored((segments.labels, found.counted))
        motion = segment_motion(
            camera, labels, counted, depth_m, state.segments.depth_m, backward_px,
            self.segmenter.max_change_m(dt_s), self.segmenter.num_segments, self.segmenter.min_measured,
        )  # fmt: skip
        segments = self.segmenter.displaced(segments, motion.motion_m, found.source)
        frame = SegmentFrame(
            labels=jnp.where(seen, labels, NO_LABEL),
            increment_m=motion.increment_m,
            motion_m=motion.motion_m,
            known=motion.known,
            centre_m=segments.centre_m,
            area=jnp.where(seen, segments.area, 0.0),
            size_m=jnp.sqrt(segments.area) * segments.centre_m[:, 2] / focal,
            life_s=segments.life_s,
            displacement_m=segments.displacement_m,
            moved=segments.moved,
            front=found.front,
            source=found.source,
            num_unplaced=found.num_unplaced,
            background_lost=jax.lax.stop_gradient(view.lost),
        )
        return SegmentTrackerState(background, segments), stored(frame)


def focal_px(camera: Camera) -> Float[Array, ""]:
    """The focal length, pixels, from the rays of the first row; 1 where all are one."""
    first = camera.rays[0, :, 0]
    span = first[-1] - first[0]
    return jnp.where(span > 0, (len(first) - 1) / jnp.where(span > 0, span, 1.0), 1.0)
