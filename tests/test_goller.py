"""Goller et al.: the scoring cores in closed form and against NumPy, the vision on drawn scenes, the whole on one."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf
from scipy.stats import binomtest, multivariate_normal

from tagjax.baselines import host_trace
from tagjax.baselines.goller import AntennaModel, BlobSettings, BlobTracker, GollerSettings, GollerTracer, Site, antenna_weights, assignment_row, associate, best_threshold, calibrate, carried, covariance_m2, decide, exit_score, find_site, fit_antennas, fit_association, forward_filter, load_calibration, locate, make_association, make_grid, make_location, mixture_likelihood, observe, operating_point, roc_curve, rssi_score, save_calibration
from tagjax.baselines.goller._antennas import POWER_SCALE_DB, response_db
from tagjax.baselines.goller._blobs import BlobTracks, in_slots
from tagjax.baselines.goller._fit import true_states
from tagjax.baselines.goller._reads import RssiFrames, grid_statistic, rssi_frames
from tagjax.baselines.goller._site import level_site
from tagjax.baselines.goller._system import Calibration, empty_picture
from tagjax.core.settings import from_mapping
from tagjax.evaluation.goller import GollerConfig, follow, ladder, mean_curve, outcomes, rates, run_goller, scenario_paths, thresholds
from tagjax.evaluation.goller._run import _handover_paths
from tagjax.evaluation.goller._tables import interval
from tagjax.recording import Intrinsics, Recording, RecordingError, TagReads, Truth
from tagjax.recording.store import open_recording, save_recording

RNG = np.random.default_rng(0)

MEANS = np.array([[0.0, 0.0], [2.1, 0.1], [4.2, -0.1]])
SCALES = np.array([[1.2, 0.9], [1.4, 1.1], [1.0, 0.8]])
SKEWS = np.array([0.0, 0.3, -0.4])


def antennas(floor_dbm: float = -80.0) -> AntennaModel:
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    return AntennaModel(
        single(MEANS), single(np.log(SCALES)), single(SKEWS), single(np.log([22.0, 25.0, 20.0])), single(floor_dbm)
    )


# The antenna mixture


def test_covariances_are_those_of_the_factor():
    lower = np.zeros((3, 2, 2))
    lower[:, 0, 0], lower[:, 1, 1], lower[:, 1, 0] = SCALES[:, 0], SCALES[:, 1], SKEWS
    np.testing.assert_allclose(covariance_m2(antennas()), lower @ lower.transpose(0, 2, 1), rtol=1e-5)


def test_the_mixture_is_scipys_and_has_mass_one():
    model, weights = antennas(), np.array([0.5, 0.3, 0.2])
    axis = np.linspace(-8, 12, 201)
    points = np.stack(np.meshgrid(axis, axis, indexing="ij"), axis=-1).reshape(-1, 2)
    found = np.asarray(mixture_likelihood(model, jnp.asarray(weights, jnp.float32), jnp.asarray(points, jnp.float32)))
    covariance = np.asarray(covariance_m2(model), np.float64)
    expected = sum(
        w * multivariate_normal(m, c).pdf(points) for w, m, c in zip(weights, MEANS, covariance, strict=True)
    )
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-9)
    assert abs(found.sum() * (axis[1] - axis[0]) ** 2 - 1) < 1e-3


def test_weights_are_ratios_of_received_powers():
    rssi, heard = jnp.asarray([-60.0, -63.0, -50.0]), jnp.asarray([True, True, False])
    scale = jnp.asarray(POWER_SCALE_DB, jnp.float32)
    power = 10.0 ** (np.array([-60.0, -63.0]) / 10)
    weights = antenna_weights(rssi, heard, scale)
    np.testing.assert_allclose(weights, [*(power / power.sum()), 0.0], rtol=1e-5)
    # A tag that is turned away answers 15 dB weaker everywhere: nothing changes.
    np.testing.assert_allclose(antenna_weights(rssi - 15.0, heard, scale), weights, rtol=1e-5)
    np.testing.assert_array_equal(antenna_weights(rssi, jnp.zeros(3, bool), scale), np.zeros(3))


def test_a_tag_heard_by_nobody_has_no_likelihood_and_finite_gradients():
    model = antennas()
    points = jnp.asarray([[0.0, 0.0], [50.0, 50.0]])

    def total(rssi, scale):
        weights = antenna_weights(rssi, jnp.zeros(3, bool), scale)
        return jnp.sum(mixture_likelihood(model, weights, points))

    value, gradient = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))(jnp.full(3, -jnp.inf), jnp.asarray(4.0))
    assert value == 0
    assert all(np.isfinite(np.asarray(g)).all() for g in gradient)


def test_gradients_of_the_mixture(gradients_agree):
    heard = jnp.asarray([True, True, False])
    points = jnp.asarray([[0.3, -0.2], [2.0, 0.4]])

    def likelihood(mean, log_scale, skew, rssi, scale):
        model = AntennaModel(mean, log_scale, skew, jnp.zeros_like(skew), jnp.zeros((), skew.dtype))
        weights = antenna_weights(rssi, heard, scale)
        return mixture_likelihood(model, weights, points.astype(mean.dtype))

    gradients_agree(jax.jit(likelihood), (MEANS, np.log(SCALES), SKEWS, np.array([-60.0, -63.0, -70.0]), np.array(5.0)))


def _grid(spacing: float = 0.5) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-1.0, 5.3, spacing), np.arange(-1.2, 1.3, spacing))
    return np.stack([x.ravel(), y.ravel()], axis=-1)


@pytest.mark.parametrize("fit_means", [False, True])
def test_the_fit_finds_the_gaussians_that_made_the_grid(fit_means):
    model, points = antennas(), _grid()
    response = np.asarray(jax.vmap(lambda p: response_db(model, p))(jnp.asarray(points, jnp.float32)))
    mean_dbm = np.where(response > 0.02, response - 80.0, np.nan)
    start = MEANS + (0.3 if fit_means else 0.0)
    fitted = fit_antennas(points, mean_dbm, start, fit_means=fit_means)
    np.testing.assert_allclose(covariance_m2(fitted), covariance_m2(model), rtol=0.02, atol=0.01)
    np.testing.assert_allclose(fitted.mean_m, MEANS, atol=0.02)
    np.testing.assert_allclose(np.exp(fitted.log_peak_db), np.exp(model.log_peak_db), rtol=0.02)


def test_silence_tells_how_far_a_zone_reaches():
    model, points = antennas(), _grid()
    response = np.asarray(jax.vmap(lambda p: response_db(model, p))(jnp.asarray(points, jnp.float32)))
    deaf = np.where(response > 10.0, response - 80.0, np.nan)
    fitted = fit_antennas(points, deaf, MEANS)
    assert np.all(np.exp(np.asarray(fitted.log_scale_m[:, 0])) < SCALES[:, 0])


def test_grids_that_do_not_suffice_are_refused():
    points = _grid()
    mean = np.full((len(points), 3), -60.0)
    mean[4:, 1] = np.nan
    with pytest.raises(ValueError, match="Antenna 2 heard the tag at 4"):
        fit_antennas(points, mean, MEANS)
    line = np.stack([np.linspace(0, 4, 20), np.zeros(20)], axis=-1)
    with pytest.raises(ValueError, match="on a line"):
        fit_antennas(line, np.full((20, 3), -60.0), MEANS)


# Location


def _location(**settings: float):
    return make_location(antennas(), **settings)


FLOOR = make_grid((-2.0, -1.6), (6.2, 1.6), 0.4)


_locate = jax.jit(locate)


def _times(num: int) -> jax.Array:
    return jnp.arange(num, dtype=jnp.float32) * 0.1


def _rssi(path: np.ndarray) -> np.ndarray:
    return np.asarray(jax.vmap(lambda p: response_db(antennas(), p))(jnp.asarray(path, jnp.float32))) - 80.0


def test_a_tag_that_one_antenna_hears_is_where_that_antenna_is():
    time_s = _times(20)
    heard = jnp.zeros((20, 3), bool).at[:, 2].set(True)
    path = _locate(_location(), FLOOR, time_s, jnp.full((20, 3), -60.0), heard)
    assert np.abs(np.asarray(path.position_m[-1]) - MEANS[2]).max() < 0.25
    assert bool(path.known.all())


def test_a_tag_that_is_never_heard_is_anywhere_and_still():
    time_s = _times(5)
    path = _locate(_location(), FLOOR, time_s, jnp.zeros((5, 3)), jnp.zeros((5, 3), bool))
    np.testing.assert_allclose(path.position_m, np.broadcast_to([2.1, 0.0], (5, 2)), atol=1e-4)
    # The standard deviation of a uniform belief over the grid's cells.
    np.testing.assert_allclose(path.std_m[0, 0], np.std(np.asarray(FLOOR.x_m)), rtol=1e-3)
    np.testing.assert_array_equal(path.velocity_m_s, np.zeros((5, 2)))
    assert not bool(path.known.any())


def test_a_walk_along_the_antennas_is_followed_and_a_still_tag_is_not_moving():
    time_s = np.arange(60) * 0.1
    walk = np.stack([4.5 - 0.8 * time_s, np.zeros(60)], axis=-1)
    everywhere = jnp.ones((60, 3), bool)
    path = _locate(_location(), FLOOR, jnp.asarray(time_s), jnp.asarray(_rssi(walk)), everywhere)
    middle = slice(15, 50)
    assert np.abs(np.asarray(path.position_m[middle, 0]) - walk[middle, 0]).mean() < 0.6
    assert -1.2 < float(path.velocity_m_s[middle, 0].mean()) < -0.3
    still = _locate(_location(), FLOOR, jnp.asarray(time_s), jnp.asarray(_rssi(walk[:1].repeat(60, 0))), everywhere)
    assert np.abs(np.asarray(still.velocity_m_s[30:])).max() < 0.05


def test_without_reads_a_belief_only_widens():
    heard = jnp.zeros((30, 3), bool).at[:5].set(True)
    walk = np.broadcast_to(MEANS[1], (30, 2))
    path = _locate(_location(), FLOOR, _times(30), jnp.asarray(_rssi(walk)), heard)
    std = np.asarray(path.std_m[:, 0])
    assert np.all(np.diff(std[4:]) > 0)
    np.testing.assert_array_equal(path.heard, [True] * 5 + [False] * 25)


def test_one_frame_and_frames_at_one_time_are_finite():
    single = _locate(_location(), FLOOR, jnp.zeros(1), jnp.full((1, 3), -60.0), jnp.ones((1, 3), bool))
    same = _locate(_location(), FLOOR, jnp.zeros(3), jnp.full((3, 3), -60.0), jnp.ones((3, 3), bool))
    for path in (single, same):
        assert np.isfinite(np.asarray(path.position_m)).all()
        np.testing.assert_array_equal(path.velocity_m_s, np.zeros_like(path.velocity_m_s))


@pytest.mark.slow
def test_gradients_of_the_location(gradients_agree):
    grid = make_grid((-1.0, -1.0), (5.0, 1.0), 1.0)
    heard = jnp.asarray(RNG.random((6, 3)) < 0.7).at[0].set(True)

    def place(log_scale_db, log_walk, log_gain, log_lag, rssi):
        to = lambda tree: jax.tree.map(lambda x: x.astype(rssi.dtype), tree)  # noqa: E731
        model = eqx.tree_at(
            lambda m: (m.log_scale_db, m.log_walk_m2_s, m.log_gain_hz, m.log_lag_s),
            to(_location()),
            (log_scale_db, log_walk, log_gain, log_lag),
        )
        path = locate(model, to(grid), _times(6).astype(rssi.dtype), rssi, heard)
        return jnp.concatenate([path.position_m, path.velocity_m_s, path.std_m], axis=-1)

    rssi = _rssi(np.stack([np.linspace(1, 3, 6), np.zeros(6)], axis=-1)).astype(float)
    gradients_agree(jax.jit(place), (np.log(5.0), np.log(0.4), np.log(4.0), np.log(0.5), rssi), atol=1e-5, rtol=1e-4)


def test_settings_of_a_location_are_checked():
    with pytest.raises(ValueError, match="walk_m2_s is 0"):
        _location(walk_m2_s=0.0)
    with pytest.raises(ValueError, match="expected low below high"):
        make_grid((0.0, 0.0), (0.0, 1.0))


# Association


def numpy_forward(model, time_s, rows, identity, observed):
    """The forward algorithm with an explicit transition matrix between the states there were and there are."""
    switch = float(np.exp(model.log_switch_hz))
    out, before, held = [], None, None
    for t in range(len(time_s)):
        there = np.concatenate([[True], identity[t] > 0])
        num = there.sum()
        elapsed = time_s[t] - time_s[max(t - 1, 0)]
        if before is None:
            prior = there / num
        else:
            matrix = np.zeros((len(there), len(there)))
            same = np.concatenate([[True], (identity[t] > 0) & (identity[t] == held)])
            for i in range(len(there)):
                matrix[i] = np.eye(len(there))[i] if same[i] else there / num
            prior = before @ matrix
        stay = np.exp(-switch * elapsed) if num > 1 else 1.0
        mix = np.where(np.eye(len(there), dtype=bool), stay, (1 - stay) / max(num - 1, 1)) * np.outer(there, there)
        alpha = prior @ mix
        alpha = alpha * np.where(there, np.exp(rows[t]) if observed[t] else 1.0, 0.0)
        before, held = alpha / alpha.sum(), identity[t]
        out.append((before, np.log(alpha.sum()) if observed[t] else 0.0))
    return np.array([p for p, _ in out]), np.array([e for _, e in out])


def _random_case(rng, num_times=25, num_slots=3):
    identity = rng.integers(0, 4, (num_times, num_slots)) * (rng.random((num_times, num_slots)) < 0.8)
    identity = np.repeat(identity[::4], 4, axis=0)[:num_times]
    rows = rng.normal(scale=2.0, size=(num_times, 1 + num_slots))
    return np.cumsum(rng.uniform(0.02, 0.2, num_times)), rows, identity, rng.random(num_times) < 0.7


def _run_filter(model, time_s, rows, identity, observed):
    return forward_filter(
        model,
        jnp.asarray(time_s, jnp.float32),
        jnp.asarray(rows, jnp.float32),
        jnp.asarray(identity, jnp.int32),
        jnp.asarray(observed),
    )


@pytest.mark.parametrize("seed", range(5))
def test_the_filter_is_the_forward_algorithm(seed):
    model = make_association(switch_hz=0.7)
    case = _random_case(np.random.default_rng(seed))
    found = _run_filter(model, *case)
    probability, evidence = numpy_forward(model, *case)
    np.testing.assert_allclose(found.probability, probability, atol=2e-5)
    np.testing.assert_allclose(found.log_evidence, evidence, atol=2e-4)
    np.testing.assert_allclose(np.sum(found.probability, axis=1), 1.0, rtol=1e-5)


def test_without_observations_two_states_relax_to_even_shares():
    model = make_association(switch_hz=0.5)
    time_s = np.arange(40) * 0.1
    observed = np.arange(40) == 0
    rows = np.broadcast_to([0.0, 3.0], (40, 2))
    found = _run_filter(model, time_s, rows, np.ones((40, 1), int), observed)
    start = 1 / (1 + np.exp(3.0)) - 0.5
    # Eigenvalue of a two-state chain: each frame keeps 2 exp(-switch dt) - 1 of what is above one half.
    expected = 0.5 + start * (2 * np.exp(-0.05) - 1) ** np.arange(40)
    np.testing.assert_allclose(found.probability[:, 0], expected, atol=1e-5)


def test_the_tag_changes_hands_when_the_evidence_does():
    model = make_association(switch_hz=0.2)
    rows = np.full((60, 3), -4.0)
    rows[:30, 1] = rows[30:, 2] = 0.0
    found = np.asarray(
        _run_filter(model, np.arange(60) * 0.1, rows, np.tile([7, 9], (60, 1)), np.ones(60, bool)).probability
    )
    assert found[29, 1] > 0.99
    assert found[-1, 2] > 0.99
    # One contrary observation does not turn a belief round; two do at these odds.
    assert found[30, 1] > 0.5
    assert np.argmax(found[:, 2] > 0.5) in (31, 32)


def test_a_blob_that_leaves_or_is_replaced_gives_its_share_to_all_alike():
    model = make_association(switch_hz=1e-6)
    rows = np.zeros((3, 3))
    rows[0] = [-9.0, 9.0, -9.0]
    observed = np.array([True, False, False])
    gone = _run_filter(model, np.arange(3) * 0.1, rows, np.array([[1, 2], [0, 2], [0, 2]]), observed).probability
    np.testing.assert_allclose(gone[1], [0.5, 0.0, 0.5], atol=1e-4)
    replaced = _run_filter(model, np.arange(3) * 0.1, rows, np.array([[1, 2], [3, 2], [3, 2]]), observed).probability
    np.testing.assert_allclose(replaced[1], [1 / 3] * 3, atol=1e-4)
    kept = _run_filter(model, np.arange(3) * 0.1, rows, np.array([[1, 2]] * 3), observed).probability
    np.testing.assert_allclose(kept[1], [0.0, 1.0, 0.0], atol=1e-4)


def test_empty_slots_change_nothing():
    model = make_association()
    time_s, rows, identity, observed = _random_case(np.random.default_rng(3), num_slots=2)
    found = _run_filter(model, time_s, rows, identity, observed)
    wide = _run_filter(
        model,
        time_s,
        np.concatenate([rows, np.full((len(rows), 3), 50.0)], axis=1),
        np.concatenate([identity, np.zeros((len(rows), 3), int)], axis=1),
        observed,
    )
    np.testing.assert_allclose(wide.probability[:, :3], found.probability, atol=1e-6)
    np.testing.assert_array_equal(wide.probability[:, 3:], 0)


def test_without_blobs_every_tag_is_background():
    found = _run_filter(
        make_association(), np.arange(4) * 0.1, np.zeros((4, 3)), np.zeros((4, 2), int), np.ones(4, bool)
    )
    np.testing.assert_allclose(found.probability, np.tile([1.0, 0.0, 0.0], (4, 1)), atol=1e-6)


def test_a_row_is_the_gaussians_of_distance_and_speed():
    model = make_association(distance_m=(0.6, 0.9), speed_m_s=0.4, clutter=1e-30)
    row = assignment_row(
        model, jnp.asarray([1.0, 0.5]), jnp.asarray([0.3, -0.2]), jnp.asarray([[0.7, 0.4], [3.0, 0.0]])
    )
    still = multivariate_normal([0, 0], np.diag([0.16, 0.16])).logpdf([0.3, -0.2])
    near = multivariate_normal([0, 0], np.diag([0.36, 0.81]))
    np.testing.assert_allclose(row, [still, near.logpdf([0.3, 0.1]), near.logpdf([-2.0, 0.5])], rtol=1e-5)


def test_wild_observations_stay_finite_and_decide_nothing():
    model = make_association(clutter=1e-3)
    tag = jnp.asarray([[1e6, -1e6]] * 3)
    held = lambda m, t, v: associate(  # noqa: E731
        m, _times(3), t, v, jnp.ones(3, bool), jnp.zeros((3, 2, 2)), jnp.tile(jnp.asarray([1, 2]), (3, 1))
    )
    found = jax.jit(held)(model, tag, tag)
    np.testing.assert_allclose(found.probability, 1 / 3, rtol=1e-3)
    gradient = jax.jit(jax.grad(lambda *x: jnp.sum(held(*x).log_evidence), argnums=(0, 1, 2)))(model, tag, tag)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(gradient))
    zero = jnp.zeros((3, 2))
    gradient = jax.jit(jax.grad(lambda *x: held(*x).probability[-1, 1], argnums=(0, 1, 2)))(model, zero, zero)
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in jax.tree.leaves(gradient))


def test_gradients_of_the_filter(gradients_agree):
    rng = np.random.default_rng(1)
    time_s, _, identity, observed = _random_case(rng, num_times=9, num_slots=2)
    tag, velocity, blob = rng.normal(size=(9, 2)), rng.normal(size=(9, 2)), rng.normal(size=(9, 2, 2))
    start = make_association()

    def held(distance, speed, switch, clutter, tag, velocity, blob):
        model = eqx.tree_at(
            lambda m: (m.log_distance_m, m.log_speed_m_s, m.log_switch_hz, m.log_clutter),
            start,
            (distance, speed, switch, clutter),
        )
        times = jnp.asarray(time_s).astype(tag.dtype)
        out = associate(model, times, tag, velocity, jnp.asarray(observed), blob, jnp.asarray(identity, jnp.int32))
        return jnp.concatenate([out.probability, out.log_evidence[:, None]], axis=1)

    widths = (np.log([0.7, 1.1]), np.log(0.5), np.log(0.4), np.log(0.01))
    gradients_agree(jax.jit(held), (*widths, tag, velocity, blob), atol=1e-5, rtol=1e-4)


def test_jit_is_eager_and_vmap_is_a_loop():
    model = make_association()
    cases = [_random_case(np.random.default_rng(seed)) for seed in range(3)]
    eager = [_run_filter(model, *case) for case in cases]
    columns = [jnp.asarray(np.stack(column)) for column in zip(*cases, strict=True)]
    kinds = (jnp.float32, jnp.float32, jnp.int32, bool)
    columns = [column.astype(kind) for column, kind in zip(columns, kinds, strict=True)]
    mapped = jax.jit(jax.vmap(forward_filter, in_axes=(None, 0, 0, 0, 0)))(model, *columns)
    for number, one in enumerate(eager):
        np.testing.assert_allclose(mapped.probability[number], one.probability, atol=1e-5)
        np.testing.assert_allclose(mapped.log_evidence[number], one.log_evidence, atol=1e-4)


# Alarms and rates


def test_only_blobs_in_the_exit_region_count():
    probability = jnp.asarray([[0.1, 0.7, 0.2], [0.1, 0.2, 0.7], [0.1, 0.0, 0.9]])
    blob_m = jnp.asarray([[[1.0, 0.0], [-0.5, 0.0]], [[-0.1, 0.0], [2.0, 0.0]], [[1.0, 0.0], [-9.0, 0.0]]])
    identity = jnp.asarray([[1, 2], [1, 2], [1, 0]])
    score = exit_score(probability, blob_m, identity, jnp.asarray(0.0))
    np.testing.assert_allclose(score, [0.2, 0.2, 0.0], rtol=1e-6)
    np.testing.assert_array_equal(exit_score(probability[:, :1], blob_m[:, :0], identity[:, :0], jnp.asarray(0.0)), 0.0)


def test_the_rfid_rule_listens_to_one_antenna():
    rssi, heard = jnp.asarray([[-60.0, -50.0], [0.0, -40.0]]), jnp.asarray([[True, True], [False, True]])
    np.testing.assert_array_equal(rssi_score(rssi, heard, 1), [-60.0, -np.inf])
    np.testing.assert_array_equal(rssi_score(rssi, heard, 2), [-50.0, -40.0])


def test_the_curve_counts_and_the_threshold_is_the_best_of_all():
    rng = np.random.default_rng(2)
    moved = rng.random(60) < 0.4
    score = np.round(rng.normal(size=60) + moved, 1)
    score[:5] = -np.inf
    roc = roc_curve(score, moved)
    for threshold, detection, false_alarm in zip(roc.threshold, roc.detection, roc.false_alarm, strict=True):
        assert detection == np.mean(score[moved] >= threshold)
        assert false_alarm == np.mean(score[~moved] >= threshold)
    assert roc.detection[0] == roc.false_alarm[0] == 0
    assert roc.detection[-1] == roc.false_alarm[-1] == 1
    chosen = best_threshold(roc)
    gain = np.mean(score[moved] >= chosen) - np.mean(score[~moved] >= chosen)
    finite = score[np.isfinite(score)]
    assert gain == max(np.mean(score[moved] >= t) - np.mean(score[~moved] >= t) for t in [np.inf, *finite])
    with pytest.raises(ValueError, match="0 of 3 tags enter"):
        roc_curve(np.zeros(3), np.zeros(3, bool))


def test_a_threshold_lies_between_what_it_tells_apart():
    assert best_threshold(roc_curve(np.array([-70.0, -60.0]), np.array([False, True]))) == -65.0
    assert best_threshold(roc_curve(np.array([-np.inf, -60.0]), np.array([False, True]))) == -60.0


def test_operating_point_is_the_lowest_threshold_with_that_few_false_alarms():
    score = np.array([5.0, 4.0, 3.0, 2.0, 1.0, -np.inf, -np.inf])
    moved = np.array([True, False, True, False, True, False, True])
    roc = roc_curve(score, moved)
    assert operating_point(roc, 0.0) == (0.25, 0.0)
    np.testing.assert_allclose(operating_point(roc, 1 / 3), (0.5, 1 / 3))
    np.testing.assert_allclose(operating_point(roc, 0.6), (0.5, 1 / 3))
    # Tags that were never heard are not alarmed, however many false alarms are allowed.
    np.testing.assert_allclose(operating_point(roc, 1.0), (0.75, 2 / 3))
    unheard = roc_curve(np.array([-np.inf, -np.inf]), np.array([True, False]))
    assert operating_point(unheard, 1.0) == (0.0, 0.0)


def test_intervals_are_scipys():
    for count, total in ((3, 40), (40, 40), (0, 7)):
        expected = binomtest(count, total).proportion_ci(0.95, method="wilson")
        np.testing.assert_allclose(interval(count / total, total), (expected.low, expected.high), atol=1e-4)


# What both sensors see: a floor seen from above, people as squares


HEIGHT, WIDTH, FOCAL, CEILING_M = 120, 64, 40.0, 3.0
RATE_HZ = 10.0
LENS = Intrinsics(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)
# The camera looks down at the middle of the floor; room x is up in the picture, y is left.
EXIT = (0.0, 2.1, 0.2)  # camera frame: antenna 1, 0.2 m below the camera
ANTENNAS_M = np.array([EXIT, (0.0, 0.0, 0.2), (0.0, -2.1, 0.2)])
TALL_M = 1.7


def _camera_point(room: np.ndarray, height_m: float) -> np.ndarray:
    """Room (x, y) below antenna 1 to the camera frame."""
    return np.array([-room[1], EXIT[1] - room[0], CEILING_M - height_m])


def _drawing(people: list[np.ndarray], colours: list[tuple[int, int, int]], noise: np.random.Generator):
    """Picture and depth of flat squares of 0.6 m at half a person's height, with a shadow beside each."""
    rows, columns = np.mgrid[:HEIGHT, :WIDTH]
    floor = (120 + 40 * ((rows // 6 + columns // 6) % 2))[..., None] * np.array([1.0, 0.95, 0.9])
    depth = np.full((HEIGHT, WIDTH), CEILING_M, np.float32)
    boxes = []
    for place, colour in zip(people, colours, strict=True):
        point = _camera_point(place, TALL_M / 2)
        u, v = FOCAL * point[:2] / point[2] + (LENS.cx_px, LENS.cy_px)
        half = 0.3 * FOCAL / point[2]
        shade = (np.abs(columns - u - 2 * half) <= half) & (np.abs(rows - v) <= half)
        floor[shade] *= 0.7
        inside = (np.abs(columns - u) <= half) & (np.abs(rows - v) <= half)
        floor[inside] = np.array(colour) * (0.8 + 0.2 * ((rows[inside] // 2) % 2))[:, None]
        depth[inside] = point[2]
        boxes.append(inside)
    picture = np.clip(floor + noise.normal(0, 2, floor.shape), 0, 255).astype(np.uint8)
    return picture, depth, boxes


def drawn_shop(
    walks: dict[str, np.ndarray],
    still: dict[str, tuple[float, float]],
    *,
    num_frames: int = 70,
    strangers: tuple[np.ndarray, ...] = (),
    name: str = "drawn",
    seed: int = 0,
) -> Recording:
    """Tags on walks (their EPCs name who walks), tags at rest, and people without any tag."""
    rng = np.random.default_rng(seed)
    paths = [*walks.values(), *strangers]
    palette = [(200, 40, 40), (30, 60, 200), (30, 160, 60)]
    colour, depth, labels = [], [], []
    for frame in range(num_frames):
        picture, distance, masks = _drawing([path[frame] for path in paths], palette[: len(paths)], rng)
        colour.append(picture)
        depth.append(distance)
        label = np.zeros((HEIGHT, WIDTH), np.uint8)
        for number, mask in enumerate(masks, start=1):
            label[mask] = number
        labels.append(label)
    time_ns = (np.arange(num_frames) / RATE_HZ * 1e9).astype(np.int64)
    where = {**walks, **{epc: np.broadcast_to(place, (num_frames, 2)) for epc, place in still.items()}}
    rows: list[tuple] = []
    for number, (epc, path) in enumerate(where.items()):
        stamp = np.arange(0.003 * number, num_frames / RATE_HZ, 1 / 45)
        place = np.stack([np.interp(stamp, time_ns * 1e-9, path[:, axis]) for axis in (0, 1)], axis=-1)
        level = _rssi(place)
        for read, second in enumerate(stamp):
            antenna = read // 2 % 3
            rssi = level[read, antenna] + rng.normal(0, 1.0)
            if rssi > -77.5:
                rows.append((epc, int(second * 1e9), antenna + 1, rssi))
    rows.sort(key=lambda row: row[1])
    reads = TagReads(
        epc=np.array([row[0] for row in rows], dtype="<U24"),
        time_ns=np.array([row[1] for row in rows], np.int64),
        antenna=np.array([row[2] for row in rows], np.int16),
        carrier_hz=np.full(len(rows), 915e6),
        phase_rad=np.zeros(len(rows)),
        rssi_dbm=np.array([row[3] for row in rows], np.float32),
        doppler_hz=np.full(len(rows), np.nan, np.float32),
    )
    truth = Truth(
        labels=np.stack(labels),
        tag_to_label={epc: number for number, epc in enumerate(walks, start=1)},
        tag_position_m={epc: np.stack([_camera_point(p, 1.0) for p in path]) for epc, path in where.items()},
    )
    return Recording(
        colour=np.stack(colour),
        depth=np.stack(depth),
        time_ns=time_ns,
        intrinsics=LENS,
        reads=reads,
        antennas_m=ANTENNAS_M,
        truth=truth,
        name=name,
    )


def straight(start: tuple[float, float], end: tuple[float, float], num_frames: int = 70, wait: int = 5) -> np.ndarray:
    share = np.clip((np.arange(num_frames) - wait) / (num_frames - wait - 5), 0, 1)[:, None]
    return (1 - share) * np.array(start) + share * np.array(end)


LOOKING_DOWN = GollerSettings(blobs=BlobSettings(position="centre", area_m2=(0.05, 1.0)), cell_m=0.4)


@pytest.fixture(scope="module")
def shop() -> Recording:
    return drawn_shop({"leaver": straight((4.6, 0.3), (-1.6, 0.3))}, {"shelf": (2.6, -1.0), "near": (0.6, -1.0)})


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return Calibration(_location(), make_association(), jnp.asarray(0.5), jnp.asarray(-62.0))


def test_the_room_frame_lies_below_the_antennas(shop):
    site = find_site(shop)
    room = site.to_room(ANTENNAS_M)
    np.testing.assert_allclose(room, [[0, 0, 2.8], [2.1, 0, 2.8], [4.2, 0, 2.8]], atol=0.01)
    np.testing.assert_allclose(site.to_camera(room), ANTENNAS_M, atol=1e-9)
    np.testing.assert_allclose(site.axes @ site.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(site.axes) > 0
    point = np.array([1.3, -0.4])
    camera = site.to_camera(np.append(point, 0.85)[None])[0]
    pixel = FOCAL * camera[:2] / camera[2] + np.array([LENS.cx_px, LENS.cy_px])
    np.testing.assert_allclose(site.pixel_on_plane(pixel[None], LENS, 0.85)[0], point, atol=1e-6)
    assert np.isnan(site.pixel_on_plane(pixel[None], LENS, 10.0)).all()


def test_a_level_camera_needs_no_depth():
    # Looks along the room, 20 degrees down, from 2.5 m above the floor and 1 m before antenna 1.
    tilt = np.deg2rad(20.0)
    axes = np.array([[0.0, np.sin(tilt), np.cos(tilt)], [-1.0, 0.0, 0.0], [0.0, -np.cos(tilt), np.sin(tilt)]])
    axes[0], axes[2] = [0.0, np.sin(tilt), np.cos(tilt)], [0.0, -np.cos(tilt), np.sin(tilt)]
    truth = Site(np.zeros(3), axes)
    room = np.array([[0.0, 0.0, 2.8], [2.1, 0.0, 2.8], [4.2, 0.0, 2.8]])
    offset = np.array([1.0, 0.0, -2.5])
    antennas_m = (room + offset) @ truth.axes
    site = level_site(antennas_m, 2.8)
    np.testing.assert_allclose(site.axes, axes, atol=1e-9)
    np.testing.assert_allclose(site.to_room(antennas_m), room, atol=1e-9)
    with pytest.raises(ValueError, match="at least 2 are needed"):
        level_site(antennas_m[:1], 2.8)
    with pytest.raises(ValueError, match="positive height"):
        level_site(antennas_m, 0.0)


def test_a_recording_without_floor_is_refused(shop):
    wall = dataclasses.replace(shop, antennas_m=np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 6.0]]))
    with pytest.raises(RecordingError, match=r"no floor found|upright"):
        find_site(wall)
    with pytest.raises(RecordingError, match="no floor found"):
        find_site(dataclasses.replace(shop, depth=np.zeros_like(shop.depth)))


def test_rssi_means_are_those_of_the_period():
    rng = np.random.default_rng(4)
    count = 200
    reads = dataclasses.replace(
        TagReads.empty(),
        epc=rng.choice(["a", "b"], count),
        time_ns=np.sort(rng.integers(0, 3_000_000_000, count)),
        antenna=rng.integers(1, 3, count).astype(np.int16),
        carrier_hz=np.full(count, 915e6),
        phase_rad=np.zeros(count),
        rssi_dbm=np.where(rng.random(count) < 0.1, np.nan, rng.uniform(-75, -50, count)).astype(np.float32),
        doppler_hz=np.zeros(count, np.float32),
    )
    frames = np.arange(0, 3_000_000_000, 100_000_000)
    found = rssi_frames(reads, ["b", "a", "c"], frames, 2, period_s=0.3)
    for frame, now in enumerate(frames):
        for tag, epc in enumerate(["b", "a", "c"]):
            for antenna in range(2):
                mine = (reads.epc == epc) & (reads.antenna == antenna + 1) & np.isfinite(reads.rssi_dbm)
                mine &= (reads.time_ns <= now) & (reads.time_ns > now - 300_000_000)
                assert found.heard[frame, tag, antenna] == mine.any()
                if mine.any():
                    np.testing.assert_allclose(
                        found.rssi_dbm[frame, tag, antenna], reads.rssi_dbm[mine].mean(), rtol=1e-4
                    )
    with pytest.raises(ValueError, match="period_s is 0"):
        rssi_frames(reads, ["a"], frames, 2, period_s=0.0)


def _track(recording: Recording, settings: BlobSettings, warm: bool = True):
    tracker = BlobTracker(settings, find_site(recording), recording.intrinsics)
    if warm:
        tracker.warm_up(empty_picture(recording))
    times = recording.frame_time_s()
    return [
        tracker.step(recording.colour[t], recording.depth_metres(t), float(times[t]))
        for t in range(recording.num_frames)
    ]


@pytest.mark.parametrize("position", ["centre", "depth"])
def test_a_walker_is_one_blob_where_it_is_without_its_shadow(shop, position):
    out = _track(shop, dataclasses.replace(LOOKING_DOWN.blobs, position=position))
    path = straight((4.6, 0.3), (-1.6, 0.3))
    names = {blob.identity for blobs, _ in out for blob in blobs}
    assert len(names) == 1
    seen = [t for t, (blobs, _) in enumerate(out) if blobs]
    # It counts once it has gone 0.3 m from where it was, and until it is gone.
    assert np.linalg.norm(path[seen[0]] - path[0]) < 0.55
    assert len(seen) > 55
    errors = [np.linalg.norm(out[t][0][0].position_m - path[t]) for t in seen if path[t, 0] > -1.2]
    assert np.mean(errors) < 0.1
    for t in seen[5:-12]:
        truth = np.asarray(shop.truth.labels[t]) == 1
        mine = out[t][1] == out[t][0][0].identity
        assert (mine & truth).sum() / (mine | truth).sum() > 0.7


def test_a_camera_along_the_room_finds_feet_and_cut_off_people():
    tilt = np.deg2rad(25.0)
    axes = np.array([[0.0, np.sin(tilt), np.cos(tilt)], [-1.0, 0.0, 0.0], [0.0, -np.cos(tilt), np.sin(tilt)]])
    lens = Intrinsics(120.0, 120.0, 79.5, 59.5, 160, 120)
    # The camera's centre, 2.5 m up, is the camera frame's origin.
    site = Site(-axes.T @ np.array([-1.0, 0.0, 2.5]), axes)
    tracker = BlobTracker(BlobSettings(), site, lens)

    def pixel(room):
        point = site.to_camera(np.array([room]))[0]
        return lens.fx_px * point[0] / point[2] + lens.cx_px, lens.fy_px * point[1] / point[2] + lens.cy_px

    nothing = np.zeros((120, 160))
    (u, foot), (_, head) = pixel([3.0, 0.2, 0.0]), pixel([3.0, 0.2, 1.7])
    box = (round(u) - 8, round(head), 17, round(foot) - round(head) + 1)
    place = tracker.place(box, nothing > 0, nothing)
    assert place is not None
    np.testing.assert_allclose(place, [3.0, 0.2], atol=0.06)
    u, head = pixel([0.3, -0.2, 1.7])
    assert pixel([0.3, -0.2, 0.0])[1] > 120
    box = (round(u) - 20, round(head), 41, 120 - round(head))
    place = tracker.place(box, nothing > 0, nothing)
    assert place is not None
    np.testing.assert_allclose(place, [0.3, -0.2], atol=0.06)


def test_the_empty_picture_has_nobody_in_it_even_where_people_are_for_half_of_the_time():
    num = 60
    walk = straight((4.6, 0.3), (-1.6, 0.3), num_frames=num)
    recording = drawn_shop({"a": walk}, {}, num_frames=num)
    clean = np.asarray(drawn_shop({}, {"x": (0.0, 0.0)}, num_frames=1, seed=9).colour)[0].astype(float)
    crowded = np.array(recording.colour)
    # Whatever passes there is of many colours; the floor shows for less than half of the time.
    crowded[1::2, 40:60, 20:40] = np.random.default_rng(1).integers(0, 255, (num // 2, 20, 20, 3))
    crowded[:6, 40:60, 20:40] = 250
    for pictures in (recording.colour, crowded):
        found = empty_picture(dataclasses.replace(recording, colour=pictures)).astype(float)
        assert np.abs(found - clean).mean() < 3.0
        assert np.mean(np.abs(found - clean).max(axis=-1) > 20) < 0.005
    one = dataclasses.replace(recording, colour=crowded[:1], depth=recording.depth[:1], time_ns=recording.time_ns[:1])
    np.testing.assert_array_equal(empty_picture(one), crowded[0])


def test_who_crosses_keeps_the_name():
    there, back = straight((4.4, 0.5), (0.2, 0.5)), straight((0.2, -0.5), (4.4, -0.5))
    recording = drawn_shop({"a": there}, {}, strangers=(back,))
    out = _track(recording, LOOKING_DOWN.blobs)
    names = []
    for path in (there, back):
        near = [
            min(blobs, key=lambda blob: np.linalg.norm(blob.position_m - path[t])).identity
            for t, (blobs, _) in enumerate(out)
            if len(blobs) == 2
        ]
        assert len(set(near)) == 1
        names.append(near[0])
    assert names[0] != names[1]


def test_what_stands_still_or_has_the_wrong_size_is_no_blob(shop):
    still = drawn_shop({"a": np.broadcast_to([2.0, 0.0], (40, 2))}, {}, num_frames=40)
    empty = np.asarray(drawn_shop({}, {"x": (0.0, 0.0)}, num_frames=1).colour)[0]
    tracker = BlobTracker(LOOKING_DOWN.blobs, find_site(still), LENS)
    tracker.warm_up(empty)
    assert not any(tracker.step(still.colour[t], still.depth_metres(t), t / RATE_HZ)[0] for t in range(40))
    assert not any(blobs for blobs, _ in _track(shop, dataclasses.replace(LOOKING_DOWN.blobs, area_m2=(1.0, 2.0))))
    assert not any(blobs for blobs, _ in _track(shop, dataclasses.replace(LOOKING_DOWN.blobs, area_m2=(0.001, 0.01))))


def test_no_blob_is_faster_than_the_limit(shop):
    out = _track(shop, dataclasses.replace(LOOKING_DOWN.blobs, max_speed_m_s=0.5, min_travel_m=0.2))
    places = np.array([blobs[0].position_m for blobs, _ in out if blobs])
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert steps.max() <= 0.5 / RATE_HZ + 1e-9
    assert steps.max() > 0.04


def test_settings_of_blobs_are_checked():
    with pytest.raises(ValueError, match="area_m2 is"):
        BlobSettings(area_m2=(1.0, 0.5))
    with pytest.raises(ValueError, match="history is 0"):
        BlobSettings(history=0)


def test_slots_keep_their_blob_and_count_what_does_not_fit():
    from tagjax.baselines.goller._blobs import Blob

    blob = lambda name: Blob(name, (name, 0, 2, 3), np.array([float(name), 0.0]))  # noqa: E731
    tracks = in_slots([[blob(1), blob(2)], [blob(2), blob(3)], [blob(3), blob(2), blob(4)], []], 2)
    np.testing.assert_array_equal(tracks.identity, [[1, 2], [3, 2], [3, 2], [0, 0]])
    assert tracks.num_dropped == 1
    np.testing.assert_array_equal(tracks.box_px[1, 0], [3, 0, 4, 2])
    assert np.isnan(tracks.box_px[3]).all()
    np.testing.assert_array_equal(in_slots([[blob(5)]], 2, before=(0, 5)).identity, [[0, 5]])
    with pytest.raises(ValueError, match="num_slots is 0"):
        in_slots([[]], 0)


# The whole


def _beyond_the_line(walk: np.ndarray) -> np.ndarray:
    """Frames of a walker's first metre of the exit region."""
    frames = np.flatnonzero((walk[:, 0] < 0.0) & (walk[:, 0] > -1.0))
    assert len(frames) > 8
    return frames


def test_the_leaver_is_alarmed_and_still_tags_are_not(shop, calibration):
    seen = observe(shop, LOOKING_DOWN)
    decision = decide(calibration, seen, LOOKING_DOWN)
    score = dict(zip(seen.epcs, np.max(np.asarray(decision.exit_score), axis=1), strict=True))
    assert score["leaver"] > 0.9
    assert score["shelf"] < 0.1
    assert score["near"] < 0.2
    states = true_states(seen, carried(shop))
    leaver = seen.epcs.index("leaver")
    best = np.argmax(np.asarray(decision.probability[leaver]), axis=1)
    # Location by proximity rests at each antenna until the next one is the stronger: there a walker's tag counts as
    # background (Eq. 4). Beyond the line, where alarms are due, it has just come off the last but one.
    beyond = _beyond_the_line(straight((4.6, 0.3), (-1.6, 0.3)))
    assert np.all(states[leaver][beyond] > 0)
    np.testing.assert_array_equal(best[beyond], states[leaver][beyond])
    speed = np.linalg.norm(np.asarray(decision.location.velocity_m_s[leaver]), axis=1)
    resting = (states[leaver] > 0) & (speed < 0.3)
    assert resting.sum() > 5
    assert not best[resting].any()
    found = outcomes(calibration, "sp_st_still", seen, carried(shop), LOOKING_DOWN)
    counted = rates(found, "fused", 0.5)
    assert (counted.num_runs, counted.num_leaves, counted.num_still, counted.num_stays) == (1, 1, 2, 0)
    assert (counted.detected_run, counted.detected, counted.false_alarm) == (1.0, 1.0, 0.0)
    assert np.isnan(counted.false_alarm_stays)


def test_with_true_places_a_tag_is_its_carriers_all_the_way(shop, calibration):
    """What a walk's middle misses is location by proximity: the association itself loses no frame of it."""
    seen, truth = observe(shop, LOOKING_DOWN), carried(shop)
    states = true_states(seen, truth)
    for epc in seen.epcs:
        row, tag = seen.epcs.index(epc), truth.epcs.index(epc)
        path = truth.position_m[tag].astype(np.float32)
        velocity = np.gradient(path, seen.time_s, axis=0).astype(np.float32)
        held = associate(
            calibration.association,
            jnp.asarray(seen.time_s),
            jnp.asarray(path),
            jnp.asarray(velocity),
            jnp.asarray(seen.rssi.heard[:, row].any(axis=1)),
            jnp.asarray(seen.blobs.position_m),
            jnp.asarray(seen.blobs.identity),
        )
        known = states[row] >= 0
        best = np.argmax(np.asarray(held.probability), axis=1)
        # A walker whom the vision has just found takes the tag over from the background: half a second at most.
        begun = np.cumsum(known & (states[row] > 0)) > 5
        counts = known & (begun | (states[row] == 0))
        assert counts.sum() > 40
        np.testing.assert_array_equal(best[counts], states[row][counts])


def test_the_truth_in_a_sensors_stead_lifts_what_that_sensor_missed(shop, calibration):
    seen, truth = observe(shop, LOOKING_DOWN), carried(shop)
    good = [("sp_st_still", seen, truth)]
    rungs = ladder(calibration, good, good, LOOKING_DOWN)
    assert set(rungs) == {"as it is", "true blobs", "true places of tags", "both"}
    for row in rungs.values():
        assert (row["all"].detected, row["all"].false_alarm) == (1.0, 0.0)
        assert (row["sp_st_still"].num_leaves, row["sp_st_still"].num_still) == (1, 2)

    def detected(faulty):
        # The threshold is that of sound recordings.
        found = ladder(calibration, good, [("sp_st_still", faulty, truth)], LOOKING_DOWN)
        return [found[name]["all"].detected for name in ("as it is", "true blobs", "true places of tags", "both")]

    blind = dataclasses.replace(seen, blobs=dataclasses.replace(seen.blobs, identity=0 * seen.blobs.identity))
    assert detected(blind) == [0.0, 1.0, 0.0, 1.0]
    # Only the far antenna is told to have heard anything: no tag ever seems to move.
    far = np.any(seen.rssi.heard, axis=2, keepdims=True) & (np.arange(3) == 2)
    deaf = dataclasses.replace(seen, rssi=RssiFrames(np.where(far, np.float32(-60.0), np.float32(0.0)), far))
    assert detected(deaf) == [0.0, 0.0, 1.0, 1.0]


def _handed_over(renamed: bool):
    """Times, the tag's path and two people's blobs: the tag goes from one to the other at 4 s, rests from 8 s on."""
    time_s = np.arange(0, 12, 0.1)
    giver = np.interp(time_s, [0.5, 3.5, 4.5, 8.0], [0.0, 2.0, 2.0, 0.0])
    taker = np.interp(time_s, [0.0, 3.5, 4.5, 8.0], [5.0, 2.6, 2.6, 5.0])
    tag = np.where(time_s < 4.0, giver + 0.3, taker - 0.3)
    tag = np.interp(time_s, [0.5, 3.5, 4.5, 8.0], [0.3, 2.2, 2.4, 4.7])
    identity = np.tile([1, 2], (len(time_s), 1))
    if renamed:
        identity[time_s > 6.0, 1] = 5
    place = np.stack([np.stack([x, np.full(len(x), y)], axis=-1) for x, y in ((giver, 0.3), (taker, -0.3))], axis=1)
    box = np.full((*identity.shape, 4), np.nan, np.float32)
    blobs = BlobTracks(identity.astype(np.int32), place.astype(np.float32), box, 0)
    return time_s, np.stack([tag, np.zeros(len(tag))], axis=-1), blobs


@pytest.mark.parametrize("renamed", [False, True])
def test_a_hand_over_is_followed_by_role(renamed):
    time_s, path, blobs = _handed_over(renamed)
    state = np.select([time_s < 4.75, time_s < 9.05], [1, 2], 0)
    found = follow(time_s, path, 0.1 / 3 + 0.9 * np.eye(3)[state], blobs)
    assert found is not None
    assert 3.5 < found.taken_s < 4.5
    assert found.rest_s == pytest.approx(8.0, abs=0.11)
    assert found.taken_s + found.delay_s == pytest.approx(4.8, abs=0.11)
    assert found.rest_s + found.rest_delay_s == pytest.approx(9.1, abs=0.11)
    np.testing.assert_allclose(found.probability.sum(axis=1), 1.0, atol=1e-6)
    np.testing.assert_allclose(found.probability[:, 2], 0.1 / 3 + 0.9 * (state == 2), atol=1e-6)
    times, mean, deviation = mean_curve([found, found])
    np.testing.assert_allclose(deviation, 0, atol=1e-9)
    assert mean[np.searchsorted(times, -1.0), 1] > 0.9
    never = follow(time_s, path, np.tile([0.2, 0.5, 0.3], (len(time_s), 1)), blobs)
    assert never is not None
    assert np.isnan(never.delay_s)
    assert np.isnan(never.rest_delay_s)


def test_a_tag_that_nobody_hands_over_is_not_followed():
    time_s, path, blobs = _handed_over(False)
    even = np.full((len(time_s), 3), 1 / 3)
    assert follow(time_s, np.zeros_like(path), even, blobs) is None
    alone = dataclasses.replace(blobs, identity=np.where(blobs.identity == 2, 0, blobs.identity))
    assert follow(time_s, path, even, alone) is None


def test_rates_count_runs_and_tags(shop, calibration):
    seen = observe(shop, LOOKING_DOWN)
    one = outcomes(calibration, "sp_st_still", seen, carried(shop), LOOKING_DOWN)[0]
    made = [
        dataclasses.replace(one, recording=name, kind=kind, fused=score)
        for name, kind, score in [
            ("r", "leaves", 0.9), ("r", "leaves", 0.1), ("s", "leaves", 0.2), ("s", "still", 0.7), ("t", "still", 0.1),
            ("t", "stays", 0.8), ("t", "stays", 0.4), ("t", "stays", 0.4),
        ]
    ]  # fmt: skip
    counted = rates(made, "fused", 0.5)
    assert (counted.num_runs, counted.detected_run) == (2, 0.5)
    np.testing.assert_allclose(
        [counted.detected, counted.false_alarm, counted.false_alarm_stays], [1 / 3, 1 / 2, 1 / 3]
    )
    fused, _ = thresholds(made)
    assert fused == pytest.approx(0.85)


def test_more_tags_than_blobs_share_one_and_blobs_without_tags_are_nobodys(calibration):
    walk = straight((4.6, 0.4), (-1.6, 0.4))
    other = straight((0.4, -0.6), (4.4, -0.6))
    recording = drawn_shop({"a": walk}, {}, strangers=(other,))
    twins = recording.reads[recording.reads.epc == "a"]
    twins = dataclasses.replace(twins, epc=np.full(twins.num_reads, "b", "<U24"), time_ns=twins.time_ns + 1)
    both = dataclasses.replace(
        recording.reads,
        **{
            field.name: np.concatenate([getattr(recording.reads, field.name), getattr(twins, field.name)])
            for field in dataclasses.fields(twins)
            if isinstance(getattr(twins, field.name), np.ndarray)
        },
    )
    both = both[np.argsort(both.time_ns, kind="stable")]
    seen = observe(recording.with_reads(both), LOOKING_DOWN)
    decision = decide(calibration, seen, LOOKING_DOWN)
    best = np.argmax(np.asarray(decision.probability), axis=2)
    assert seen.epcs == ("a", "b")
    assert np.mean(best[0] == best[1]) > 0.95
    beyond = _beyond_the_line(walk)
    carrier = np.argmin(np.linalg.norm(seen.blobs.position_m[50] - walk[50], axis=1))
    np.testing.assert_array_equal(best[:, beyond], 1 + carrier)


def test_no_tags_and_no_blobs_are_defined(shop, calibration):
    silent = shop.with_reads(TagReads.empty())
    seen = observe(silent, LOOKING_DOWN)
    assert seen.epcs == ()
    assert seen.blobs.identity.any()
    found = outcomes(calibration, "x", seen, carried(shop), LOOKING_DOWN)
    assert [one.fused for one in found] == [0.0] * 3
    assert not any(one.read or np.isfinite(one.rfid) for one in found)
    still = dataclasses.replace(shop, colour=np.repeat(np.asarray(shop.colour)[:1], shop.num_frames, axis=0))
    decision = decide(calibration, observe(still, LOOKING_DOWN), LOOKING_DOWN)
    np.testing.assert_allclose(decision.probability[..., 0], 1.0, rtol=1e-6)
    np.testing.assert_array_equal(decision.exit_score, 0.0)


def test_one_sample_is_defined(shop, calibration):
    first = dataclasses.replace(
        shop, colour=shop.colour[:1], depth=shop.depth[:1], time_ns=shop.time_ns[:1], reads=shop.reads[:1]
    )
    seen = observe(first, LOOKING_DOWN)
    decision = decide(calibration, seen, LOOKING_DOWN)
    assert decision.probability.shape == (1, 1, 7)
    assert np.isfinite(np.asarray(decision.probability)).all()


def test_another_number_of_antennas_is_refused(shop, calibration):
    fewer = dataclasses.replace(shop, antennas_m=ANTENNAS_M[:2], reads=shop.reads[shop.reads.antenna < 3])
    with pytest.raises(ValueError, match="2 antennas, calibrated are 3"):
        decide(calibration, observe(fewer, LOOKING_DOWN), LOOKING_DOWN)
    assert "calibrated are 3" in (GollerTracer(calibration, LOOKING_DOWN).inapplicable(fewer) or "")


def _grid_recording() -> Recording:
    """A tag that rests 1 s at each point of a grid, without people."""
    places = _grid(0.7)
    path = np.repeat(places, 11, axis=0)
    recording = drawn_shop({}, {"x": (0.0, 0.0)}, num_frames=2)
    num = len(path)
    made = drawn_shop({}, {}, num_frames=2)
    assert made.reads.num_reads == 0
    rng = np.random.default_rng(5)
    stamp = np.arange(0, num / RATE_HZ, 1 / 60)
    at = path[np.minimum((stamp * RATE_HZ).astype(int), num - 1)]
    antenna = np.arange(len(stamp)) % 3
    rssi = _rssi(at)[np.arange(len(stamp)), antenna] + rng.normal(0, 1.0, len(stamp))
    heard = rssi > -77.5
    count = int(heard.sum())
    reads = dataclasses.replace(
        TagReads.empty(),
        epc=np.full(count, "grid", "<U24"),
        time_ns=(stamp[heard] * 1e9).astype(np.int64),
        antenna=(antenna[heard] + 1).astype(np.int16),
        carrier_hz=np.full(count, 915e6),
        phase_rad=np.zeros(count),
        rssi_dbm=rssi[heard].astype(np.float32),
        doppler_hz=np.zeros(count, np.float32),
    )
    return dataclasses.replace(
        recording,
        colour=np.repeat(np.asarray(recording.colour)[:1], num, axis=0),
        depth=np.repeat(np.asarray(recording.depth)[:1], num, axis=0),
        time_ns=(np.arange(num) / RATE_HZ * 1e9).astype(np.int64),
        reads=reads,
        truth=Truth(tag_position_m={"grid": np.stack([_camera_point(p, 1.0) for p in path])}),
        name="grid",
    )


def test_calibration_from_a_grid_recording_finds_the_antennas(tmp_path):
    recording = _grid_recording()
    statistic = grid_statistic(recording, find_site(recording))
    assert len(statistic.position_m) == len(_grid(0.7))
    found = calibrate(recording)
    model = found.location.antennas
    np.testing.assert_allclose(model.mean_m, [[0, 0], [2.1, 0], [4.2, 0]], atol=0.02)
    np.testing.assert_allclose(np.exp(model.log_scale_m), SCALES, rtol=0.15)
    save_calibration(found, tmp_path / "c.json")
    again = load_calibration(tmp_path / "c.json")
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_without_calibration_it_says_what_to_do(shop, tmp_path):
    with pytest.raises(ValueError, match="Calibrate from a tag grid"):
        load_calibration(tmp_path / "none.json")
    (tmp_path / "bad.json").write_text('{".location.antennas.skew_m": [0.0, 0.0]}')
    with pytest.raises(ValueError, match="expected"):
        load_calibration(tmp_path / "bad.json")
    with pytest.raises(RecordingError, match="Record a tag grid"):
        calibrate(dataclasses.replace(shop, truth=None))
    moving = dataclasses.replace(
        shop, truth=Truth(tag_position_m={"leaver": shop.truth.tag_position_m["leaver"][8:60]})
    )
    with pytest.raises(RecordingError, match="never rests"):
        calibrate(dataclasses.replace(moving, time_ns=shop.time_ns[8:60]))
    with pytest.raises(RecordingError, match="tag_position_m"):
        carried(dataclasses.replace(shop, truth=None))


_SKEW, _MEAN = ".location.antennas.skew_m", ".location.antennas.mean_m"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        (_SKEW, {}, r"no calibration .*skew_m is {}; expected a number for each antenna"),
        (_SKEW, "abc", "no calibration .*is 'abc'"),
        (_SKEW, None, "no calibration .*is None"),
        (".alarm_threshold", "abc", "is 'abc'"),
        (".alarm_threshold", None, "is None"),
        (".alarm_threshold", {}, "is {}"),
        (".alarm_threshold", float("nan"), "1 values that are not finite"),
        (".rssi_threshold_dbm", float("-inf"), "not finite"),
        (".rssi_threshold_dbm", 1e300, "not finite"),
        (_MEAN, [[0.0, 0.0], [1.0], [2.0, 0.0]], r"expected numbers of shape \(3, 2\)"),
        (_MEAN, [[0.0, 0.0]], r"has shape \(1, 2\); expected numbers of shape \(3, 2\)"),
    ],
)
def test_a_damaged_calibration_is_refused_by_name(calibration, tmp_path, name, value, message):
    path = str(tmp_path / "calibration.json")
    save_calibration(calibration, path)
    values = json.loads(Path(path).read_text())
    assert name in values
    for one, other in zip(jax.tree.leaves(load_calibration(path)), jax.tree.leaves(calibration), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)
    Path(path).write_text(json.dumps({**values, name: value}))
    with pytest.raises(ValueError, match=rf"calibration\.json: .*({message})"):
        load_calibration(path)


@pytest.mark.slow
def test_fitting_lowers_the_loss_and_leaves_the_antennas(shop, calibration):
    examples = [(observe(shop, LOOKING_DOWN), carried(shop))]
    fitted, losses = fit_association(calibration, examples, LOOKING_DOWN, num_steps=12, learning_rate=0.1)
    assert losses[-1] < 0.9 * losses[0]
    np.testing.assert_array_equal(fitted.location.antennas.log_scale_m, calibration.location.antennas.log_scale_m)
    assert float(fitted.association.log_speed_m_s) != float(calibration.association.log_speed_m_s)
    silent = [(observe(shop.with_reads(TagReads.empty()), LOOKING_DOWN), carried(shop))]
    with pytest.raises(ValueError, match="without a read tag"):
        fit_association(calibration, silent, LOOKING_DOWN)


# As a tracer


@pytest.mark.slow
def test_the_tracer_says_what_the_whole_recording_says(shop, calibration):
    tracer = GollerTracer(calibration, LOOKING_DOWN).at(shop)
    said = list(host_trace(tracer, shop))
    seen = observe(shop, LOOKING_DOWN)
    probability = np.asarray(decide(calibration, seen, LOOKING_DOWN).probability)
    leaver = seen.epcs.index("leaver")
    overlap = []
    told = np.argmax(probability[leaver], axis=1) > 0
    # Where alarms are due it is found at every frame.
    assert told[_beyond_the_line(straight((4.6, 0.3), (-1.6, 0.3)))].all()
    for frame, trace in said:
        best = int(np.argmax(probability[leaver, frame]))
        assert bool(trace.detected[leaver]) == (best > 0)
        if best:
            np.testing.assert_allclose(trace.confidence[leaver], probability[leaver, frame, best], atol=1e-4)
            truth = np.asarray(shop.truth.labels[frame]) == 1
            mask = trace.mask[leaver] > 0.5
            overlap.append((mask & truth).sum() / (mask | truth).sum())
            place = find_site(shop).to_room(trace.centre_m[leaver][None].astype(float))[0]
            assert place[2] == pytest.approx(0.85, abs=0.01)
    assert len(overlap) == told.sum()
    assert np.mean(overlap[3:-10]) > 0.7
    assert not any(trace.detected[seen.epcs.index("shelf")] for _, trace in said[10:])


def test_a_tracer_without_commissioning_learns_the_background_itself(calibration):
    # The first frame is the background; who comes in later is a blob all the same.
    walk = straight((7.5, 0.3), (0.3, 0.3), wait=0)
    recording = drawn_shop({"a": walk}, {})
    settings = dataclasses.replace(LOOKING_DOWN, blobs=dataclasses.replace(LOOKING_DOWN.blobs, warm_up="online"))
    tracer = GollerTracer(calibration, settings, site=find_site(recording))
    assert sum(bool(trace.detected[0]) for _, trace in host_trace(tracer, recording)) > 15


def test_a_state_is_stepped_once_and_depth_is_refused(shop, calibration):
    from tagjax.baselines import HostCamera, host_frames

    tracer = GollerTracer(calibration, LOOKING_DOWN).at(shop)
    camera = HostCamera(LENS, ANTENNAS_M, ("leaver",))
    state, frame = tracer.init(camera), next(host_frames(shop, ["leaver"]))
    after, _ = tracer.step(camera, state, frame)
    assert tracer.finish(after) is not None
    with pytest.raises(ValueError, match="stepped already"):
        tracer.step(camera, state, frame)
    with pytest.raises(ValueError, match="sees no depth"):
        GollerTracer(calibration, GollerSettings(blobs=BlobSettings(position="depth")))


def test_recordings_that_it_cannot_do_are_named(shop, calibration):
    tracer = GollerTracer(calibration)
    one = dataclasses.replace(shop, antennas_m=ANTENNAS_M[:1], reads=shop.reads[shop.reads.antenna == 1])
    assert "there is 1" in (tracer.inapplicable(one) or "")
    mute = dataclasses.replace(shop.reads, rssi_dbm=np.full(shop.reads.num_reads, np.nan, np.float32))
    assert "no RSSI" in (tracer.inapplicable(shop.with_reads(mute)) or "")
    blind = dataclasses.replace(shop, depth=np.zeros_like(shop.depth))
    assert tracer.inapplicable(blind) is None  # it sees no depth
    assert next(host_trace(tracer, blind))[0] == 0
    in_rows = dataclasses.replace(shop, antennas_m=np.array([[x, 0.0, 0.0] for x in (0.0, 2.1, 4.2)]))
    assert "picture's rows" in (tracer.inapplicable(in_rows) or "")
    assert tracer.at(shop).inapplicable(shop) is None


# The run


def test_the_configuration_names_every_setting():
    with initialize_config_dir(str(Path(__file__).parents[1].resolve() / "conf"), version_base="1.3"):
        values: Any = OmegaConf.to_container(compose("goller"), resolve=True)
    values.pop("paths")
    config = from_mapping(GollerConfig, values)
    assert config.settings == GollerSettings()
    names = lambda kind: {field.name for field in dataclasses.fields(kind)}  # noqa: E731
    assert set(values) == names(GollerConfig)
    assert set(values["settings"]) == names(GollerSettings)
    assert set(values["settings"]["blobs"]) == names(BlobSettings)


def test_all_that_is_missing_is_named_before_anything_is_observed(tmp_path):
    """With the commands that make it."""

    def opened(path: str) -> Recording:
        raise AssertionError(f"{path} is opened, though something is missing")

    grid, shop = tmp_path / "grid.zarr", tmp_path / "shop_exit"
    config = GollerConfig(grid=str(grid), scenarios=str(shop), handover=str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match=r"suite=shop_grid.*no recording in train/, validation/, test/.*shop_exit"):
        run_goller(config, opened, tmp_path)
    grid.mkdir()
    for split in ("train", "validation", "test"):
        with pytest.raises(ValueError, match=rf"shop_exit: no recording in .*{split}/"):
            run_goller(dataclasses.replace(config, handover=None), opened, tmp_path)
        (shop / split / f"shop_exit-sp_st-{split}-0.zarr").mkdir(parents=True)
    with pytest.raises(ValueError, match=r"handover=.*nowhere: .*simulate suite=shop_handover`"):
        run_goller(config, opened, tmp_path)
    # Where none is named those beside the scenarios are taken, if there are any.
    default = dataclasses.replace(config, handover=None)
    with pytest.raises(AssertionError, match=r"grid\.zarr is opened"):
        run_goller(default, opened, tmp_path)
    assert _handover_paths(default) == []
    there = tmp_path / "shop_handover" / "test" / "shop_handover-all-test-0.zarr"
    there.mkdir(parents=True)
    assert _handover_paths(default) == [str(there)]
    assert _handover_paths(dataclasses.replace(config, handover=str(there))) == [str(there)]
    assert _handover_paths(dataclasses.replace(config, handover=str(there.parents[1]))) == [str(there)]


@pytest.mark.slow
def test_a_run_writes_tables_metrics_and_plots(tmp_path):
    save_recording(_grid_recording(), tmp_path / "grid.zarr")
    leaves, stays = straight((4.6, 0.3), (-1.6, 0.3)), straight((4.6, 0.3), (2.4, 0.3))
    for split in ("train", "validation", "test"):
        for number, walk in enumerate((leaves, stays)):
            name = f"shop-sp_st_still-{split}-{number}"
            recording = drawn_shop({"w": walk}, {"s": (0.6, -1.0), "t": (1.2, -1.0)}, name=name, seed=number)
            save_recording(recording, tmp_path / "shop" / split / f"{name}.zarr")
    config = GollerConfig(
        grid=str(tmp_path / "grid.zarr"),
        scenarios=str(tmp_path / "shop"),
        handover=str(tmp_path / "shop" / "test" / "shop-sp_st_still-test-0.zarr"),
        settings=LOOKING_DOWN,
        fit_steps=4,
    )
    out = tmp_path / "out"
    out.mkdir()
    metrics = run_goller(config, open_recording, out, on_done=lambda name: None)
    assert metrics["num_recordings"] == {"train": 2, "validation": 2, "test": 2}
    assert metrics["table_1"]["fused"]["num_leaves"] == 1
    assert metrics["table_1"]["fused"]["detected"] == 1.0
    for file in ("metrics.json", "outcomes.json", "calibration.json", "tables.md", "roc.png", "antennas.png", "handover.png",
                 "handover_scene.png"):  # fmt: skip
        assert (out / file).stat().st_size > 0
    tables = (out / "tables.md").read_text()
    assert "| RFID + CV | 1 |" in tables
    assert "| RFID + CV, at the paper's P_FA | 1 | 1.000" in tables
    assert set(metrics["table_1_at_papers_false_alarms"]) == {"rfid", "fused"}
    assert "| true blobs | 1.000 / 0.000 | 1.000 / 0.000 |" in tables
    assert metrics["ladder"]["both"]["all"]["detected"] == 1.0
    assert metrics["handover"] == {"num_recordings": 1, "num_followed": 0}
    with pytest.raises(ValueError, match="no recording"):
        run_goller(dataclasses.replace(config, scenarios=str(tmp_path)), open_recording, out, on_done=lambda name: None)
    (tmp_path / "shop" / "test" / "other.zarr").mkdir()
    with pytest.raises(ValueError, match="expected a name"):
        scenario_paths(tmp_path / "shop", "test")
