"""Persistent segments: labels that follow the flow from frame to frame, so that a segment's evidence can add up for seconds.

Slot 0 is the static background; the others are pieces, some `side_m` wide, of what has moved or has yet to prove still.
Labels are data: no gradient flows through anything here.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import entries, safe_norm
from ...core.parameters import check_positive, check_positive_integers
from ...image.warp import pixel_grid
from .background import BackgroundView
from .carry import carried_labels, next_dither
from .cells import NO_LABEL, NOT_NEW, births
from .given import first_given, given_slots, sources_with_given

STATIC = 0
"""The slot of the static background."""

_SAME_DEPTH_M = 0.02  # noise of a depth between two frames
_STAY = 0.05  # a pixel changes to another segment only if that is nearer by this, cells^2
_START_ROUNDS = 3
_START_FRACTION = 0.75  # of the slots that the first frame takes


# Three maps, not one of three channels: XLA gathers from those five times as fast on a CPU.
Feature = tuple[Float[Array, "height width"], Float[Array, "height width"], Float[Array, "height width"]]


class SegmentState(eqx.Module):
    """The segments after a frame; a slot without a segment has area 0."""

    labels: Int[Array, "height width"]  # slot of each pixel; 0 = static background, -1 = none
    dither_px: Float[Array, " axis"]  # (x, y), by which the next frame's sources are shifted
    depth_m: Float[Array, "height width"]  # of that frame
    life_s: Float[Array, " segment"]  # time since birth
    displacement_m: Float[Array, "segment 3"]  # since birth
    moved: Bool[Array, " segment"]  # was ever displaced by `moved_m`
    area: Float[Array, " segment"]  # pixels
    centre_m: Float[Array, "segment 3"]  # mean of its points, camera frame


class Labelling(eqx.Module):
    """What `Segmenter.step` says of a frame beside the state."""

    counted: Bool[Array, "height width"]  # kept its label, or belongs to a new segment and shows a surface seen before
    source: Int[Array, " segment"]  # slot (of the frame before) that a new segment comes from, -1 = none; -2 = not new
    front: Float[Array, " segment"]  # fraction of its pixels in front of all that has been seen at rest there
    num_unplaced: Int[Array, ""]  # new segments that found no free slot

    @staticmethod
    def nothing(height: int, width: int, num_segments: int) -> Labelling:
        """Of a frame that shows nothing."""
        counted = jnp.zeros((height, width), bool)
        source = jnp.full(num_segments, NOT_NEW, jnp.int32)
        return Labelling(counted, source, jnp.zeros(num_segments), jnp.zeros((), jnp.int32))


def slot_sums(
    values: Sequence[Float[Array, "height width"]],
    member: Bool[Array, "height width"],
    labels: Int[Array, "height width"],
    num_segments: int,
) -> list[Float[Array, " segment"]]:
    """Sums of each map over the pixels of each slot that are `member`."""
    # The others go to a slot that does not exist: masked maps would be computed anew for each sum.
    slot = jnp.where(member, labels, num_segments).reshape(-1)
    return [jax.ops.segment_sum(value.reshape(-1), slot, num_segments) for value in values]


class Segmenter(eqx.Module):
    """Cuts what moves into segments and keeps their identity. Lengths in pixels are those of the working resolution.

    Good values: the defaults. `side_m` 0.05 is less than the width of a forearm; `reach` (squared distance from a segment's
    centre, in sides, beyond which a pixel is not assigned to it) 2, up to 4 alike; `depth_weight` 0.5 (depth of a side counts as half a
    side); `moved_m` 0.03; `max_speed_m_s` 2 of the depth of a surface. `start_side_px` is chosen so that the first frame
    takes at most 3/4 of the slots where it is None. Sides of 1 and `min_pixels` 0 make a segment of each pixel. Raises
    `ValueError` for values that are not positive, but for `min_pixels`.
    """

    num_segments: int = eqx.field(static=True, default=2048)
    side_m: float = eqx.field(static=True, default=0.05)
    min_side_px: int = eqx.field(static=True, default=4)
    max_side_px: int = eqx.field(static=True, default=12)
    start_side_px: int | None = eqx.field(static=True, default=None)
    min_pixels: int = eqx.field(static=True, default=4)  # segments with fewer end, new ones have more
    reach: float = eqx.field(static=True, default=2.0)
    depth_weight: float = eqx.field(static=True, default=0.5)
    moved_m: float = eqx.field(static=True, default=0.03)
    max_speed_m_s: float = eqx.field(static=True, default=2.0)

    def __check_init__(self) -> None:
        whole = ("num_segments", "min_side_px", "max_side_px")
        check_positive_integers(**{name: getattr(self, name) for name in whole})
        lengths = ("side_m", "reach", "moved_m", "max_speed_m_s")
        check_positive(**{name: getattr(self, name) for name in lengths})
        if not (isinstance(self.min_pixels, int) and self.min_pixels >= 0):
            raise ValueError(f"min_pixels is {self.min_pixels}; expected an integer of at least 0.")
        if not self.depth_weight >= 0:
            raise ValueError(f"depth_weight is {self.depth_weight}; expected at least 0.")
        if self.num_segments < 2:
            raise ValueError("num_segments is 1; expected at least 2: slot 0 is the static background.")
        if self.max_side_px < self.min_side_px:
            raise ValueError(f"max_side_px is {self.max_side_px}; expected at least min_side_px, {self.min_side_px}.")
        if self.start_side_px is not None:
            check_positive_integers(start_side_px=self.start_side_px)

    def start_side(self, height: int, width: int) -> int:
        """The side of the first frame's blocks, pixels. Raises `ValueError` where `start_side_px` needs too many slots."""

        def num_blocks(side: int) -> int:
            return -(-height // side) * -(-width // side)

        if self.start_side_px is not None:
            if num_blocks(self.start_side_px) >= self.num_segments:
                raise ValueError(
                    f"start_side_px is {self.start_side_px}, which cuts {height} x {width} pixels into {num_blocks(self.start_side_px)} "
                    f"blocks; expected fewer than num_segments, {self.num_segments}. Set it to null, or raise num_segments."
                )
            return self.start_side_px
        side = self.min_side_px
        while height * width > _START_FRACTION * self.num_segments * side**2 or num_blocks(side) >= self.num_segments:
            side += 1
        return side

    @property
    def min_measured(self) -> int:
        """A segment's motion is known from so many measured pixels on."""
        return 2 if self.min_pixels > 0 else 1

    def max_change_m(self, dt_s: Float[Array, ""]) -> Float[Array, ""]:
        """A surface's depth changes by less than this in `dt_s`."""
        return _SAME_DEPTH_M + self.max_speed_m_s * dt_s

    def init(self, height: int, width: int) -> SegmentState:
        """No segment."""
        self.start_side(height, width)
        zero = jnp.zeros(self.num_segments)
        return SegmentState(
            labels=jnp.full((height, width), NO_LABEL, jnp.int32),
            dither_px=jnp.zeros(2),
            depth_m=jnp.zeros((height, width)),
            life_s=zero,
            displacement_m=jnp.zeros((self.num_segments, 3)),
            moved=zero > 0,
            area=zero,
            centre_m=jnp.zeros((self.num_segments, 3)),
        )

    def step(
        self,
        state: SegmentState,
        rays: Float[Array, "height width 3"],
        depth_m: Float[Array, "height width"],
        valid: Bool[Array, "height width"],
        backward_px: Float[Array, "height width 2"],
        background: BackgroundView,
        dt_s: Float[Array, ""],
        focal_px: Float[Array, ""],
        objects: Int[Array, "height width"] | None = None,
    ) -> tuple[SegmentState, Labelling]:
        """The segments of the next frame, `dt_s` later. `valid` as from `on_surface`, `background` of this frame.

        Displacements are those of the last frame, 0 for new segments; `displaced` adds this frame's motion.
        Where no pixel had a label, as at the first frame, everything that is not static is cut into coarse blocks.
        Each of the given `objects` (`Frame.objects`) is one segment (see `given`), and no other has pixels of it.
        """
        rays, depth_m, backward_px = jax.lax.stop_gradient((rays, depth_m, backward_px))
        background, dt_s, focal_px = jax.lax.stop_gradient((background, dt_s, focal_px))
        height, width = depth_m.shape
        carried = carried_labels(
            state.labels, state.depth_m, depth_m, valid, backward_px, self.max_change_m(dt_s), state.dither_px
        )
        static = self._static(state, carried, background)
        side = jnp.clip(self.side_m * focal_px / jnp.maximum(depth_m, 1e-3), self.min_side_px, self.max_side_px)
        x, y = pixel_grid(height, width, depth_m.dtype)
        log_depth = jnp.log(jnp.where(depth_m > 0, depth_m, 1.0))
        feature = x, y, self.depth_weight * focal_px * log_depth

        foreground = valid & ~static
        first = ~jnp.any(state.labels >= 0)
        kept = jnp.where(static | (carried == STATIC), NO_LABEL, carried)
        slots = jnp.arange(self.num_segments)
        may_be_free, given = slots != STATIC, jnp.zeros((), jnp.int32)
        if objects is not None:
            side_px = self.start_side(height, width)
            given = given_slots(objects, self.num_segments, -(-height // side_px) * -(-width // side_px))
            foreground = foreground & (given < 0)
            kept = jnp.where((given >= 0) | (kept >= first_given(self.num_segments)), NO_LABEL, kept)
            may_be_free = may_be_free & (slots < first_given(self.num_segments))
        # The first frame's blocks are reassigned some rounds, later labels once: one loop is compiled for both.
        labels, reassigned_at = self._started(height, width, foreground)
        labels, reassigned_at = jnp.where(first, labels, kept), jnp.where(first, reassigned_at, side)
        labels = jax.lax.fori_loop(
            0,
            jnp.where(first, _START_ROUNDS, 1),
            lambda _, now: self._reassigned(now, feature, reassigned_at, foreground),
            labels,
        )
        one = jnp.ones_like(depth_m)
        (number,) = slot_sums([one], labels > 0, labels, self.num_segments)
        small = number < max(self.min_pixels, 1)
        free = small & may_be_free
        labels = jnp.where((labels > 0) & ~entries(small, jnp.maximum(labels, 0)), labels, NO_LABEL)

        hole = foreground & (labels < 0) & ~first
        labels, source, num_unplaced = self._born(labels, hole, side, carried, free)
        # Of the first frame's segments nothing is known of where they come from.
        source = jnp.where(first & ~free & (slots != STATIC), NO_LABEL, source)
        is_new = source > NOT_NEW
        follows = (labels == kept) | (entries(is_new, jnp.maximum(labels, 0)) & (carried >= 0))
        counted = (labels > 0) & follows
        labels = jnp.where(valid & static, STATIC, labels)
        if objects is not None:
            labels = jnp.where(given >= 0, given, labels)
            counted = jnp.where(given >= 0, valid & (given == carried), counted)
            (number,) = slot_sums([one], valid & (given >= 0), given, self.num_segments)
            source = sources_with_given(source, number > 0, state.area > 0)
            is_new = source > NOT_NEW

        points = [rays[..., axis] * depth_m for axis in range(3)]
        in_front = background.front.astype(depth_m.dtype)
        area, front, *summed = slot_sums([one, in_front, *points], valid & (labels >= 0), labels, self.num_segments)
        centre = jnp.stack(summed, axis=-1) / jnp.maximum(area, 1.0)[:, None]
        lives = (area > 0) & ~is_new
        after = SegmentState(
            labels=labels,
            dither_px=next_dither(state.dither_px),
            depth_m=depth_m,
            life_s=jnp.where(lives, state.life_s + dt_s, 0.0),
            displacement_m=jnp.where(lives[:, None], state.displacement_m, 0.0),
            moved=lives & state.moved,
            area=area,
            centre_m=centre,
        )
        return after, Labelling(counted, source, front / jnp.maximum(area, 1.0), num_unplaced)

    def displaced(
        self, state: SegmentState, motion_m: Float[Array, "segment 3"], source: Int[Array, " segment"]
    ) -> SegmentState:
        """The state with this frame's motion added to the displacements of the segments that are not new."""
        old = (state.area > 0) & (source == NOT_NEW)
        displacement = state.displacement_m + jnp.where(old[:, None], jax.lax.stop_gradient(motion_m), 0.0)
        moved = state.moved | (old & (safe_norm(displacement) > self.moved_m))
        return eqx.tree_at(lambda s: (s.displacement_m, s.moved), state, (displacement, moved))

    def _static(
        self, state: SegmentState, carried: Int[Array, "height width"], background: BackgroundView
    ) -> Bool[Array, "height width"]:
        """Pixels of the static background. A segment that has moved keeps its pixels where it pauses."""
        unlabelled = carried <= 0
        slot = jnp.maximum(carried, 0)
        moved = entries(state.moved, slot) & ~unlabelled
        older = background.age_s > jnp.where(unlabelled, 0.0, entries(state.life_s, slot))
        confirmed = background.confirmed & (unlabelled | ~background.matched | older | ~moved)
        return (
            confirmed
            | (background.matched & background.early & background.still & unlabelled)
            | (background.matched & background.ripe & background.still & ~moved)
        )

    def _started(
        self, height: int, width: int, foreground: Bool[Array, "height width"]
    ) -> tuple[Int[Array, "height width"], Float[Array, ""]]:
        """The first frame's labels before they are reassigned, blocks, and their side."""
        side_px = self.start_side(height, width)
        row, column = jnp.arange(height, dtype=jnp.int32) // side_px, jnp.arange(width, dtype=jnp.int32) // side_px
        block = row[:, None] * -(-width // side_px) + column[None] + 1
        return jnp.where(foreground, block, NO_LABEL), jnp.asarray(side_px, float)

    def _born(
        self,
        labels: Int[Array, "height width"],
        hole: Bool[Array, "height width"],
        side_px: Float[Array, "height width"],
        carried: Int[Array, "height width"],
        free: Bool[Array, " segment"],
    ) -> tuple[Int[Array, "height width"], Int[Array, " segment"], Int[Array, ""]]:
        """Labels with those of `births`, each slot's source, and the number of new segments without a slot."""

        def some() -> tuple[Array, Array, Array]:
            new, source, num_unplaced = births(
                hole, side_px, carried, free, min_side_px=self.min_side_px, min_pixels=self.min_pixels
            )
            return jnp.where(new > 0, new, labels), source, num_unplaced

        def none() -> tuple[Array, Array, Array]:
            return labels, jnp.full(free.shape, NOT_NEW, jnp.int32), jnp.zeros((), jnp.int32)

        # What a branch returns is computed once; XLA would compute the labels anew for each of their uses.
        return jax.lax.cond(jnp.any(hole), some, none)

    def _reassigned(
        self,
        labels: Int[Array, "height width"],
        feature: Feature,
        side_px: Float[Array, "height width"],
        foreground: Bool[Array, "height width"],
    ) -> Int[Array, "height width"]:
        """Each pixel goes to the nearest centre of the labels around it, at steps of its side; -1 beyond the reach."""
        height, width = labels.shape
        flat = labels.reshape(-1)
        count, *summed = slot_sums([jnp.ones_like(side_px), *feature], labels > 0, labels, self.num_segments)
        centre = [total / jnp.maximum(count, 1.0) for total in summed]

        step = jnp.round(side_px).astype(jnp.int32)
        row, column = jnp.arange(height, dtype=jnp.int32)[:, None], jnp.arange(width, dtype=jnp.int32)[None]
        best = jnp.full(labels.shape, self.reach, side_px.dtype)
        found = jnp.full(labels.shape, NO_LABEL, labels.dtype)
        for down in (0, -1, 1):
            for right in (0, -1, 1):
                y, x = row + down * step, column + right * step
                inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
                other = jnp.where(inside, entries(flat, jnp.where(inside, y * width + x, 0)), NO_LABEL)
                slot = jnp.maximum(other, 0)
                apart = [jnp.square(own - entries(table, slot)) for own, table in zip(feature, centre, strict=True)]
                away = (apart[0] + apart[1] + apart[2]) / jnp.square(side_px)
                away = jnp.where(other == labels, away - _STAY, away)
                better = (other > 0) & foreground & (away < best)
                best, found = jnp.where(better, away, best), jnp.where(better, other, found)
        return found
