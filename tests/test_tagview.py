"""Tagview's scoring: splicing, interpolation, lines, agreement, graph, programme, whole identification."""

from __future__ import annotations

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.stats import norm

from tagjax.baselines.tagview.graph import (
    MAX_SLOPE_PENALTY_NATS,
    Coefficient,
    cliques,
    edge_agreement,
    keep_edges,
    likelihood_weight,
    match_graph,
    shared_coefficient,
    slope_log_odds,
)
from tagjax.baselines.tagview.interpolation import interpolate
from tagjax.baselines.tagview.line_fit import fit_line, fit_pairs, translating_factor
from tagjax.baselines.tagview.matching import MatchSettings, Traces, identify
from tagjax.baselines.tagview.quadratic_programme import select_edges
from tagjax.baselines.tagview.rssi_agreement import agreement, shared_times
from tagjax.baselines.tagview.sequences import ReadSettings, TagMeasurements, TagSequences, tag_measurements
from tagjax.baselines.tagview.splicing import pieces, splice_phase
from tagjax.recording import TagReads

WAVELENGTH_M = 0.3276

# Compiled whole: eagerly each small operation is compiled for itself, which takes far longer.
_splice = jax.jit(splice_phase, static_argnums=2)
_pieces = jax.jit(pieces, static_argnames=("max_gap_s", "break_at_hops"))
_interpolate = jax.jit(interpolate)
_fit = jax.jit(fit_line)
_agree = jax.jit(agreement, static_argnames=("rssi_width_db", "distance_width_px"))


def _all(size: int) -> jax.Array:
    return jnp.ones(size, bool)


# Splicing


@pytest.mark.parametrize("period", [2 * np.pi, np.pi])
def test_splicing_recovers_the_phase_up_to_whole_periods(period):
    time = np.linspace(0, 4, 300)
    true = 9.0 * np.sin(time) + 20.0 * time / 4
    flips = np.random.default_rng(0).integers(0, 2, 300) * np.pi if period == np.pi else 0.0
    measured = jnp.asarray(np.mod(true + flips, 2 * np.pi), jnp.float32)
    spliced = _splice(measured, _all(300), float(period))
    np.testing.assert_allclose(spliced - spliced[0], true - true[0], atol=1e-4)


def test_splicing_skips_invalid_reads():
    phase = jnp.asarray([0.1, 3.0, 0.4, 0.7, 2.9, 2.9], jnp.float32)
    valid = jnp.asarray([True, False, True, True, False, False])
    np.testing.assert_allclose(_splice(phase, valid, 2 * np.pi), [0.1, 0.1, 0.4, 0.7, 0.7, 0.7], atol=1e-6)
    np.testing.assert_array_equal(_splice(phase, jnp.zeros(6, bool), 2 * np.pi), np.zeros(6))
    assert _splice(jnp.zeros(0), jnp.zeros(0, bool), 2 * np.pi).shape == (0,)


def test_splicing_has_the_identity_for_gradient(gradients_agree):
    phase = np.mod(np.linspace(0, 11, 12), 2 * np.pi) + 0.01
    gradients_agree(lambda p: _splice(p, _all(12), 2 * np.pi), (phase,))
    jacobian = jax.jit(jax.jacobian(lambda p: _splice(p, _all(12), 2 * np.pi)))(jnp.asarray(phase, jnp.float32))
    np.testing.assert_allclose(jacobian, np.eye(12), atol=1e-5)


def test_pieces_begin_after_gaps_and_hops():
    time = jnp.asarray([0.0, 0.1, 0.2, 0.9, 1.0, 1.1], jnp.float32)
    channel = jnp.asarray([0, 0, 0, 0, 3, 3], jnp.int32)
    valid = _all(6).at[1].set(False)
    gaps = _pieces(time, channel, valid, max_gap_s=0.5, break_at_hops=False)
    np.testing.assert_array_equal(gaps, [0, 0, 0, 1, 1, 1])
    both = _pieces(time, channel, valid, max_gap_s=0.5, break_at_hops=True)
    np.testing.assert_array_equal(both, [0, 0, 0, 1, 2, 2])


# Interpolation


@pytest.mark.parametrize("count", [2, 3, 4, 25])
def test_interpolation_is_scipys_pchip(count):
    rng = np.random.default_rng(count)
    time = np.cumsum(rng.uniform(0.01, 0.2, count))
    value = np.round(np.cumsum(rng.normal(size=count)), 1)
    at = np.sort(rng.uniform(time[0], time[-1], 60))
    pad = 5
    padded = [jnp.asarray(np.pad(x, (0, pad)), jnp.float32) for x in (time, value)]
    ours = _interpolate(*padded, jnp.arange(count + pad) < count, jnp.asarray(at, jnp.float32))
    np.testing.assert_allclose(ours, PchipInterpolator(time, value)(at), atol=2e-4)


