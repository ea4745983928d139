"""Tracking metrics against closed forms and a pixel-counting reference."""

from __future__ import annotations

import numpy as np
import pytest

from tagjax.metrics import tracking as metrics
from tagjax.metrics.tracking import FrameScores, MaskedMean, Scores
from tagjax.recording import Truth


def _box_mask(box: np.ndarray, size: int = 40) -> np.ndarray:
    mask = np.zeros((size, size), dtype=bool)
    x0, y0, x1, y1 = box.astype(int)
    mask[y0 : y1 + 1, x0 : x1 + 1] = True
    return mask


def test_box_iou_closed_forms() -> None:
    square = np.array([0.0, 0.0, 9.0, 9.0])
    assert metrics.box_iou(square, square) == pytest.approx(1.0)
    # Shifted by half its side: 50 of 150 pixels are shared.
    assert metrics.box_iou(square, square + np.array([5, 0, 5, 0])) == pytest.approx(1 / 3)
    assert metrics.box_iou(square, square + 10) == pytest.approx(0.0)
    assert metrics.box_iou(square, np.full(4, np.nan)) == 0.0
    assert metrics.box_iou(square, np.array([9.0, 9.0, 0.0, 0.0])) == 0.0


def test_box_iou_counts_pixels() -> None:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 30, size=(50, 2, 2))
    sides = rng.integers(0, 10, size=(50, 2, 2))
    boxes = np.concatenate([corners, corners + sides], axis=-1).astype(float)
    counted = [np.sum(_box_mask(a) & _box_mask(b)) / np.sum(_box_mask(a) | _box_mask(b)) for a, b in boxes]
    np.testing.assert_allclose(metrics.box_iou(boxes[:, 0], boxes[:, 1]), counted)


def test_centre_error_is_for_a_512_pixel_wide_picture() -> None:
    a = np.array([0.0, 0.0, 10.0, 10.0])
    b = a + np.array([3.0, 4.0, 3.0, 4.0])
    assert metrics.centre_error(a, b, 512) == pytest.approx(5.0)
    assert metrics.centre_error(a, b, 256) == pytest.approx(10.0)
    assert np.isnan(metrics.centre_error(a, np.full(4, np.nan), 512))


def test_mask_iou_leaves_ignored_pixels_out() -> None:
    labels = np.zeros((4, 6), dtype=np.uint8)
    labels[:, :2], labels[:, 2:4] = 3, Truth.IGNORE
    mask = np.zeros((4, 6), dtype=bool)
    mask[:, :4] = True
    assert metrics.mask_iou(mask, labels, 3) == 1.0
    mask[:, 4] = True
    assert metrics.mask_iou(mask, labels, 3) == pytest.approx(8 / 12)
    assert np.isnan(metrics.mask_iou(np.zeros_like(mask), labels, 5))


def test_most_covered_is_by_part_not_by_pixels() -> None:
    labels = np.zeros((20, 20), dtype=np.uint8)
    labels[:10], labels[10:15, :10] = 1, 2
    mask = np.zeros((20, 20), dtype=bool)
    mask[5:15, :10] = True  # 50 of 200 pixels of object 1, all 50 of object 2
    assert metrics.best_covered_label(mask, labels) == 2
    assert metrics.best_covered_label(mask, labels, min_pixels=60) == 1
    assert metrics.best_covered_label(np.zeros_like(mask), labels) == 0


def test_label_box_and_border() -> None:
    labels = np.zeros((10, 12), dtype=np.uint8)
    labels[2:5, 3:8] = 4
    box = metrics.label_box(labels, 4)
    np.testing.assert_array_equal(box, [3, 2, 7, 4])
    assert np.isnan(metrics.label_box(labels, 1)).all()
    area = metrics.labelled_area(labels)
    np.testing.assert_array_equal(area, [0, 0, 11, 9])
    assert not metrics.touches_border(box, area, margin_px=1.0)
    assert metrics.touches_border(box, area, margin_px=2.0)  # y0 = 2
    assert metrics.touches_border(np.array([3, 2, 11, 4.0]), area)
    assert metrics.touches_border(np.array([3, 0, 7, 4.0]), area)
    # Where depth does not reach the edge of the picture, the labels' own edge counts.
    labels[:, :3] = labels[:2] = Truth.IGNORE
    np.testing.assert_array_equal(metrics.labelled_area(labels), [3, 2, 11, 9])
    assert metrics.touches_border(box, metrics.labelled_area(labels))


def test_time_to_lock_skips_invalid_frames() -> None:
    iou = np.array([0.9, 0.1, 0.6, 0.0, 0.7, 0.8, 0.9])
    valid = np.array([False, True, True, False, True, True, True])
    time_s = np.arange(7) * 0.5
    assert metrics.time_to_lock(iou, valid, time_s, num_frames=3) == pytest.approx(0.5)  # 1.0 s - 0.5 s
    assert metrics.time_to_lock(iou, valid, time_s, num_frames=5) == float("inf")
    assert np.isnan(metrics.time_to_lock(iou, np.zeros(7, dtype=bool), time_s))


