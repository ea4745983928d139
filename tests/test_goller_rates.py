"""Goller et al.: alarms and rates."""

from __future__ import annotations

import dataclasses

import goller_scenes as scenes
import jax.numpy as jnp
import numpy as np
import pytest

from tagjax.baselines.goller.alarm import best_threshold, exit_score, operating_point, roc_curve, rssi_score
from tagjax.baselines.goller.experiment.rates import Example, outcomes, rate_with_interval, rates, thresholds
from tagjax.baselines.goller.offline import observe
from tagjax.baselines.goller.truth import true_tags


@pytest.fixture(scope="module")
def shop():
    return scenes.shop()


@pytest.fixture(scope="module")
def calibration():
    return scenes.calibration()


def test_only_blobs_in_the_exit_region_count():
    probability = jnp.asarray([[0.1, 0.7, 0.2], [0.1, 0.2, 0.7], [0.1, 0.0, 0.9]])
    blob_m = jnp.asarray([[[1.0, 0.0], [-0.5, 0.0]], [[-0.1, 0.0], [2.0, 0.0]], [[1.0, 0.0], [-9.0, 0.0]]])
    identity = jnp.asarray([[1, 2], [1, 2], [1, 0]])
    score = exit_score(probability, blob_m, identity, jnp.asarray(0.0))
    np.testing.assert_allclose(score, [0.2, 0.2, 0.0], rtol=1e-6)
    np.testing.assert_array_equal(exit_score(probability[:, :1], blob_m[:, :0], identity[:, :0], jnp.asarray(0.0)), 0.0)


def test_the_rfid_rule_uses_one_antenna():
    rssi, received = jnp.asarray([[-60.0, -50.0], [0.0, -40.0]]), jnp.asarray([[True, True], [False, True]])
    np.testing.assert_array_equal(rssi_score(rssi, received, 1), [-60.0, -np.inf])
    np.testing.assert_array_equal(rssi_score(rssi, received, 2), [-50.0, -40.0])


def test_the_roc_counts_alarms_and_the_best_threshold_has_the_highest_gain():
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
    with pytest.raises(ValueError, match="Found 0 of 3 tags that enter"):
        roc_curve(np.zeros(3), np.zeros(3, bool))


def test_a_threshold_lies_between_the_scores_that_it_separates():
    assert best_threshold(roc_curve(np.array([-70.0, -60.0]), np.array([False, True]))) == -65.0
    assert best_threshold(roc_curve(np.array([-np.inf, -60.0]), np.array([False, True]))) == -60.0


def test_operating_point_is_the_lowest_threshold_with_that_few_false_alarms():
    score = np.array([5.0, 4.0, 3.0, 2.0, 1.0, -np.inf, -np.inf])
    moved = np.array([True, False, True, False, True, False, True])
    roc = roc_curve(score, moved)
    assert operating_point(roc, 0.0) == (0.25, 0.0)
    np.testing.assert_allclose(operating_point(roc, 1 / 3), (0.5, 1 / 3))
    np.testing.assert_allclose(operating_point(roc, 0.6), (0.5, 1 / 3))
    # Tags that were never received are not alarmed, however many false alarms are allowed.
    np.testing.assert_allclose(operating_point(roc, 1.0), (0.75, 2 / 3))
    never_received = roc_curve(np.array([-np.inf, -np.inf]), np.array([True, False]))
    assert operating_point(never_received, 1.0) == (0.0, 0.0)


def test_rates_are_printed_with_wilsons_interval():
    # Wilson (1927): centre (p + z^2 / 2n) / (1 + z^2 / n), for 3 of 40 from 0.026 to 0.199.
    assert rate_with_interval(3 / 40, 40) == "0.075 (0.03 to 0.20) of 40"
    assert rate_with_interval(1.0, 40) == "1.000 (0.91 to 1.00) of 40"
    assert rate_with_interval(float("nan"), 0) is None


def test_rates_count_runs_and_tags(shop, calibration):
    observed = observe(shop, scenes.LOOKING_DOWN)
    one = outcomes(calibration, [Example("sp_st_still", observed, true_tags(shop))], scenes.LOOKING_DOWN)[0]
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