def test_interpolation_is_constant_beyond_the_ends():
    at = jnp.asarray([-1.0, 0.5, 9.0], jnp.float32)
    time, value = jnp.asarray([0.0, 1.0, 2.0], jnp.float32), jnp.asarray([3.0, 5.0, 4.0], jnp.float32)
    one = _interpolate(time, value, jnp.asarray([True, False, False]), at)
    np.testing.assert_array_equal(one, [3.0, 3.0, 3.0])
    np.testing.assert_array_equal(_interpolate(time, value, jnp.zeros(3, bool), at), np.zeros(3))
    whole = _interpolate(time, value, _all(3), at)
    assert whole[0] == 3.0
    assert whole[2] == 4.0


@pytest.mark.ci
def test_interpolation_has_gradients(gradients_agree):
    rng = np.random.default_rng(3)
    time, value = np.cumsum(rng.uniform(0.1, 0.3, 7)), rng.normal(size=7)
    at = jnp.linspace(0.2, 1.2, 9)
    gradients_agree(lambda t, v: _interpolate(t, v, _all(7), at.astype(t.dtype)), (time, value))
    level = jax.grad(lambda v: jnp.sum(_interpolate(jnp.arange(5.0), v, _all(5), jnp.asarray([0.5, 2.0, 4.0]))))
    assert np.all(np.isfinite(level(jnp.ones(5))))
    same_time = jax.grad(lambda t: jnp.sum(_interpolate(t, jnp.arange(5.0), _all(5), jnp.asarray([0.5, 1.0]))))
    assert np.all(np.isfinite(same_time(jnp.asarray([0.0, 1.0, 1.0, 1.0, 2.0]))))


# The line


def _line_data(seed=0, count=40):
    rng = np.random.default_rng(seed)
    gamma = 1 + 0.1 * rng.uniform(size=count)
    return gamma, 90 * gamma + 5 + rng.normal(scale=0.3, size=count)


def test_a_moving_tag_lies_on_the_line_of_its_height():
    height_m, focal_px = 2.4, 183.0
    time = np.linspace(0, 3, 50)
    s_m = 0.3 + 0.7 * np.abs(np.sin(time))
    phase = 4 * np.pi / WAVELENGTH_M * np.hypot(height_m, s_m)
    gamma = translating_factor(jnp.asarray(focal_px * s_m / height_m, jnp.float32), jnp.asarray(focal_px, jnp.float32))
    fit = _fit(gamma, jnp.asarray(phase, jnp.float32), _all(50), jnp.zeros(50, jnp.int32))
    assert float(fit.slope) == pytest.approx(4 * np.pi * height_m / WAVELENGTH_M, rel=1e-4)
    assert float(fit.intercept) == pytest.approx(0.0, abs=0.01)
    assert float(fit.r_squared) == pytest.approx(1.0, abs=1e-5)


def test_the_line_is_that_of_numpy():
    gamma, phase = _line_data()
    valid = np.arange(40) % 5 > 0
    fit = _fit(*(jnp.asarray(x, jnp.float32) for x in (gamma, phase)), jnp.asarray(valid), jnp.zeros(40, jnp.int32))
    slope, intercept = np.polyfit(gamma[valid], phase[valid], 1)
    correlation = np.corrcoef(gamma[valid], phase[valid])[0, 1]
    assert float(fit.slope) == pytest.approx(slope, rel=1e-4)
    assert float(fit.intercept) == pytest.approx(intercept, abs=2e-2)
    assert float(fit.r_squared) == pytest.approx(correlation**2, abs=1e-5)
    assert float(fit.count) == valid.sum()


def test_each_piece_has_its_own_intercept():
    gamma, phase = _line_data()
    piece = np.arange(40) // 15
    shifted = phase + np.array([0.0, 40.0, -11.0])[piece]
    columns = np.column_stack([gamma, *(piece == p for p in range(3))])
    solved, residual, *_ = np.linalg.lstsq(columns, shifted, rcond=None)
    within = sum(np.sum((shifted[piece == p] - shifted[piece == p].mean()) ** 2) for p in range(3))
    fit = _fit(*(jnp.asarray(x, jnp.float32) for x in (gamma, shifted)), _all(40), jnp.asarray(piece, jnp.int32))
    assert float(fit.slope) == pytest.approx(solved[0], rel=1e-3)
    assert float(fit.r_squared) == pytest.approx(1 - residual[0] / within, abs=1e-4)