def test_moved_for_adds_up_moving_time_only() -> None:
    time_s = np.arange(12) * 0.25
    speed = np.array([1, 1, 0, 0, 0, 1, 1, 1, 1, 1, 1, 1.0])
    range_m = 2 + np.cumsum(speed) * 0.25
    truth = Truth(tag_range_m={"a": range_m})
    # Moving steps end at frames 1, 5, 6, 7, ...: 1 s of motion is complete at frame 7.
    np.testing.assert_array_equal(np.flatnonzero(metrics.moved_for(truth, "a", time_s, 1.0)), np.arange(7, 12))
    assert not metrics.moved_for(truth, "b", time_s, 1.0).any()
    assert metrics.moved_for(truth, "b", time_s, 0.0).all()
    gone = Truth(tag_range_m={"a": np.where(np.arange(12) == 8, np.nan, range_m)})
    np.testing.assert_array_equal(np.flatnonzero(metrics.moved_for(gone, "a", time_s, 0.5)), np.arange(5, 12))
    restarted = metrics.moved_for(gone, "a", time_s, 0.5, restarts=True)
    np.testing.assert_array_equal(np.flatnonzero(restarted), [5, 6, 7, 11])
    # A tag that circles the antenna moves although its range does not change.
    circle = np.stack([np.cos(time_s), 0 * time_s, np.sin(time_s)], axis=-1)
    round_trip = Truth(tag_range_m={"a": np.ones(12)}, tag_position_m={"a": circle})
    assert metrics.moved_for(round_trip, "a", time_s, 1.0)[-1]


def test_masked_mean_merges_to_the_mean_of_all() -> None:
    rng = np.random.default_rng(1)
    values, valid = rng.normal(size=30), rng.random(30) > 0.4
    merged = MaskedMean.of(values[:11], valid[:11]).merge(MaskedMean.of(values[11:], valid[11:]))
    assert merged.result() == pytest.approx(values[valid].mean())
    assert np.isnan(MaskedMean().result())


def _frames(iou: list[float], found: list[bool], identified: list[int]) -> FrameScores:
    n = len(iou)
    return FrameScores(
        time_s=np.arange(n) * 1.0,
        iou=np.array(iou),
        cle_px=np.full(n, 7.0),
        mask_j=np.array(iou),
        identified=np.array(identified),
        confidence=np.ones(n),
        detected=np.array(found),
        visible=np.array([True] * (n - 1) + [False]),
        has_moved=np.array([False] + [True] * (n - 1)),
        label=2,
    )


def test_scores_select_frames_and_punish_missing_claims() -> None:
    frames = _frames([1.0, 0.8, 0.6, 1.0, 1.0], [True, True, True, False, True], [2, 2, 1, 2, 2])
    result = Scores.of(frames, lock_frames=2).result()
    assert result["num_frames"] == 3  # frames 1, 2 and 3
    assert result["iou"] == pytest.approx((0.8 + 0.6 + 0.0) / 3)
    assert result["identification"] == pytest.approx(1 / 3)
    assert result["detected"] == pytest.approx(2 / 3)
    assert result["cle_px"] == pytest.approx(7.0)
    assert result["time_to_lock_s"] == 0.0


def test_merging_scores_equals_scoring_together() -> None:
    one = Scores.of(_frames([1.0, 0.8, 0.6, 0.4], [True] * 4, [2, 2, 2, 2]))
    two = Scores.of(_frames([0.0, 0.2, 0.1, 0.9, 0.3], [True] * 5, [2, 1, 1, 2, 2]))
    result = one.merge(two).merge(Scores()).result()
    assert result["iou"] == pytest.approx(np.mean([0.8, 0.6, 0.2, 0.1, 0.9]))
    assert result["num_tags"] == 2
    assert result["locked"] == 0.0
    assert result["time_to_lock_s"] is None


def test_recovery_counts_from_each_time_the_object_shows_again():
    shown = np.array([1, 1, 1, 0, 0, 0, 1, 1, 1, 1, 0, 1, 0, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1], bool)
    iou = np.zeros(len(shown))
    iou[:3] = 0.9
    iou[8:12] = 0.7  # locked at the third frame of the second appearance, over a gap too short to count
    iou[17] = 0.9  # one good frame is no lock
    time_s = 0.1 * np.arange(len(shown))
    found = metrics.times_to_recover(iou, shown, time_s, num_frames=2)
    assert found == pytest.approx((0.2, np.inf))  # the last appearance is too short to lock
    assert metrics.times_to_recover(iou[:5], shown[:5], time_s[:5], num_frames=2) == ()
    frames = metrics.FrameScores(
        time_s, iou, iou, iou, np.ones(len(iou), int), iou, iou > 0, shown, np.ones(len(iou), bool), 1
    )
    scores = metrics.Scores.of(frames, lock_frames=2)
    numbers = scores.merge(scores).result()
    assert numbers["recovered"] == 0.5
    assert numbers["time_to_recover_s"] == pytest.approx(0.2)
    assert "recovered" not in metrics.Scores().result()
