"""Scores against the frames since each tag's first motion: means over recordings, with their bands."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from .interval import LEVEL, NUM_RESAMPLES, SEED
from .tags import FrameScores


@dataclasses.dataclass(frozen=True)
class Curve:
    """A score by frames since the first motion; NaN where no tag counts."""

    mean: Float[np.ndarray, " frame"]
    low: Float[
        np.ndarray, " frame"
    ]  # bounds of the 95 % interval of the mean by recording; NaN with a single recording
    high: Float[np.ndarray, " frame"]
    num_tags: Int[np.ndarray, " frame"]  # that count at this frame


def motion_curves(recordings: Sequence[Mapping[str, FrameScores]]) -> dict[str, Curve]:
    """Curves of `iou` (0 without a detection), `cle_px` (over detections) and `identification` of recordings' tags by EPC.

    The band covers the central 95 % of the means of 2,000 resamples of the recordings with replacement.
    """
    length = max((1 + int(tag.since_motion[-1]) for tags in recordings for tag in tags.values()), default=0)
    length = max(length, 0)
    sums = {name: np.zeros((2, len(recordings), length)) for name in ("iou", "cle_px", "identification")}
    for number, tags in enumerate(recordings):
        for tag in tags.values():
            identified = (tag.detected & (tag.identified == tag.label)).astype(np.float64)
            error = np.where(tag.detected, tag.cle_px, np.nan)
            for name, values in (("iou", tag.box_iou), ("cle_px", error), ("identification", identified)):
                kept = tag.valid & np.isfinite(values)
                at = tag.since_motion[kept]
                sums[name][0, number, at] += values[kept]
                sums[name][1, number, at] += 1
    return {name: _curve(totals, counts) for name, (totals, counts) in sums.items()}


def _curve(totals: np.ndarray, counts: np.ndarray) -> Curve:
    """The mean and its band; totals and counts are (recording, frame)."""
    num = len(totals)
    mean = _ratio(totals.sum(axis=0), counts.sum(axis=0))
    low = high = np.full_like(mean, np.nan)
    if num > 1 and mean.size:
        drawn = np.random.default_rng(SEED).multinomial(num, np.full(num, 1 / num), size=NUM_RESAMPLES)
        resampled = _ratio(drawn @ totals, drawn @ counts)
        some = np.isfinite(resampled).any(axis=0)
        low, high = low.copy(), high.copy()
        if some.any():
            low[some], high[some] = np.nanquantile(resampled[:, some], [0.5 * (1 - LEVEL), 0.5 * (1 + LEVEL)], axis=0)
    return Curve(mean, low, high, counts.sum(axis=0).astype(np.int64))


def _ratio(totals: np.ndarray, counts: np.ndarray) -> np.ndarray:
    return np.divide(totals, counts, out=np.full(totals.shape, np.nan), where=counts > 0)