@pytest.mark.parametrize(
    ("gamma", "phase", "valid"),
    [
        ([1.0, 1.1, 1.2, 1.3], [1.0, 2.0, 3.0, 4.0], [True, False, False, False]),
        ([1.0, 1.1, 1.2, 1.3], [1.0, 2.0, 3.0, 4.0], [True, True, False, False]),
        ([1.1, 1.1, 1.1, 1.1], [1.0, 2.0, 3.0, 4.0], [True] * 4),
        ([1.0, 1.1, 1.2, 1.3], [2.0, 2.0, 2.0, 2.0], [True] * 4),
        ([1.0, 1.1, 1.2, 1.3], [1.0, 2.0, 3.0, 4.0], [False] * 4),
    ],
    ids=["one sample", "two samples", "still object", "still tag", "nothing"],
)
def test_lines_without_information_explain_nothing(gamma, phase, valid):
    arrays = [jnp.asarray(x, jnp.float32) for x in (gamma, phase)]
    known = jnp.asarray(valid)

    def both(g, p):
        fit = _fit(g, p, known, jnp.zeros(4, jnp.int32))
        return fit.r_squared + fit.slope + fit.intercept

    fit = _fit(*arrays, known, jnp.zeros(4, jnp.int32))
    assert float(fit.r_squared) == 0.0
    for gradient in jax.jit(jax.grad(both, argnums=(0, 1)))(*arrays):
        assert np.all(np.isfinite(gradient))


def test_lines_have_gradients_and_run_compiled_and_batched(gradients_agree):
    gamma, phase = _line_data(count=8)
    piece = jnp.asarray([0, 0, 0, 0, 1, 1, 1, 1], jnp.int32)
    gradients_agree(
        lambda g, p: jnp.stack([_fit(g, p, _all(8), piece).slope, _fit(g, p, _all(8), piece).r_squared]),
        (gamma, phase),
        rtol=1e-4,
        atol=1e-4,
    )
    rng = np.random.default_rng(1)
    traces, tags = (jnp.asarray(rng.normal(size=(n, 20)), jnp.float32) for n in (3, 2))
    seen, measured = (jnp.asarray(rng.uniform(size=(n, 20)) < 0.8) for n in (3, 2))
    parts = jnp.zeros((2, 20), jnp.int32)
    table = jax.jit(fit_pairs)(traces, seen, tags, measured, parts)
    for k, i in itertools.product(range(3), range(2)):
        one = _fit(traces[k], tags[i], jnp.asarray(np.asarray(seen[k]) & np.asarray(measured[i])), parts[i])
        assert float(table.slope[k, i]) == pytest.approx(float(one.slope), rel=1e-4)
        assert float(table.r_squared[k, i]) == pytest.approx(float(one.r_squared), abs=1e-5)


# Agreement


def _agreement(rssi, distance, **widths):
    rssi, distance = (jnp.asarray(x, jnp.float32) for x in (rssi, distance))
    return np.asarray(_agree(rssi, jnp.ones(rssi.shape, bool), distance, jnp.ones(distance.shape, bool), **widths))


def test_the_nearer_tag_is_the_stronger_one():
    far, near = np.full(10, 80.0), np.full(10, 30.0)
    weak, strong = np.full(10, -66.0), np.full(10, -60.0)
    table = _agreement([weak, strong], [far, near])
    assert table[0, 1, 0, 1] == 1.0  # far trace with weak tag, near with strong
    assert table[0, 1, 1, 0] == 0.0
    assert table[0, 1, 0, 0] == 0.5  # a tag compared with itself is no evidence
    assert table[0, 0, 0, 1] == 0.5


def test_without_ties_agreement_is_the_papers_exclusive_or():
    rng = np.random.default_rng(4)
    rssi, distance = rng.normal(size=(3, 50)), rng.uniform(size=(4, 50))
    table = _agreement(rssi, distance)
    for k, m, i, j in itertools.product(range(4), range(4), range(3), range(3)):
        if k != m and i != j:
            x, y = rssi[i] > rssi[j], distance[k] > distance[m]
            assert table[k, m, i, j] == pytest.approx(np.mean(x ^ y), abs=1e-6)
    np.testing.assert_array_equal(table, table.transpose(1, 0, 3, 2))


def test_agreement_uses_common_times_and_has_a_soft_form():
    rssi, distance = jnp.asarray([[-60.0, -60.0], [-66.0, -50.0]]), jnp.asarray([[1.0, 1.0], [2.0, 2.0]])
    measured = jnp.asarray([[True, True], [True, False]])
    seen = jnp.ones((2, 2), bool)
    assert float(_agree(rssi, measured, distance, seen)[0, 1, 0, 1]) == 1.0
    assert float(_agree(rssi, jnp.zeros((2, 2), bool), distance, seen)[0, 1, 0, 1]) == 0.5
    soft = _agree(rssi, measured, distance, seen, rssi_width_db=1e-3, distance_width_px=1e-3)
    np.testing.assert_allclose(soft, _agree(rssi, measured, distance, seen), atol=1e-6)
    gradient = jax.grad(
        lambda r: _agree(r, measured, distance, seen, rssi_width_db=3.0, distance_width_px=1.0)[0, 1, 0, 1]
    )
    assert float(gradient(rssi)[0, 0]) > 0 > float(gradient(rssi)[1, 0])


