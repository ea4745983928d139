"""Assignments: the optimum against brute force and SciPy, and the relaxation's limit, totals and gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment, linprog

from tagjax.core.assignment import hard_assignment, sinkhorn

RNG = np.random.default_rng(0)

# Compiled once a shape: run eagerly, each call would compile its loop anew.
compiled = jax.jit(sinkhorn, static_argnames=("num_iterations",))


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


def test_scores_that_are_no_scores_are_refused():
    for bad in (np.nan, np.inf):
        with pytest.raises(ValueError, match="NaN or"):
            hard_assignment(np.array([[bad, 1.0]]))
    for settings, message in (
        ({"temperature": 0.0, "num_iterations": 3}, "temperature is 0"),
        ({"temperature": 0.1, "num_iterations": 0}, "num_iterations is 0"),
    ):
        with pytest.raises(ValueError, match=message):
            sinkhorn(jnp.zeros((2, 2)), **settings)


def _clear_scores(shape, number, forbidden=0.0, unmatched_score=None):
    """Random scores whose best assignment leads the second by 0.1: at temperature T the second keeps exp(-0.1 / T)."""
    rng = np.random.default_rng(0)
    while number:
        score = np.where(rng.random(shape) < forbidden, -np.inf, rng.normal(size=shape))
        (pairs, total), (other_pairs, other) = _best_totals(score, unmatched_score)
        if pairs > other_pairs or total > other + 0.1:
            number -= 1
            yield score


@pytest.mark.parametrize("shape", [(4, 4), (3, 5), (5, 3)])
def test_a_cold_plan_is_scipys_assignment(shape):
    for score in _clear_scores(shape, 5):
        rows, columns = linear_sum_assignment(score, maximize=True)
        expected = np.zeros(shape)
        expected[rows, columns] = 1
        plan = compiled(jnp.asarray(score, jnp.float32), temperature=0.01, num_iterations=3000)
        np.testing.assert_allclose(plan.pairs, expected, atol=0.02)
        np.testing.assert_allclose(plan.unmatched_row, 1 - expected.sum(axis=1), atol=0.02)
        np.testing.assert_allclose(plan.unmatched_column, 1 - expected.sum(axis=0), atol=0.02)


@pytest.mark.parametrize("shape", [(4, 4), (3, 5), (5, 3)])
def test_a_cold_plan_leaves_alone_what_is_not_worth_a_pair(shape):
    alone = 0
    for score in _clear_scores(shape, 5, 0.2, 0.5):
        # The relaxation's own optimum at temperature 0, as a linear programme with nothing of ours in it.
        finite = np.where(np.isfinite(score), score - 0.5, -1e3)
        total = [np.kron(np.eye(shape[0]), np.ones(shape[1])), np.kron(np.ones(shape[0]), np.eye(shape[1]))]
        solved = linprog(-finite.reshape(-1), A_ub=np.concatenate(total), b_ub=np.ones(sum(shape)))
        expected = solved.x.reshape(shape)
        plan = compiled(jnp.asarray(score, jnp.float32), temperature=0.01, num_iterations=3000, unmatched_score=0.5)
        np.testing.assert_allclose(plan.pairs, expected, atol=0.02)
        chosen = hard_assignment(score, unmatched_score=0.5)
        np.testing.assert_array_equal(np.where(expected.any(axis=1), expected.argmax(axis=1), -1), chosen)
        alone += int((chosen < 0).sum())
    assert alone > 0


@pytest.mark.parametrize("unmatched_score", [None, 0.3])
@pytest.mark.parametrize("shape", [(4, 4), (3, 6), (6, 3)])
def test_totals_are_1_and_the_plan_has_the_form_of_the_optimum(shape, unmatched_score):
    score = RNG.normal(size=shape)
    score[0, 1] = -np.inf
    found = compiled(
        jnp.asarray(score, jnp.float32), temperature=0.5, num_iterations=400, unmatched_score=unmatched_score
    )
    pairs = np.asarray(found.pairs)
    np.testing.assert_allclose(pairs.sum(axis=1) + found.unmatched_row, 1.0, atol=1e-5)
    np.testing.assert_allclose(pairs.sum(axis=0) + found.unmatched_column, 1.0, atol=1e-4)
    assert pairs[0, 1] == 0
    if unmatched_score is None:
        np.testing.assert_allclose(np.asarray(found.unmatched_row).sum(), max(shape[0] - shape[1], 0), atol=1e-4)
    # log P - score / temperature is a sum of one number a row and one a column.
    rest = np.log(pairs[1:]) - score[1:] / 0.5
    np.testing.assert_allclose(rest - rest[:1] - rest[:, :1] + rest[0, 0], 0.0, atol=1e-4)


def test_rows_are_whole_after_a_single_iteration():
    found = sinkhorn(jnp.asarray(RNG.normal(size=(4, 3)), jnp.float32), temperature=0.05, num_iterations=1)
    np.testing.assert_allclose(np.asarray(found.pairs).sum(axis=1) + found.unmatched_row, 1.0, atol=1e-5)


@pytest.mark.parametrize("unmatched_score", [None, 0.1])
def test_padding_changes_nothing(unmatched_score):
    score = RNG.normal(size=(3, 4)).astype(np.float32)
    padded = np.pad(score, ((0, 2), (0, 3)), constant_values=-np.inf)
    settings = {"temperature": 0.3, "num_iterations": 500, "unmatched_score": unmatched_score}
    bare, held = compiled(jnp.asarray(score), **settings), compiled(jnp.asarray(padded), **settings)
    np.testing.assert_allclose(held.pairs[:3, :4], bare.pairs, atol=1e-5)
    assert float(jnp.abs(held.pairs[3:]).max()) == 0.0
    assert float(jnp.abs(held.pairs[:, 4:]).max()) == 0.0
    np.testing.assert_allclose(held.unmatched_row[3:], 0.0 if unmatched_score is None else 1.0, atol=1e-4)


@pytest.mark.parametrize("unmatched_score", [None, 0.1])
@pytest.mark.parametrize("case", ["masked", "masked row", "all masked", "empty", "extreme"])
def test_gradients_are_finite(case, unmatched_score):
    score = np.zeros((0, 3)) if case == "empty" else RNG.normal(size=(3, 4))
    if case == "masked":
        score[[0, 1], [1, 2]] = -np.inf
    elif case == "masked row":
        score[1] = -np.inf
    elif case == "all masked":
        score[:] = -np.inf
    elif case == "extreme":
        score *= 1e4

    def first(score, temperature):
        settings = {"temperature": temperature, "num_iterations": 50, "unmatched_score": unmatched_score}
        found = compiled(score, **settings)
        return jnp.sum(jnp.sin(found.pairs)) + jnp.sum(found.unmatched_row[:1]), found

    (_, found), gradient = jax.value_and_grad(first, argnums=(0, 1), has_aux=True)(
        jnp.asarray(score, jnp.float32), jnp.asarray(0.05)
    )
    for leaf in jax.tree.leaves((found, gradient)):
        assert bool(jnp.isfinite(leaf).all())
    assert float(jnp.abs(jnp.where(jnp.isfinite(jnp.asarray(score)), 0.0, gradient[0])).sum()) == 0.0
    if case == "masked":
        assert float(jnp.abs(gradient[0]).max()) > 1e-4


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("shape", [(3, 3), (2, 4)])
def test_gradients_agree_with_finite_differences(gradients_agree, shape, masked):
    score = np.random.default_rng(3).normal(size=shape)
    mask = np.zeros(shape, bool)
    mask[0, 1] = masked

    def all_shares(score, temperature, unmatched):
        given = jnp.where(jnp.asarray(mask), -jnp.inf, score)
        found = compiled(given, temperature=temperature, num_iterations=20, unmatched_score=unmatched)
        return jnp.concatenate([found.pairs.reshape(-1), found.unmatched_row, found.unmatched_column])

    gradients_agree(all_shares, (score, np.array(0.4), np.array(0.2)))
    gradients_agree(
        lambda s: compiled(jnp.where(jnp.asarray(mask), -jnp.inf, s), temperature=0.4, num_iterations=20).pairs,
        (score,),
    )


def test_jit_and_vmap_change_nothing():
    scores = RNG.normal(size=(3, 4, 5)).astype(np.float32)
    scores[1, 2] = -np.inf
    settings = {"temperature": 0.2, "num_iterations": 30, "unmatched_score": 0.0}
    together = jax.jit(jax.vmap(lambda s: sinkhorn(s, **settings)))(jnp.asarray(scores))
    for i, score in enumerate(scores):
        alone = sinkhorn(jnp.asarray(score), **settings)  # eagerly
        for one, other in zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(one[i], other, atol=1e-6)
