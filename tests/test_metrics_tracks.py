"""Scores of several tracks, windows, confidence and curves, on cases worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest
from frame_scores import frame_scores

from tagjax.metrics.curves import motion_curves
from tagjax.metrics.identification import window_identification
from tagjax.metrics.interval import ratio_estimate
from tagjax.metrics.multi_object import MatchFrame, MultiObjectScores
from tagjax.metrics.reliability import Reliability


def _frame(true: list[int], found: list[int], overlap: list[list[float]]) -> MatchFrame:
    return MatchFrame(
        np.array(true, int), np.array(found, int), np.array(overlap, float).reshape(len(true), len(found))
    )


def test_perfect_tracks_score_one() -> None:
    frames = [_frame([3, 5], [10, 20], [[1, 0], [0, 1]])] * 6
    result = MultiObjectScores.of(frames).result()
    assert result == {"hota": 1, "deta": 1, "assa": 1, "idf1": 1, "mota": 1, "id_switches": 0}


def test_a_swap_in_the_middle_costs_association_only() -> None:
    straight, swapped = _frame([1, 2], [1, 2], [[1, 0], [0, 1]]), _frame([1, 2], [1, 2], [[0, 1], [1, 0]])
    result = MultiObjectScores.of([straight] * 5 + [swapped] * 5).result()
    assert result["deta"] == 1.0
    # Each pair is together in 5 of the 15 frames in which either is.
    assert result["assa"] == pytest.approx(1 / 3)
    assert result["hota"] == pytest.approx(np.sqrt(1 / 3))
    assert result["id_switches"] == 2
    assert result["mota"] == pytest.approx(1 - 2 / 20)
    assert result["idf1"] == pytest.approx(0.5)


def test_misses_and_false_detections_count() -> None:
    both, missed, false = _frame([1], [7], [[0.8]]), _frame([1], [], [[]]), _frame([], [7], [])
    result = MultiObjectScores.of([both] * 6 + [missed] * 2 + [false] * 2).result()
    assert result["mota"] == pytest.approx((6 - 2) / 8)
    assert result["idf1"] == pytest.approx(6 / (6 + 0.5 * 4))
    hit = 16 / 19  # overlaps of 0.8 match at 0.05 to 0.8
    assert result["deta"] == pytest.approx(hit * 6 / 10)


def test_an_object_that_does_not_count_takes_its_detection_along() -> None:
    frame = _frame([1, 2], [7, 8, 9], [[0.9, 0.0, 0.1], [0.0, 0.6, 0.2]])
    left = frame.without_ignored(np.array([2]))
    assert left.true_ids.tolist() == [1]
    assert left.found_ids.tolist() == [7, 9]  # 8 is on the ignored object, 9 on none
    assert left.overlap.tolist() == [[0.9, 0.1]]
    assert frame.without_ignored(np.array([], int)).found_ids.tolist() == [7, 8, 9]


def test_merging_sequences_adds_their_counts() -> None:
    one = MultiObjectScores.of([_frame([1], [1], [[1.0]])] * 4)
    none = MultiObjectScores.of([_frame([1], [], [[]])] * 4)
    merged = one.merge(none).result()
    assert merged["mota"] == pytest.approx(0.5)
    assert merged["deta"] == pytest.approx(0.5)
    assert merged["assa"] == pytest.approx(1.0)
    assert MultiObjectScores().merge(one).result() == one.result()
    assert set(MultiObjectScores.of([]).result().values()) == {None}


def test_windows_go_by_the_majority() -> None:
    identified = np.array([1, 1, 2, 0, 0, 2, 2, 0, 1, 1])
    time_s, valid = np.arange(10) / 4, np.ones(10, bool)
    found = window_identification(identified, 1, valid, time_s, 1.0)  # windows 1 1 2 0 and 0 2 2 0; the rest is short
    assert (found.total, found.count) == (1, 2)
    later = np.arange(10) >= 4
    found = window_identification(identified, 2, later, time_s, 1.0)
    assert (found.total, found.count) == (1, 1)
    assert window_identification(identified, 1, np.zeros(10, bool), time_s, 1.0).count == 0
    unseen = valid & (np.arange(10) % 4 == 0)
    assert window_identification(identified, 1, unseen, time_s, 1.0).count == 0


def test_a_confidence_that_is_the_frequency_is_reliable() -> None:
    rng = np.random.default_rng(0)
    confidence = rng.random(200_000)
    right = rng.random(200_000) < confidence
    parts = [Reliability.of(confidence[i::3], right[i::3]) for i in range(3)]
    result = parts[0].merge(parts[1]).merge(parts[2]).result()
    assert isinstance(result["reliability"], list)
    for mean, fraction, number in result["reliability"]:
        assert fraction == pytest.approx(mean, abs=4 * np.sqrt(0.25 / number))
    assert result["brier"] == pytest.approx(1 / 6, abs=0.002)  # the mean of p (1 - p)
    assert Reliability().result() == {"brier": None, "reliability": []}
    with pytest.raises(ValueError, match="from 0 to 1"):
        Reliability.of(np.array([1.2]), np.array([True]))


def test_curves_are_aligned_to_the_first_motion() -> None:
    early = frame_scores([0.2, 0.4, 0.6, 0.8], since_motion=[-1, 0, 1, 2])
    late = frame_scores([0.9, 0.0, 1.0], since_motion=[-2, -1, 0])
    curves = motion_curves([{"a": early}, {"b": late}])
    np.testing.assert_allclose(curves["iou"].mean, [0.7, 0.6, 0.8])
    assert curves["iou"].num_tags.tolist() == [2, 1, 1]
    assert curves["iou"].low[0] == pytest.approx(0.4)
    assert curves["iou"].high[0] == pytest.approx(1.0)
    alone = motion_curves([{"a": early}])
    assert np.isnan(alone["iou"].low).all()
    assert motion_curves([])["iou"].mean.size == 0
    # Several recordings of which no frame counts.
    hidden = frame_scores([0.2, 0.4], visible=[False, False])
    assert np.isnan(motion_curves([{"a": hidden}, {"a": hidden}])["iou"].mean).all()


def test_a_curve_at_one_frame_is_the_bootstrap_of_means() -> None:
    rng = np.random.default_rng(1)
    values = rng.random(12)
    curve = motion_curves([{"a": frame_scores([value])} for value in values])["iou"]
    whole = ratio_estimate(values, np.ones(12, int))
    assert whole.low is not None
    assert whole.high is not None
    assert curve.mean[0] == pytest.approx(whole.value)
    assert curve.low[0] == pytest.approx(whole.low, abs=0.02)
    assert curve.high[0] == pytest.approx(whole.high, abs=0.02)