# Graph


def test_matching_is_one_to_one_and_leaves_pairs_of_weight_0():
    weight = np.array([[0.9, 0.8], [0.85, 0.1], [0.0, 0.0]])
    np.testing.assert_array_equal(match_graph(weight), [1, 0, -1])
    np.testing.assert_array_equal(match_graph(np.zeros((2, 3))), [-1, -1])


def test_pruning_keeps_slopes_near_the_shared_one():
    slope = np.array([[100.0, -90.0], [104.0, 96.0], [160.0, 99.0]])
    shared = shared_coefficient(slope, np.array([0, 1, -1]), estimator="std", min_relative_spread=0.0)
    assert shared is not None
    assert (shared.mean, shared.spread) == (98.0, 2.0)
    np.testing.assert_array_equal(keep_edges(slope, shared, 3.0), [[True, False], [True, True], [False, True]])
    wide = shared_coefficient(slope, np.array([0, 1, -1]), estimator="std", min_relative_spread=0.5)
    assert wide is not None
    assert wide.spread == 49.0
    assert shared_coefficient(slope, np.full(3, -1), estimator="std", min_relative_spread=0.1) is None
    assert not keep_edges(slope, None, 3.0).any()


def test_a_wrong_match_does_not_move_the_median():
    slope = np.diag([100.0, 101.0, 99.0, 100.0, -300.0])
    tag_of = np.arange(5)
    robust = shared_coefficient(slope, tag_of, estimator="mad", min_relative_spread=0.05)
    plain = shared_coefficient(slope, tag_of, estimator="std", min_relative_spread=0.05)
    assert robust is not None
    assert plain is not None
    assert robust.mean == 100.0
    assert plain.mean == 20.0


def test_cliques_are_traces_and_overlaps_of_a_tags_traces():
    trace, tag = np.array([0, 0, 1, 2, 3]), np.array([0, 1, 0, 0, 0])
    span = np.array([[0.0, 2.0], [1.0, 3.0], [2.5, 5.0], [4.0, 6.0]])
    found = {tuple(one.tolist()) for one in cliques(trace, tag, span, tolerance_s=0.1)}
    assert found == {(0, 1), (0, 2), (2, 3), (3, 4)}
    loose = {tuple(one.tolist()) for one in cliques(trace, tag, span, tolerance_s=0.6)}
    assert loose == {(0, 1), (0, 2), (3, 4)}


# The programme


def _brute(weight, quadratic, rows):
    best = 0.0
    for bits in itertools.product([0, 1], repeat=len(weight)):
        x = np.array(bits)
        if all(x[row].sum() <= 1 for row in rows):
            best = max(best, float(x @ quadratic @ x + weight @ x))
    return best


@pytest.mark.parametrize("signed", [False, True])
@pytest.mark.parametrize("seed", range(12))
def test_the_programme_is_solved_exactly(seed, signed):
    rng = np.random.default_rng(seed)
    num_traces, num_tags = int(rng.integers(2, 5)), int(rng.integers(2, 4))
    trace, tag = np.nonzero(rng.uniform(size=(num_traces, num_tags)) < 0.85)
    begin = rng.uniform(0, 3, num_traces)
    span = np.stack([begin, begin + rng.uniform(0.5, 2, num_traces)], axis=1)
    rows = cliques(trace, tag, span, tolerance_s=0.0)
    upper = np.triu(rng.uniform(size=(len(trace),) * 2))
    quadratic, weight = 0.5 * (upper + upper.T) - 0.4 * signed, rng.uniform(-0.5, 1, len(trace))
    found = select_edges(weight, quadratic, rows)
    assert all(found.chosen[row].sum() <= 1 for row in rows)
    assert found.value == pytest.approx(_brute(weight, quadratic, rows), abs=1e-6)
    x = found.chosen.astype(float)
    assert found.value == pytest.approx(x @ quadratic @ x + weight @ x, abs=1e-9)
    assert found.gap < 1e-6


