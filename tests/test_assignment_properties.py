"""Properties of the one-to-one assignment, of any scores with ties and forbidden pairs, against brute force."""

import itertools

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from tagjax.core.assignment import hard_assignment

SHAPES = array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=4)
# Few different values, so that ties are common.
VALUES = st.one_of(st.integers(-4, 4).map(float), st.floats(-1e3, 1e3), st.just(-np.inf))
SCORES = SHAPES.flatmap(lambda shape: arrays(np.float64, shape, elements=VALUES))
UNMATCHED = st.one_of(st.none(), st.integers(-5, 5).map(float), st.floats(-1e3, 1e3))


def all_assignments(score):
    """Every one-to-one assignment of allowed pairs: the pairs made and the values of their scores."""
    num_rows, num_columns = score.shape
    for chosen in itertools.product(range(-1, num_columns), repeat=num_rows):
        used = [column for column in chosen if column >= 0]
        values = [score[row, column] for row, column in enumerate(chosen) if column >= 0]
        if len(set(used)) == len(used) and np.isfinite(values).all():
            yield values


def worth(values, unmatched_score) -> tuple[float, float]:
    """What is maximised: with an unmatched score the sum over it, without one first the number of pairs."""
    if unmatched_score is None:
        return len(values), float(np.sum(values))
    return 0.0, float(np.sum(np.asarray(values) - unmatched_score))


@example(np.array([[9.0, 0.0], [8.0, -np.inf]]), None)  # one pair of 9, or two of 8 together
@given(SCORES, UNMATCHED)
def test_no_assignment_is_better_than_the_chosen_one(score, unmatched_score):
    chosen = hard_assignment(score, unmatched_score=unmatched_score)
    used = chosen[chosen >= 0]
    assert chosen.shape == (score.shape[0],)
    assert len(set(used.tolist())) == len(used)
    values = score[np.flatnonzero(chosen >= 0), used]
    assert np.isfinite(values).all()  # no forbidden pair
    num_pairs, total = worth(values, unmatched_score)
    best_pairs, best = max(worth(values, unmatched_score) for values in all_assignments(score))
    assert num_pairs == best_pairs
    np.testing.assert_allclose(total, best, atol=1e-8)


@given(SCORES, UNMATCHED, st.randoms(use_true_random=False))
def test_the_order_of_rows_and_columns_does_not_matter(score, unmatched_score, random):
    rows, columns = list(range(score.shape[0])), list(range(score.shape[1]))
    random.shuffle(rows)
    random.shuffle(columns)
    shuffled = score[rows][:, columns]
    results = []
    for table in (score, shuffled, score.T):
        chosen = hard_assignment(table, unmatched_score=unmatched_score)
        matched = chosen >= 0
        results.append(worth(table[np.flatnonzero(matched), chosen[matched]], unmatched_score))
    for other in results[1:]:
        np.testing.assert_allclose(other, results[0], atol=1e-8)


@given(SCORES, st.floats(-100.0, 100.0))
def test_a_constant_added_to_scores_and_unmatched_score_changes_nothing_that_counts(score, constant):
    plain = hard_assignment(score, unmatched_score=0.5)
    moved = hard_assignment(score + constant, unmatched_score=0.5 + constant)
    totals = [worth(score[np.flatnonzero(one >= 0), one[one >= 0]], 0.5)[1] for one in (plain, moved)]
    np.testing.assert_allclose(totals[1], totals[0], atol=1e-8)
