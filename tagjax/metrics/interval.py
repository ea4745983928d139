"""Means over frames with confidence intervals by recording: a bootstrap that resamples whole recordings."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
import scipy  # its submodules are imported at their first use: `stats` alone takes most of a second
from jaxtyping import Float, Int

from .mean import MaskedMean

LEVEL = 0.95
NUM_RESAMPLES = 2000
SEED = 0


@dataclasses.dataclass(frozen=True)
class Estimate:
    """A mean over the frames (or tags) of all recordings. None stands for an undefined value."""

    value: float | None
    low: float | None  # bounds of the interval; None with fewer than two recordings that have such a frame
    high: float | None
    total: float
    count: int
    num_recordings: int  # that have such a frame


def ratio_estimate(totals: Float[np.ndarray, " recording"], counts: Int[np.ndarray, " recording"]) -> Estimate:
    """sum(totals) / sum(counts), one element per recording, with its percentile bootstrap interval.

    The interval covers the central 95 % of the values of 2,000 resamples of the recordings with replacement. The seed is
    fixed, so the same recordings always give the same interval. Recordings with a count of 0 are left out.
    """
    total, count = totals[counts > 0], counts[counts > 0]
    if not len(count):
        return Estimate(None, None, None, 0.0, 0, 0)
    value, low, high = float(total.sum() / count.sum()), None, None
    if len(count) > 1:
        drawn = scipy.stats.bootstrap(
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


def estimates(recordings: Sequence[Mapping[str, MaskedMean]]) -> dict[str, Estimate]:
    """`ratio_estimate` of each named mean, from the means of each recording."""
    names = dict.fromkeys(name for means in recordings for name in means)
    none = MaskedMean()
    return {
        name: ratio_estimate(
            np.array([means.get(name, none).total for means in recordings], np.float64),
            np.array([means.get(name, none).count for means in recordings], np.int64),
        )
        for name in names
    }