def test_the_papers_size_is_solved_with_proof():
    rng = np.random.default_rng(0)
    trace, tag = (x.ravel() for x in np.meshgrid(np.arange(10), np.arange(6), indexing="ij"))
    span = np.array([[0.0, 8.0]] * 4 + [[0.0, 3.0], [4.0, 8.0]] * 3)
    upper = np.triu(rng.uniform(size=(60, 60)), 1)
    found = select_edges(
        rng.uniform(size=60), 0.5 * (upper + upper.T), cliques(trace, tag, span, tolerance_s=0.0), time_limit_s=60.0
    )
    assert found.chosen.sum() >= 6
    assert found.gap < 1e-4


def test_a_short_time_limit_still_gives_a_bound():
    rng = np.random.default_rng(1)
    trace, tag = (x.ravel() for x in np.meshgrid(np.arange(12), np.arange(12), indexing="ij"))
    upper = np.triu(rng.uniform(size=(144, 144)), 1)
    rows = cliques(trace, tag, np.array([[0.0, 8.0]] * 12), tolerance_s=0.0)
    found = select_edges(rng.uniform(size=144), 0.5 * (upper + upper.T), rows, time_limit_s=0.5)
    assert all(found.chosen[row].sum() <= 1 for row in rows)
    assert found.value <= found.bound
    assert 0 <= found.gap <= 1


def test_the_programme_refuses_what_it_cannot_solve():
    assert select_edges(np.zeros(0), np.zeros((0, 0)), []).chosen.shape == (0,)
    with pytest.raises(ValueError, match="not symmetric"):
        select_edges(np.ones(2), np.array([[0.0, 1.0], [0.0, 0.0]]), [])
    with pytest.raises(ValueError, match="finite"):
        select_edges(np.array([np.nan, 1.0]), np.zeros((2, 2)), [])


def test_edges_have_no_agreement_with_themselves():
    table = np.random.default_rng(0).uniform(size=(2, 2, 2, 2))
    trace, tag = np.array([0, 1, 1]), np.array([0, 0, 1])
    quadratic = edge_agreement(table, trace, tag)
    assert quadratic[0, 2] == table[0, 1, 0, 1]
    np.testing.assert_array_equal(np.diag(quadratic), 0.0)


def test_agreement_by_likelihood_is_relative_to_one_half():
    table = np.random.default_rng(0).uniform(size=(2, 2, 2, 2))
    trace, tag = np.array([0, 1, 1]), np.array([0, 0, 1])
    num_shared = np.random.default_rng(1).uniform(1, 9, size=(2, 2, 2, 2))
    quadratic = edge_agreement(table, trace, tag, num_shared)
    assert quadratic[0, 2] == pytest.approx(num_shared[0, 1, 0, 1] * (table[0, 1, 0, 1] - 0.5))
    np.testing.assert_array_equal(np.diag(quadratic), 0.0)
    assert not np.any(edge_agreement(np.full((2, 2, 2, 2), 0.5), trace, tag, num_shared))


def test_shared_times_count_frames_with_both_traces_and_both_rssi():
    seen, measured = np.random.default_rng(0).random((3, 40)) < 0.7, np.random.default_rng(1).random((2, 40)) < 0.5
    found = np.asarray(shared_times(jnp.asarray(measured), jnp.asarray(seen)))
    for one, other, i, j in itertools.product(range(3), range(3), range(2), range(2)):
        assert found[one, other, i, j] == np.sum(seen[one] & seen[other] & measured[i] & measured[j])


def test_a_short_trace_has_little_weight_in_the_shared_slope():
    slope, weight = np.array([[2.0], [6.0]]), np.array([[30.0], [1.0]])
    tag_of = np.array([0, 0])
    plain = shared_coefficient(slope, tag_of, estimator="std", min_relative_spread=0.0)
    weighed = shared_coefficient(slope, tag_of, estimator="std", min_relative_spread=0.0, weight=weight)
    assert plain is not None
    assert weighed is not None
    assert (plain.mean, plain.spread) == (4.0, 2.0)
    assert weighed.mean == pytest.approx(66 / 31)
    assert weighed.spread == pytest.approx(np.sqrt((30 * (2 - 66 / 31) ** 2 + (6 - 66 / 31) ** 2) / 31))


def test_the_weight_of_a_line_is_its_likelihood_ratio():
    rng = np.random.default_rng(0)
    x, noise = rng.normal(size=400), rng.normal(size=400)
    y = 2.0 * x + noise
    slope, intercept = np.polyfit(x, y, 1)
    line, constant = np.mean((y - slope * x - intercept) ** 2), np.var(y)
    ratio = (
        norm.logpdf(y, slope * x + intercept, np.sqrt(line)).sum() - norm.logpdf(y, y.mean(), np.sqrt(constant)).sum()
    )
    weight = likelihood_weight(np.array([[1.0 - line / constant, 0.0]]), np.array([[400.0, 400.0]]))
    assert weight[0, 0] == pytest.approx(ratio, rel=0.05)  # R^2 counts 0.99 of itself
    assert weight[0, 1] == 0.0
    assert np.isfinite(likelihood_weight(np.ones((1, 1)), np.full((1, 1), 9.0))).all()


