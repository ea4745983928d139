"""The bipartite graph of traces and tags: matching, pruning, what may not go together (Tagview, V.A-B, V.D)."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from ...core.assignment import hard_assignment

Spread = Literal["std", "mad"]

SLOPE_OUTLIER_NATS = 8.0
"""What a slope costs at most that no spread explains: a phase may be wrongly spliced, by e^-8 of the traces."""


@dataclasses.dataclass(frozen=True)
class Coefficient:
    """The linear coefficient that right pairs share (Observation V.1), and how far they spread around it."""

    mean: float
    spread: float


def match_graph(weight: Float[np.ndarray, "traces tags"]) -> Int[np.ndarray, " traces"]:
    """Tag of each trace in the one-to-one matching of highest total weight (Hungarian, V.A); -1 for none.

    Pairs of weight 0 or less are not made: a sequence that explains nothing names nothing.
    """
    return hard_assignment(np.asarray(weight, np.float64), unmatched_score=0.0)


def likelihood_weight(
    r_squared: Float[np.ndarray, "traces tags"], independent: Float[np.ndarray, "traces tags"]
) -> Float[np.ndarray, "traces tags"]:
    """Log likelihood ratio of the line against a constant, in nats, by so many independent samples: -n/2 log(1 - R^2).

    Noise and line profiled out of Gaussian errors, as in the paper's least squares. R^2 counts as 0.99 at most of itself:
    the line is the truth's only so far. Ours: R^2 itself says as much of half a second as of a minute.
    """
    return -0.5 * independent * np.log1p(-0.99 * r_squared)


def shared_coefficient(
    slope: Float[np.ndarray, "traces tags"],
    tag_of: Int[np.ndarray, " traces"],
    *,
    spread: Spread,
    least_share: float,
    weight: Float[np.ndarray, "traces tags"] | None = None,
) -> Coefficient | None:
    """Mean and standard deviation of the matched pairs' slopes (V.B), weighed if asked for; None where nothing is matched.

    `mad` takes the median and 1.48 times the median distance from it, which single wrong matches do not move. The
    spread is at least `least_share` of the mean: two slopes that happen to agree would cut off everything else.
    """
    rows = np.flatnonzero(tag_of >= 0)
    if not len(rows):
        return None
    values = np.asarray(slope, np.float64)[rows, tag_of[rows]]
    if spread == "std":
        share = None if weight is None else weight[rows, tag_of[rows]]
        middle = float(np.average(values, weights=share))
        width = float(np.sqrt(np.average(np.square(values - middle), weights=share)))
    else:
        middle = float(np.median(values))
        width = 1.4826 * float(np.median(np.abs(values - middle)))
    return Coefficient(middle, max(width, least_share * abs(middle), 1e-9))


def keep_edges(
    slope: Float[np.ndarray, "traces tags"], shared: Coefficient | None, threshold: float
) -> Bool[np.ndarray, "traces tags"]:
    """Edges whose z-score is at most `threshold` either way.

    Eq. 8 as printed has no modulus, so that a slope far below the mean would stay, although Observation V.1 says that
    all right pairs have the same one.
    """
    if shared is None:
        return np.zeros(slope.shape, bool)
    return np.abs(np.asarray(slope, np.float64) - shared.mean) <= threshold * shared.spread


def slope_log_odds(
    slope: Float[np.ndarray, "traces tags"], shared: Coefficient, spread: float
) -> Float[np.ndarray, "traces tags"]:
    """How far a pair's slope speaks for it, in nats: -(log(slope / shared) / spread)^2 / 2, `SLOPE_OUTLIER_NATS` at worst.

    Observation V.1, that right pairs share one coefficient, as a likelihood where Eq. 8 prunes. Ours: on the z-score
    a slope of half the shared one is as good as the shared one's own, if short traces scatter. A slope that is not
    positive is an outlier's; errors of a product are even in its logarithm.
    """
    ratio = np.maximum(np.asarray(slope, np.float64) / max(shared.mean, 1e-9), 1e-6)
    return np.maximum(-0.5 * np.square(np.log(ratio) / spread), -SLOPE_OUTLIER_NATS)


def cliques(
    trace: Int[np.ndarray, " edges"],
    tag: Int[np.ndarray, " edges"],
    span_s: Float[np.ndarray, "traces 2"],
    *,
    tolerance_s: float,
) -> list[Int[np.ndarray, " _"]]:
    """Rows of the compatibility matrix P (V.D): sets of edges of which at most one may be selected.

    One for every trace with several edges; and for every tag the largest sets of its traces that overlap in time, as a
    thing is in one place at a time. Overlaps of `tolerance_s` or less do not count.
    """
    found = [np.flatnonzero(trace == number) for number in np.unique(trace)]
    for number in np.unique(tag):
        own = np.flatnonzero(tag == number)
        begin, end = span_s[trace[own], 0], span_s[trace[own], 1] - tolerance_s
        # Intervals that overlap pairwise share a moment, the latest of their beginnings.
        together = [frozenset(own[(begin <= at) & ((end > at) | (begin == at))].tolist()) for at in begin]
        largest = {one for one in together if not any(one < other for other in together)}
        found += [np.array(sorted(one)) for one in sorted(largest, key=sorted)]
    return [one for one in found if len(one) > 1]


def edge_agreement(
    agreement: Float[np.ndarray, "traces traces tags tags"],
    trace: Int[np.ndarray, " edges"],
    tag: Int[np.ndarray, " edges"],
    together: Float[np.ndarray, "traces traces tags tags"] | None = None,
) -> Float[np.ndarray, "edges edges"]:
    """Q of Eq. 10: the agreement of every two edges; 0 of an edge with itself, which says nothing.

    With `together`, how often two traces were seen and two tags' strengths known at once, it is what agreement is above or
    below even odds, so many times.
    """
    edges = trace[:, None], trace[None, :], tag[:, None], tag[None, :]
    quadratic = np.asarray(agreement, np.float64)[edges].copy()
    if together is not None:
        quadratic = (quadratic - 0.5) * together[edges]
    np.fill_diagonal(quadratic, 0.0)
    return quadratic
