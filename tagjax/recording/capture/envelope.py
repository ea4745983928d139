"""The line under the delays of one clock against another: offset and drift of a clock from times of arrival, with intervals.

What is on the way is late by its latency at least. The delays of a busy host have a heavy tail: reads wait for milliseconds,
or for a second, and come in bursts. Neither a mean nor a median of them shows the clock; the smallest ones do. Time is cut into
groups, so that a burst counts once, and the smallest delay of each group lies above the line by a Lomax variable, whose density
is largest at zero and falls off slowly: a group that never came in time has little weight.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..importers.clock import MAX_DRIFT_PPM

_PRIOR_PPM = 200.0  # a quartz drifts by less; it decides only where the delays do not
_MAX_GROUPS, _MIN_GROUP_SAMPLES = 60, 5
_SCALES_S = 1e-9 * 4.0 ** np.arange(14)  # of the delays, 1 ns to 67 ms
_NUM_SLOPES, _NUM_LEVELS = 61, 24
_REFINEMENTS, _REACH = 7, 6.0  # spreads to each side


@dataclasses.dataclass(frozen=True)
class Envelope:
    """delay = level + slope * time, at the smallest latency: estimates with the ends of 95 % intervals."""

    slope: float
    slope_interval: tuple[float, ...]  # both ends
    level_s: float  # at time 0
    level_interval_s: tuple[float, ...]
    excess_s: float  # of the groups' smallest delays above the line, the lower quartile


def envelope(since_s: np.ndarray, delay_s: np.ndarray) -> Envelope:
    """The line under the delays of at least one sample. `since_s` counts from the middle of the samples."""
    x, y = _smallest_of_groups(since_s, delay_s)
    middle = float(np.mean(x))
    x = x - middle
    slopes = np.linspace(-1e-6 * MAX_DRIFT_PPM, 1e-6 * MAX_DRIFT_PPM, _NUM_SLOPES)
    weight, level = _posterior(x, y, slopes)
    for _ in range(_REFINEMENTS):  # the grid closes in on the slopes that are likely
        mean, spread = _mean_and_spread(slopes, weight)
        slopes = np.linspace(
            max(slopes[0], mean - _REACH * spread), min(slopes[-1], mean + _REACH * spread), _NUM_SLOPES
        )
        weight, level = _posterior(x, y, slopes)
    mean, _ = _mean_and_spread(slopes, weight)
    at_zero = level - slopes[:, None, None] * middle
    low_s, middle_s, high_s = _quantiles(at_zero.ravel(), weight.ravel(), (0.025, 0.5, 0.975))
    # The line is above no sample: for the mean slope, a level may be by a little.
    level_s = middle_s + min(0.0, float(np.min(delay_s - middle_s - mean * since_s)))
    return Envelope(
        slope=mean,
        slope_interval=_quantiles(slopes, weight.sum(axis=(1, 2)), (0.025, 0.975)),
        level_s=level_s,
        level_interval_s=(low_s, high_s),
        excess_s=float(np.quantile(y - level_s - mean * (x + middle), 0.25)),
    )


def _smallest_of_groups(since_s: np.ndarray, delay_s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Time and delay of the sample with the smallest delay, in each of several groups of consecutive samples."""
    count = int(np.clip(len(since_s) // _MIN_GROUP_SAMPLES, 1, _MAX_GROUPS))
    rows = [group[np.argmin(delay_s[group])] for group in np.array_split(np.arange(len(since_s)), count)]
    return since_s[rows], delay_s[rows]


def _posterior(x: np.ndarray, y: np.ndarray, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weights over (slope, level below the touching one, scale), which sum to 1, and the levels."""
    above = y - slopes[:, None] * x  # (slopes, groups)
    touching = above.min(axis=1)
    below = np.concatenate([[0.0], np.geomspace(1e-10, 0.1, _NUM_LEVELS - 1)])
    width = np.gradient(below)
    excess = (above - touching[:, None])[:, None, :] + below[None, :, None]  # (slopes, levels, groups)
    log_weight = np.empty((len(slopes), len(below), len(_SCALES_S)))
    for number, scale_s in enumerate(_SCALES_S):
        # Lomax of shape 1: density 1 / scale / (1 + r / scale)^2
        log_weight[..., number] = -2 * np.log1p(excess / scale_s).sum(axis=-1) - len(x) * np.log(scale_s)
    log_weight += np.log(width)[None, :, None] - 0.5 * (1e6 * slopes / _PRIOR_PPM)[:, None, None] ** 2
    weight = np.exp(log_weight - log_weight.max())
    level = touching[:, None, None] - below[None, :, None] + 0 * weight
    return weight / weight.sum(), level


def _mean_and_spread(slopes: np.ndarray, weight: np.ndarray) -> tuple[float, float]:
    mass = weight.sum(axis=(1, 2))
    mean = float(mass @ slopes)
    return mean, float(np.sqrt(mass @ (slopes - mean) ** 2)) + 0.5 * float(slopes[1] - slopes[0])


def _quantiles(values: np.ndarray, weight: np.ndarray, at: Sequence[float]) -> tuple[float, ...]:
    """Quantiles of values with weights that sum to 1."""
    order = np.argsort(values)
    place = np.searchsorted(np.cumsum(weight[order]), at)
    return tuple(values[order][np.minimum(place, len(order) - 1)].tolist())
