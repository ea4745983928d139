"""One-to-one assignment of tags to objects with the highest total score."""

from __future__ import annotations

import numpy as np
import scipy  # `scipy.optimize` is imported at its first use: it takes a quarter of a second
from jaxtyping import Float, Integer


def hard_assignment(
    score: Float[np.ndarray, "rows columns"], *, unmatched_score: float | None = None
) -> Integer[np.ndarray, " rows"]:
    """The column of each row in the one-to-one assignment of highest total score; -1 for an unassigned row.

    Computed on the host by SciPy's `linear_sum_assignment`. A pair of score -inf is forbidden. With `unmatched_score`
    the sum of (score - unmatched_score) over the assigned pairs is maximised, so that a pair of a lower score stays
    unassigned; without it the number of pairs is maximised first. Raises `ValueError` for NaN and +inf.
    """
    score = np.asarray(score, np.float64)
    if np.isnan(score).any() or np.isposinf(score).any():
        raise ValueError("The scores contain NaN or +inf; expected finite scores, or -inf for a forbidden pair.")
    allowed = np.isfinite(score)
    if unmatched_score is None:
        # One more allowed pair outweighs any gain in the scores of the others.
        lowest, highest = score.min(where=allowed, initial=0.0), score.max(where=allowed, initial=0.0)
        value = np.where(allowed, score, lowest - (highest - lowest + 1.0) * (min(score.shape) + 1))
    else:
        allowed &= score > unmatched_score
        value = np.where(allowed, score - unmatched_score, 0.0)
    rows, columns = scipy.optimize.linear_sum_assignment(value, maximize=True)
    chosen = np.full(score.shape[0], -1)
    chosen[rows] = np.where(allowed[rows, columns], columns, -1)
    return chosen
