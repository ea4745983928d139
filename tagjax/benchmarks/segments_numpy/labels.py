"""Persistent segments as `tagattention.segments.labels` has them, on the pixels in front of the background only."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import carry, cells
from ...tagattention.segments import labels as original
from ...tagattention.segments.cells import NO_LABEL, NOT_NEW
from .background import View


@dataclasses.dataclass(frozen=True)
class Labelling:
    """Which pixels count for a segment's motion, and where new segments come from."""

    counted: Bool[np.ndarray, "height width"]
    source: Int[np.ndarray, " segment"]
    num_unplaced: int


class Labels:
    """The segments after a frame (see `SegmentState`); `step` takes the next frame."""

    def __init__(self, settings: original.Segmenter, height: int, width: int) -> None:
        self.settings, self.shape, num = settings, (height, width), settings.num_segments
        self.labels = np.full((height, width), NO_LABEL, np.int32)
        self.depth_m = np.zeros((height, width), np.float32)
        self.dither_px = np.zeros(2, np.float32)
        self.life_s, self.moved = np.zeros(num, np.float32), np.zeros(num, bool)
        self.displacement_m, self.centre_m = np.zeros((num, 3), np.float32), np.zeros((num, 3), np.float32)
        self.area = np.zeros(num, np.float32)
        self._x, self._y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))

    def max_change_m(self, dt_s: np.float32) -> np.float32:
        """A surface's depth changes by less than this in `dt_s`."""
        return np.float32(original._SAME_DEPTH_M) + np.float32(self.settings.max_speed_m_s) * dt_s

    def carried(
        self,
        depth_m: Float[np.ndarray, "height width"],
        valid: Bool[np.ndarray, "height width"],
        backward_px: Float[np.ndarray, "height width 2"],
        max_change_m: np.float32,
    ) -> Int[np.ndarray, "height width"]:
        """The label that the flow brings to each pixel from the same surface."""
        height, width = self.shape
        x, y = self._x + backward_px[..., 0], self._y + backward_px[..., 1]
        inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
        at_x = np.clip(np.rint(x + self.dither_px[0]), 0, width - 1)
        at_y = np.clip(np.rint(y + self.dither_px[1]), 0, height - 1)
        # Coordinates are whole: the nearest pixel is exact.
        before_m = cv2.remap(self.depth_m, at_x, at_y, cv2.INTER_NEAREST)
        label = cv2.remap(self.labels.astype(np.float32), at_x, at_y, cv2.INTER_NEAREST)
        same = valid & inside & (before_m > 0) & (np.abs(depth_m - before_m) < max_change_m)
        return np.where(same, label, np.float32(NO_LABEL)).astype(np.int32)

    def step(
        self,
        rays: tuple[np.ndarray, np.ndarray],
        depth_m: Float[np.ndarray, "height width"],
        valid: Bool[np.ndarray, "height width"],
        backward_px: Float[np.ndarray, "height width 2"],
        view: View,
        background_s: tuple[np.float32, np.float32],
        dt_s: np.float32,
        focal_px: np.float32,
    ) -> Labelling:
        """The segments of the next frame. `rays` are the maps of x and y; `background_s` its early and its confirming age."""
        s, (height, width) = self.settings, self.shape
        num, first = s.num_segments, not (self.labels >= 0).any()
        carried = self.carried(depth_m, valid, backward_px, self.max_change_m(dt_s))
        static = self._static(carried, view, background_s)
        foreground = valid & ~static
        kept = np.where(static | (carried == original.STATIC), NO_LABEL, carried)

        at = np.flatnonzero(foreground)
        depth = depth_m.ravel()[at]
        side = np.clip(
            np.float32(s.side_m) * focal_px / np.maximum(depth, np.float32(1e-3)), s.min_side_px, s.max_side_px
        )
        feature = (
            self._x.ravel()[at],
            self._y.ravel()[at],
            np.float32(s.depth_weight) * focal_px * np.log(np.where(depth > 0, depth, np.float32(1))),
        )
        if first:
            start = s.start_side(height, width)
            labels = np.full(height * width, NO_LABEL, np.int32)
            labels[at] = at // width // start * -(-width // start) + at % width // start + 1
            for _ in range(original._START_ROUNDS):
                labels = self._reassigned(labels, at, feature, np.full(at.shape, start, np.float32))
        else:
            labels = self._reassigned(kept.ravel(), at, feature, side)

        own = labels[at]
        small = np.bincount(own[own > 0], minlength=num) < s.min_pixels
        free = small.copy()
        free[original.STATIC] = False
        own = np.where((own > 0) & ~small[np.maximum(own, 0)], own, NO_LABEL)
        source, num_unplaced = np.full(num, NOT_NEW, np.int32), 0
        if first:
            source[1:][~free[1:]] = NO_LABEL
        else:
            hole = own < 0
            own[hole], source, num_unplaced = self._births(at[hole], side[hole], carried.ravel()[at[hole]], free)
        is_new = source > NOT_NEW
        follows = (own == kept.ravel()[at]) | (is_new[np.maximum(own, 0)] & (carried.ravel()[at] >= 0))
        counted = np.zeros(height * width, bool)
        counted[at] = (own > 0) & follows
        labels = np.where(valid & static, original.STATIC, NO_LABEL).astype(np.int32).ravel()
        labels[at] = own

        # Pixels without a label are counted in front of slot 0.
        shifted = labels + 1
        self.area = np.bincount(shifted, minlength=num + 1)[1:].astype(np.float32)
        z = depth_m.ravel()
        sums = [np.bincount(shifted, weight, num + 1)[1:] for weight in (rays[0].ravel() * z, rays[1].ravel() * z, z)]
        self.centre_m = (np.stack(sums, axis=-1) / np.maximum(self.area, 1)[:, None]).astype(np.float32)
        lives = (self.area > 0) & ~is_new
        self.life_s = np.where(lives, self.life_s + dt_s, np.float32(0))
        self.displacement_m[~lives] = 0
        self.moved &= lives
        self.labels, self.depth_m = labels.reshape(height, width), depth_m
        step = np.array(carry._DITHER_STEP, np.float32)
        self.dither_px = np.mod(self.dither_px + step + np.float32(0.5), np.float32(1)) - np.float32(0.5)
        return Labelling(counted.reshape(height, width), source, num_unplaced)

    def displaced(self, motion_m: Float[np.ndarray, "segment 3"], source: Int[np.ndarray, " segment"]) -> None:
        """Add this frame's motion to the displacements of the segments that are not new."""
        old = (self.area > 0) & (source == NOT_NEW)
        self.displacement_m += np.where(old[:, None], motion_m, np.float32(0))
        self.moved |= old & (np.sqrt(np.square(self.displacement_m).sum(axis=1)) > np.float32(self.settings.moved_m))

    def _static(
        self, carried: Int[np.ndarray, "height width"], view: View, background_s: tuple[np.float32, np.float32]
    ) -> Bool[np.ndarray, "height width"]:
        early_s, ripe_s = background_s
        unlabelled, slot = carried <= 0, np.maximum(carried, 0)
        moved = self.moved[slot] & ~unlabelled
        older = view.age_s > np.where(unlabelled, np.float32(0), self.life_s[slot])
        confirmed = view.confirmed & (unlabelled | ~view.matched | older | ~moved)
        resting = view.matched & view.still
        return (
            confirmed | (resting & unlabelled & (view.age_s >= early_s)) | (resting & ~moved & (view.age_s >= ripe_s))
        )

    def _reassigned(
        self,
        labels: Int[np.ndarray, " pixel"],
        at: Int[np.ndarray, " foreground"],
        feature: tuple[np.ndarray, np.ndarray, np.ndarray],
        side_px: Float[np.ndarray, " foreground"],
    ) -> Int[np.ndarray, " pixel"]:
        """The picture of labels in which each foreground pixel has the nearest centre of the labels around it."""
        (height, width), num = self.shape, self.settings.num_segments
        own = labels[at]
        member = own > 0
        slot = own[member]
        count = np.maximum(np.bincount(slot, minlength=num), 1)
        centre = [(np.bincount(slot, one[member], num) / count).astype(np.float32) for one in feature]
        step = np.rint(side_px).astype(np.int32)
        row, column = at // width, at % width
        best = np.full(at.shape, self.settings.reach, np.float32)
        found = np.full(at.shape, NO_LABEL, np.int32)
        square = np.square(side_px)
        for down in (0, -1, 1):
            for right in (0, -1, 1):
                y, x = row + down * step, column + right * step
                inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
                other = np.where(inside, labels[np.where(inside, y * width + x, 0)], NO_LABEL)
                near = np.maximum(other, 0)
                apart = sum(np.square(one - table[near]) for one, table in zip(feature, centre, strict=True))
                away = apart / square
                away = np.where(other == own, away - np.float32(original._STAY), away)
                better = (other > 0) & (away < best)
                np.copyto(best, away, where=better)
                np.copyto(found, other, where=better)
        out = np.full(labels.shape, NO_LABEL, np.int32)
        out[at] = found
        return out

    def _births(
        self,
        at: Int[np.ndarray, " hole"],
        side_px: Float[np.ndarray, " hole"],
        carried: Int[np.ndarray, " hole"],
        free: Bool[np.ndarray, " segment"],
    ) -> tuple[Int[np.ndarray, " hole"], Int[np.ndarray, " segment"], int]:
        """New segments for the pixels of holes; see `cells.births`."""
        s, (height, width) = self.settings, self.shape
        big, small = 2 * s.min_side_px, s.min_side_px
        rows, columns = -(-height // big), -(-width // big)
        y, x = at // width, at % width
        coarse_of, fine_of = y // big * columns + x // big, y // small * (2 * columns) + x // small
        total = np.bincount(coarse_of, minlength=rows * columns)
        number = np.bincount(fine_of, minlength=4 * rows * columns)
        side = np.bincount(coarse_of, side_px, rows * columns) / np.maximum(total, 1)
        coarse = side >= cells._COARSE_FROM * small
        fine = np.arange(4 * rows * columns)
        parent = fine // (2 * columns) // 2 * columns + fine % (2 * columns) // 2
        taken = np.concatenate([coarse & (total > s.min_pixels), ~coarse[parent] & (number > s.min_pixels)])
        slots, where = np.flatnonzero(free), np.flatnonzero(taken)
        placed = where[: len(slots)]
        slot = np.full(len(taken), NO_LABEL, np.int32)
        slot[placed] = slots[: len(placed)]

        common, votes, cell = _most_common(fine_of, carried, np.ones(len(at), np.int64))
        common_coarse, _, cell_coarse = _most_common(parent[cell], common, votes)
        cause = np.full(len(taken), NO_LABEL, np.int32)
        cause[cell_coarse], cause[len(coarse) + cell] = common_coarse, common
        source = np.full(len(free), NOT_NEW, np.int32)
        source[slot[placed]] = cause[placed]
        picture = np.where(coarse[coarse_of], slot[coarse_of], slot[len(coarse) + fine_of])
        return picture, source, len(where) - len(placed)


def _most_common(
    group: Int[np.ndarray, " member"], label: Int[np.ndarray, " member"], weight: Int[np.ndarray, " member"]
) -> tuple[Int[np.ndarray, " group"], Int[np.ndarray, " group"], Int[np.ndarray, " group"]]:
    """The label of largest summed weight in each group, of equals the smallest; that weight; and the groups, rising."""
    most = np.int64(1) << 20
    pairs, inverse = np.unique(group * most + (label + 1), return_inverse=True)
    votes = np.bincount(inverse, weight, len(pairs)).astype(np.int64)
    groups, labels = pairs // most, pairs % most - 1
    order = np.lexsort((labels, -votes, groups))
    groups, labels, votes = groups[order], labels[order], votes[order]
    first = np.flatnonzero(np.diff(groups, prepend=-1))
    return labels[first].astype(np.int32), votes[first], groups[first]
