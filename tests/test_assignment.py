"""One-to-one assignment against brute force."""

import itertools

import numpy as np
import pytest

from tagjax.core.assignment import hard_assignment

RNG = np.random.default_rng(0)


def _best_totals(score, unmatched_score):
    """The two best of all assignments: most pairs first, then total (or just surplus over the unmatched score)."""
    num_rows, num_columns = score.shape
    found = [(-1, -np.inf)]
    for choice in itertools.product(range(-1, num_columns), repeat=num_rows):
        used = [c for c in choice if c >= 0]
        values = [score[r, c] for r, c in enumerate(choice) if c >= 0]
        if len(set(used)) < len(used) or not np.isfinite(values).all():
            continue
        if unmatched_score is None:
            found.append((len(used), sum(values)))
        else:
            found.append((0, sum(v - unmatched_score for v in values)))
    return sorted(found, reverse=True)[:2]


@pytest.mark.parametrize("shape", [(3, 3), (2, 4), (4, 2), (1, 3)])
@pytest.mark.parametrize("unmatched_score", [None, 0.2])
@pytest.mark.parametrize("forbidden", [0.0, 0.4])
def test_the_hard_assignment_is_the_best_of_all(shape, unmatched_score, forbidden):
    for _ in range(10):
        score = RNG.normal(size=shape)
        score[RNG.random(shape) < forbidden] = -np.inf
        chosen = hard_assignment(score, unmatched_score=unmatched_score)
        used = chosen[chosen >= 0]
        assert len(set(used)) == len(used)
        values = score[np.flatnonzero(chosen >= 0), used]
        pairs, total = _best_totals(score, unmatched_score)[0]
        if unmatched_score is None:
            assert len(used) == pairs
            np.testing.assert_allclose(values.sum(), total, atol=1e-12)
        else:
            np.testing.assert_allclose((values - unmatched_score).sum(), total, atol=1e-12)
            assert np.all(values > unmatched_score)


def test_nan_and_infinite_scores_are_refused():
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="NaN or"):
            hard_assignment(np.array([[bad, 1.0]]))