def test_the_slope_penalty_is_log_normal_with_a_limit():
    shared = Coefficient(2.0, 0.1)
    slope = 2.0 * np.exp([[0.0, 0.25, -0.5, 5.0, -5.0]])
    expected = norm.logpdf([0.0, 0.25, -0.5], 0.0, 0.25) - norm.logpdf(0.0, 0.0, 0.25)
    found = slope_log_odds(np.concatenate([slope, [[-2.0, 0.0, 0.0, 0.0, 0.0]]]), shared, 0.25)
    np.testing.assert_allclose(found[0, :3], expected, atol=1e-12)
    np.testing.assert_array_equal(found[0, 3:], -MAX_SLOPE_PENALTY_NATS)
    np.testing.assert_array_equal(found[1], -MAX_SLOPE_PENALTY_NATS)


# Reads


def _reads(epcs, time_s, range_m, carrier_hz, *, rssi=-60.0, slope=0.0, flips=None):
    phase = (
        4 * np.pi * np.asarray(carrier_hz) * range_m / 299_792_458.0 + slope * (np.asarray(carrier_hz) - 915e6) + 1.0
    )
    phase = phase + (0.0 if flips is None else np.pi * flips)
    count = len(time_s)
    return TagReads(
        epc=np.asarray(epcs),
        time_ns=(np.asarray(time_s) * 1e9).astype(np.int64),
        antenna=np.ones(count, np.int16),
        carrier_hz=np.broadcast_to(np.asarray(carrier_hz, np.float64), (count,)).copy(),
        phase_rad=np.mod(phase, 2 * np.pi),
        rssi_dbm=np.broadcast_to(np.asarray(rssi, np.float32), (count,)).copy(),
        doppler_hz=np.zeros(count, np.float32),
    )


def _moving(count=400, seconds=8.0):
    time = np.linspace(0, seconds, count)
    return time, np.hypot(2.4, 0.6 + 0.5 * np.sin(1.3 * time))


def test_hops_and_flips_are_corrected():
    rng = np.random.default_rng(0)
    time, range_m = _moving()
    carrier = 902.75e6 + 0.5e6 * rng.integers(0, 50, 41)[(time / 0.2).astype(int)]
    flips = rng.integers(0, 10, len(time)) == 0
    reads = _reads(["A"] * len(time), time, range_m, carrier, slope=0.35e-6, flips=flips)
    frames = np.arange(0.1, 7.9, 1 / 15)
    sequences = tag_measurements(["A", "never"], reads, time, frames, ReadSettings())
    true = 4 * np.pi / sequences.wavelength_m * np.hypot(2.4, 0.6 + 0.5 * np.sin(1.3 * frames))
    found = np.asarray(sequences.sequences.phase_rad[0])
    error = (found - true) - np.mean(found - true)
    assert np.sqrt(np.mean(error**2)) < 0.25
    assert np.asarray(sequences.sequences.phase_known[0]).all()
    assert not np.asarray(sequences.sequences.phase_known[1]).any()
    literal = tag_measurements(
        ["A"], reads, time, frames, ReadSettings(hops="ignore", pi_flips=False, break_at_gaps=False)
    )
    wrong = np.asarray(literal.sequences.phase_rad[0]) - true
    assert np.std(wrong) > 1.0


def test_gaps_have_no_phase_and_begin_a_new_piece():
    time, range_m = _moving()
    keep = (time < 3) | (time > 4)
    reads = _reads(["A"] * int(keep.sum()), time[keep], range_m[keep], 915e6)
    frames = np.arange(0.1, 7.9, 0.1)
    sequences = tag_measurements(["A"], reads, time[keep], frames, ReadSettings()).sequences
    measured, piece = np.asarray(sequences.phase_known[0]), np.asarray(sequences.piece[0])
    inside = (frames > 3.05) & (frames < 3.95)
    assert not measured[inside].any()
    assert measured[(frames < 2.9) | (frames > 4.1)].all()
    assert set(piece[frames < 2.9]) == {0}
    assert set(piece[frames > 4.1]) == {1}
    assert not np.asarray(sequences.rssi_known[0])[(frames > 3.2) & (frames < 3.8)].any()


