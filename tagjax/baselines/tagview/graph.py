"""The bipartite graph of traces and tags: matching, pruning, incompatible edges (Tagview, V.A-B, V.D)."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import median_abs_deviation

from ...core.assignment import hard_assignment

SpreadEstimator = Literal["std", "mad"]

MAX_SLOPE_PENALTY_NATS = 8.0
"""Largest penalty of a slope: a fraction e^-8 of the traces may have wrongly unwrapped phases."""


@dataclasses.dataclass(frozen=True)
class Coefficient:
    """The linear coefficient shared by all matching pairs (Observation V.1), and its spread."""

    mean: float
    spread: float


def match_graph(weight: Float[np.ndarray, "traces tags"]) -> Int[np.ndarray, " traces"]:
    """Tag of each trace in the one-to-one matching of highest total weight (Hungarian, V.A); -1 for none.

    Pairs of weight 0 or less are not matched.
    """
    return hard_assignment(np.asarray(weight, np.float64), unmatched_score=0.0)


def likelihood_weight(
    r_squared: Float[np.ndarray, "traces tags"], independent: Float[np.ndarray, "traces tags"]
) -> Float[np.ndarray, "traces tags"]:
    """Log likelihood ratio of the line against a constant, nats, for n independent samples: -n/2 log(1 - R^2).

    Noise and line are maximised for Gaussian errors, as in the paper's least squares. R^2 is scaled by 0.99, since the
    model holds approximately only. Ours: R^2 itself does not depend on the length of the observation.
    """
    return -0.5 * independent * np.log1p(-0.99 * r_squared)


def shared_coefficient(
    slope: Float[np.ndarray, "traces tags"],
    tag_of: Int[np.ndarray, " traces"],
    *,
    estimator: SpreadEstimator,
    min_relative_spread: float,
    weight: Float[np.ndarray, "traces tags"] | None = None,
) -> Coefficient | None:
    """Mean and standard deviation of the matched pairs' slopes (V.B), weighted if `weight` is given; None without a
    match.

    `mad` takes the median and 1.48 times the median absolute deviation, which single wrong matches do not affect. The
    spread is at least `min_relative_spread` of the mean: two slopes that agree by chance would prune all others.
    """
    rows = np.flatnonzero(tag_of >= 0)
    if not len(rows):
        return None
    values = np.asarray(slope, np.float64)[rows, tag_of[rows]]
    if estimator == "std":
        weights = None if weight is None else weight[rows, tag_of[rows]]
        mean = float(np.average(values, weights=weights))
        spread = float(np.sqrt(np.average(np.square(values - mean), weights=weights)))
    else:
        mean = float(np.median(values))
        spread = float(median_abs_deviation(values, scale="normal"))  # pyright: ignore[reportArgumentType]
    return Coefficient(mean, max(spread, min_relative_spread * abs(mean), 1e-9))


def keep_edges(
    slope: Float[np.ndarray, "traces tags"], shared: Coefficient | None, max_z_score: float
) -> Bool[np.ndarray, "traces tags"]:
    """Edges whose absolute z-score is at most `max_z_score`.

    Eq. 8 as printed has no absolute value, which would keep slopes far below the mean, although by Observation V.1 all
    matching pairs have the same one.
    """
    if shared is None:
        return np.zeros(slope.shape, bool)
    return np.abs(np.asarray(slope, np.float64) - shared.mean) <= max_z_score * shared.spread


def slope_log_odds(
    slope: Float[np.ndarray, "traces tags"], shared: Coefficient, log_slope_std: float
) -> Float[np.ndarray, "traces tags"]:
    """Log likelihood of a pair's slope, nats: -(log(slope / shared) / std)^2 / 2, at least -`MAX_SLOPE_PENALTY_NATS`.

    It expresses Observation V.1, that matching pairs share one coefficient, as a likelihood in place of the pruning of
    Eq. 8. Ours: where slopes of short traces scatter, the z-score accepts half the shared slope as readily as the
    shared one. A slope that is not positive is an outlier.
    """
    ratio = np.maximum(np.asarray(slope, np.float64) / max(shared.mean, 1e-9), 1e-6)
    return np.maximum(-0.5 * np.square(np.log(ratio) / log_slope_std), -MAX_SLOPE_PENALTY_NATS)


def cliques(
    trace: Int[np.ndarray, " edges"],
    tag: Int[np.ndarray, " edges"],
    span_s: Float[np.ndarray, "traces 2"],
    *,
    tolerance_s: float,
) -> list[Int[np.ndarray, " _"]]:
    """Rows of the compatibility matrix P (V.D): sets of edges of which at most one may be selected.

    There is one for every trace with several edges, and for every tag the maximal sets of its traces that overlap in
    time, since an object is at one position at a time. Overlaps of `tolerance_s` or less are allowed.
    """
    found = [np.flatnonzero(trace == number) for number in np.unique(trace)]
    for number in np.unique(tag):
        own = np.flatnonzero(tag == number)
        begin, end = span_s[trace[own], 0], span_s[trace[own], 1] - tolerance_s
        # Intervals that overlap pairwise share a time, the latest of their starts.
        overlapping = [frozenset(own[(begin <= at) & ((end > at) | (begin == at))].tolist()) for at in begin]
        largest = {one for one in overlapping if not any(one < other for other in overlapping)}
        found += [np.array(sorted(one)) for one in sorted(largest, key=sorted)]
    return [one for one in found if len(one) > 1]


def edge_agreement(
    agreement: Float[np.ndarray, "traces traces tags tags"],
    trace: Int[np.ndarray, " edges"],
    tag: Int[np.ndarray, " edges"],
    num_shared: Float[np.ndarray, "traces traces tags tags"] | None = None,
) -> Float[np.ndarray, "edges edges"]:
    """Q of Eq. 10: the agreement of every two edges; 0 of an edge with itself.

    With `num_shared`, the number of times at which two traces were seen and two tags' RSSI known, it is the agreement
    above or below 1/2, times that number.
    """
    edges = trace[:, None], trace[None, :], tag[:, None], tag[None, :]
    quadratic = np.asarray(agreement, np.float64)[edges].copy()
    if num_shared is not None:
        quadratic = (quadratic - 0.5) * num_shared[edges]
    np.fill_diagonal(quadratic, 0.0)
    return quadratic
