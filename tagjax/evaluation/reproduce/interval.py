"""Means over frames with confidence intervals by recording: recordings are drawn anew, frames of one belong together."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int
from scipy import stats

LEVEL = 0.95
NUM_RESAMPLES = 2000
SEED = 0


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A mean over the frames (or tags) of all recordings. None is what cannot be said."""

    value: float | None
    low: float | None  # ends of the interval: None with fewer than two recordings that have such a frame
    high: float | None
    total: float
    count: int
    num_recordings: int  # that have such a frame


def ratio_estimate(totals: Float[np.ndarray, " recording"], counts: Int[np.ndarray, " recording"]) -> Estimate:
    """sum(totals) / sum(counts), one element a recording, with its percentile bootstrap interval.

    The interval holds the middle 95 % of the values that 2,000 draws of as many recordings, with replacement, give. Always
    the same draws: the same recordings have the same interval. Recordings with a count of 0 are left out.
    """
    total, count = totals[counts > 0], counts[counts > 0]
    if not len(count):
        return Estimate(None, None, None, 0.0, 0, 0)
    value, low, high = float(total.sum() / count.sum()), None, None
    if len(count) > 1:
        drawn = stats.bootstrap(
            (total, count),
            lambda total, count, axis=-1: total.sum(axis=axis) / count.sum(axis=axis),
            n_resamples=NUM_RESAMPLES,
            confidence_level=LEVEL,
            method="percentile",
            paired=True,
            vectorized=True,
            rng=np.random.default_rng(SEED),
        )
        low, high = (float(end) for end in drawn.confidence_interval)
    return Estimate(value, low, high, float(total.sum()), int(count.sum()), len(count))