def test_settings_are_checked():
    with pytest.raises(ValueError, match="antenna"):
        ReadSettings(antenna=0)
    with pytest.raises(ValueError, match="max_gap_s"):
        ReadSettings(max_gap_s=0.0)
    with pytest.raises(ValueError, match="min_samples"):
        MatchSettings(min_samples=2)
    with pytest.raises(ValueError, match="max_z_score"):
        MatchSettings(max_z_score=0.0)
    with pytest.raises(ValueError, match="correlation_time_s is 0"):
        MatchSettings(correlation_time_s=0.0)
    with pytest.raises(ValueError, match=r"log_slope_std is 0\.2 with edge_weight r_squared"):
        MatchSettings(log_slope_std=0.2)
    with pytest.raises(ValueError, match=r"prior_log_odds is 2\.0 without log_slope_std"):
        MatchSettings(edge_weight="likelihood", prior_log_odds=2.0)
    with pytest.raises(ValueError, match="without the programme"):
        MatchSettings(edge_weight="likelihood", programme=False)
    with pytest.raises(ValueError, match="log_slope_std is 0"):
        MatchSettings(edge_weight="likelihood", log_slope_std=0.0)


# All num_shared

FOCAL_PX, HEIGHT_M = 183.0, 2.4


def _world(num, *, antenna_m=(0.0, 0.0), seed=0, frames=96, noise=0.05):
    """Traces of objects on loops, and the measurements of their tags."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames) / 15
    centre = rng.uniform(-0.6, 0.6, (num, 2))
    angle = rng.uniform(0, 6, num)[:, None] + rng.uniform(0.8, 1.6, num)[:, None] * time
    place = centre[:, None] + 0.35 * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    range_m = np.sqrt(HEIGHT_M**2 + np.sum((place - np.asarray(antenna_m)) ** 2, axis=-1))
    phase = (
        4 * np.pi / WAVELENGTH_M * range_m + rng.uniform(0, 6, num)[:, None] + rng.normal(size=range_m.shape) * noise
    )
    sequences = TagSequences(
        jnp.asarray(phase, jnp.float32),
        jnp.ones(phase.shape, bool),
        jnp.zeros(phase.shape, jnp.int32),
        jnp.asarray(-60 - 40 * np.log10(range_m / HEIGHT_M), jnp.float32),
        jnp.ones(phase.shape, bool),
    )
    traces = Traces(tuple(range(1, num + 1)), time, place / HEIGHT_M, np.ones((num, frames), bool))
    return traces, TagMeasurements(sequences, WAVELENGTH_M)


NADIR = np.zeros(3)


@pytest.mark.parametrize("num", [1, 2, 4, 6])
def test_every_trace_gets_its_tag(num):
    traces, measured = _world(num)
    found = identify(traces, measured, FOCAL_PX, NADIR, MatchSettings())
    np.testing.assert_array_equal(found.tag_of, np.arange(num))
    assert found.height_m == pytest.approx(HEIGHT_M, rel=0.02)
    assert found.selection is not None
    assert found.selection.gap < 1e-6


def test_the_point_below_the_antenna_straightens_the_line():
    traces, measured = _world(3, antenna_m=(-0.12, 0.0))
    plain = identify(traces, measured, FOCAL_PX, np.array([-0.12, 0.0, 0.0]), MatchSettings(mu=0.0))
    moved = identify(traces, measured, FOCAL_PX, np.array([-0.12, 0.0, 0.0]), MatchSettings(mu=0.0, origin="antenna"))
    own = np.arange(3)
    assert np.all(moved.r_squared[own, own] > 0.998)
    assert np.ptp(moved.slope[own, own]) < 0.3 * np.ptp(plain.slope[own, own])


def _split(traces, measured):
    """The first trace split in two, with a gap between."""
    seen = np.repeat(traces.seen, [2, *[1] * (len(traces.number) - 1)], axis=0)
    seen[0, 44:], seen[1, :52] = False, False
    direction = np.repeat(traces.direction, [2, *[1] * (len(traces.number) - 1)], axis=0)
    return Traces(tuple(range(len(seen))), traces.time_s, direction, seen), measured


def test_a_tag_may_have_several_traces_that_do_not_overlap():
    traces, measured = _split(*_world(3))
    found = identify(traces, measured, FOCAL_PX, NADIR, MatchSettings(min_relative_spread=0.1))
    np.testing.assert_array_equal(found.tag_of, [0, 0, 1, 2])
    alone = identify(traces, measured, FOCAL_PX, NADIR, MatchSettings(programme=False))
    assert sorted(alone.tag_of) == [-1, 0, 1, 2]


def test_rssi_separates_traces_of_equal_phase():
    """Half a wavelength apart in range: gamma differs by a constant, and the phases are equal."""
    time = np.arange(90) / 15
    near = 2.5 + 0.1 * np.sin(time)
    ranges = np.stack([near, near + WAVELENGTH_M / 2])
    distance = np.sqrt(ranges**2 - 2.35**2) / 2.35
    direction = np.stack([distance, np.zeros_like(distance)], axis=-1)
    traces = Traces((1, 2), time, direction, np.ones((2, 90), bool))
    phase = np.tile(4 * np.pi / WAVELENGTH_M * near, (2, 1))
    for order in ([0, 1], [1, 0]):
        rssi = (-60 - 40 * np.log10(ranges / 2.4))[order]
        ones = jnp.ones((2, 90), bool)
        sequences = TagSequences(
            jnp.asarray(phase, jnp.float32), ones, jnp.zeros((2, 90), jnp.int32), jnp.asarray(rssi, jnp.float32), ones
        )
        found = identify(traces, TagMeasurements(sequences, WAVELENGTH_M), 183.0, NADIR, MatchSettings())
        np.testing.assert_array_equal(found.tag_of, order)
        assert np.ptp(found.r_squared) < 1e-3


def test_no_traces_no_tags_and_no_reads_are_defined():
    traces, measured = _world(2)
    none = Traces((), traces.time_s, np.zeros((0, 96, 2)), np.zeros((0, 96), bool))
    assert identify(none, measured, FOCAL_PX, NADIR, MatchSettings()).tag_of.shape == (0,)
    no_tags = TagMeasurements(jax.tree.map(lambda x: x[:0], measured.sequences), WAVELENGTH_M)
    np.testing.assert_array_equal(identify(traces, no_tags, FOCAL_PX, NADIR, MatchSettings()).tag_of, [-1, -1])
    unread = TagMeasurements(
        TagSequences(
            measured.sequences.phase_rad,
            jnp.zeros((2, 96), bool),
            measured.sequences.piece,
            measured.sequences.rssi_dbm,
            jnp.zeros((2, 96), bool),
        ),
        WAVELENGTH_M,
    )
    unmatched = identify(traces, unread, FOCAL_PX, NADIR, MatchSettings())
    np.testing.assert_array_equal(unmatched.tag_of, [-1, -1])
    assert np.isnan(unmatched.height_m)


def test_more_tags_than_traces_and_traces_without_a_tag():
    traces, measured = _world(4)
    few = Traces((1, 2), traces.time_s, traces.direction[[2, 0]], traces.seen[:2])
    np.testing.assert_array_equal(identify(few, measured, FOCAL_PX, NADIR, MatchSettings()).tag_of, [2, 0])
    two = TagMeasurements(jax.tree.map(lambda x: x[jnp.array([1, 3])], measured.sequences), WAVELENGTH_M)
    found = identify(traces, two, FOCAL_PX, NADIR, MatchSettings(min_r_squared=0.8))
    np.testing.assert_array_equal(found.tag_of, [-1, 0, -1, 1])


def test_the_prior_identifies_short_traces():
    """The fit of a short trace is weak evidence: its slope and the prior identify it."""
    traces, measured = _world(3, noise=0.6)
    seen = traces.seen.copy()
    seen[0, 6:] = False
    short = Traces(traces.number, traces.time_s, traces.direction, seen)
    settings = {"edge_weight": "likelihood", "log_slope_std": 0.25, "min_samples": 4, "mu": 0.0}
    found = identify(short, measured, FOCAL_PX, NADIR, MatchSettings(**settings, prior_log_odds=9.0))
    np.testing.assert_array_equal(found.tag_of, [0, 1, 2])
    assert identify(short, measured, FOCAL_PX, NADIR, MatchSettings(**settings)).tag_of[0] == -1
    # An object without a tag, seen at the same time as those with one, stays unidentified: a tag is at one position.
    two = TagMeasurements(jax.tree.map(lambda x: x[1:], measured.sequences), WAVELENGTH_M)
    found = identify(traces, two, FOCAL_PX, NADIR, MatchSettings(**settings, prior_log_odds=9.0))
    np.testing.assert_array_equal(found.tag_of, [-1, 0, 1])


def test_one_sample_and_equal_traces():
    traces, measured = _world(2)
    brief = traces.seen.copy()
    brief[1, 1:] = False
    found = identify(Traces((1, 2), traces.time_s, traces.direction, brief), measured, FOCAL_PX, NADIR, MatchSettings())
    np.testing.assert_array_equal(found.tag_of, [0, -1])
    assert found.fit[1].max() == 0.0
    same = Traces((1, 2), traces.time_s, traces.direction[[0, 0]], traces.seen)
    twice = identify(same, measured, FOCAL_PX, NADIR, MatchSettings())
    np.testing.assert_allclose(twice.r_squared[0], twice.r_squared[1])
    assert np.sum(twice.tag_of == 0) == 1
