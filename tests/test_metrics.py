"""Scores of boxes, masks and tags against closed forms and a pixel-counting reference."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import synthetic_clips as synthetic
from frame_scores import frame_scores

from tagjax.metrics.boxes import box_iou, centre_error, label_box, labelled_area, success_area, touches_border
from tagjax.metrics.locking import first_motion, frames_in, time_to_lock, times_to_recover
from tagjax.metrics.masks import best_covered_label, boundary, boundary_f, boundary_tolerances_px, decay, mask_iou
from tagjax.metrics.mean import MaskedMean
from tagjax.metrics.recordings import recent_reads
from tagjax.metrics.tags import FrameScores, Scores
from tagjax.recording import TagReads, Truth


def _box_mask(box: np.ndarray, size: int = 40) -> np.ndarray:
    mask = np.zeros((size, size), dtype=bool)
    x0, y0, x1, y1 = box.astype(int)
    mask[y0 : y1 + 1, x0 : x1 + 1] = True
    return mask


def test_box_iou_closed_forms() -> None:
    square = np.array([0.0, 0.0, 9.0, 9.0])
    assert box_iou(square, square) == pytest.approx(1.0)
    # Shifted by half its side: 50 of 150 pixels are shared.
    assert box_iou(square, square + np.array([5, 0, 5, 0])) == pytest.approx(1 / 3)
    assert box_iou(square, square + 10) == pytest.approx(0.0)
    assert box_iou(square, np.full(4, np.nan)) == 0.0
    assert box_iou(square, np.array([9.0, 9.0, 0.0, 0.0])) == 0.0


def test_box_iou_counts_pixels() -> None:
    rng = np.random.default_rng(0)
    corners = rng.integers(0, 30, size=(50, 2, 2))
    sides = rng.integers(0, 10, size=(50, 2, 2))
    boxes = np.concatenate([corners, corners + sides], axis=-1).astype(float)
    counted = [np.sum(_box_mask(a) & _box_mask(b)) / np.sum(_box_mask(a) | _box_mask(b)) for a, b in boxes]
    np.testing.assert_allclose(box_iou(boxes[:, 0], boxes[:, 1]), counted)


def test_centre_error_is_for_a_512_pixel_wide_picture() -> None:
    a = np.array([0.0, 0.0, 10.0, 10.0])
    b = a + np.array([3.0, 4.0, 3.0, 4.0])
    assert centre_error(a, b, 512) == pytest.approx(5.0)
    assert centre_error(a, b, 256) == pytest.approx(10.0)
    assert np.isnan(centre_error(a, np.full(4, np.nan), 512))


def test_mask_iou_leaves_ignored_pixels_out() -> None:
    labels = np.zeros((4, 6), dtype=np.uint8)
    labels[:, :2], labels[:, 2:4] = 3, Truth.IGNORE
    mask = np.zeros((4, 6), dtype=bool)
    mask[:, :4] = True
    assert mask_iou(mask, labels, 3) == 1.0
    mask[:, 4] = True
    assert mask_iou(mask, labels, 3) == pytest.approx(8 / 12)
    assert np.isnan(mask_iou(np.zeros_like(mask), labels, 5))


def test_most_covered_is_by_part_not_by_pixels() -> None:
    labels = np.zeros((20, 20), dtype=np.uint8)
    labels[:10], labels[10:15, :10] = 1, 2
    mask = np.zeros((20, 20), dtype=bool)
    mask[5:15, :10] = True  # 50 of 200 pixels of object 1, all 50 of object 2
    assert best_covered_label(mask, labels) == 2
    assert best_covered_label(mask, labels, min_pixels=60) == 1
    assert best_covered_label(np.zeros_like(mask), labels) == 0


def test_label_box_and_border() -> None:
    labels = np.zeros((10, 12), dtype=np.uint8)
    labels[2:5, 3:8] = 4
    box = label_box(labels, 4)
    np.testing.assert_array_equal(box, [3, 2, 7, 4])
    assert np.isnan(label_box(labels, 1)).all()
    area = labelled_area(labels)
    np.testing.assert_array_equal(area, [0, 0, 11, 9])
    assert not touches_border(box, area, margin_px=1.0)
    assert touches_border(box, area, margin_px=2.0)  # y0 = 2
    assert touches_border(np.array([3, 2, 11, 4.0]), area)
    assert touches_border(np.array([3, 0, 7, 4.0]), area)
    # Where depth does not reach the edge of the picture, the labels' own edge counts.
    labels[:, :3] = labels[:2] = Truth.IGNORE
    np.testing.assert_array_equal(labelled_area(labels), [3, 2, 11, 9])
    assert touches_border(box, labelled_area(labels))


def test_success_area_counts_the_thresholds_below_an_overlap() -> None:
    iou = np.array([0.0, 0.01, 0.5, 0.99, 1.0])
    np.testing.assert_allclose(success_area(iou), np.array([0, 1, 10, 20, 20]) / 21)
    rng = np.random.default_rng(0)
    many = rng.random(4000)
    assert success_area(many).mean() == pytest.approx(
        np.mean([np.mean(many > level) for level in np.linspace(0, 1, 21)])
    )


def test_boundary_f_closed_forms() -> None:
    true, moved = np.zeros((30, 40), bool), np.zeros((30, 40), bool)
    true[5:20, 8:25], moved[5:20, 10:27] = True, True  # moved by two pixels to the right
    assert boundary(true).sum() == 2 * (15 + 17)
    np.testing.assert_array_equal(boundary_f(true, true, (0.0, 1.0)), [1, 1])
    f = boundary_f(moved, true, (0.0, 1.0, 2.0))
    assert 0 < f[0] < f[1] < f[2] == 1.0
    # At tolerance 0 the contour pixels are shared along the upper and the lower side only, less two columns.
    shared = np.sum(boundary(true) & boundary(moved))
    assert f[0] == pytest.approx(shared / boundary(true).sum())
    nothing = np.zeros_like(true)
    np.testing.assert_array_equal(boundary_f(nothing, true, (1.0, 3.0)), [0, 0])
    np.testing.assert_array_equal(boundary_f(nothing, nothing, (1.0,)), [1])


def test_davis_tolerance_is_a_part_of_the_diagonal() -> None:
    assert boundary_tolerances_px(480, 854) == (1.0, 2.0, 3.0, 8.0)
    assert boundary_tolerances_px(424, 512) == (1.0, 2.0, 3.0, 6.0)


def test_decay_compares_the_first_and_the_last_quarter() -> None:
    assert decay(np.full(40, 0.7)) == pytest.approx(0.0)
    assert decay(np.concatenate([np.ones(20), np.zeros(20)])) == pytest.approx(1.0)
    assert np.isnan(decay(np.ones(3)))


def test_time_to_lock_skips_invalid_frames() -> None:
    locked = np.array([0.9, 0.1, 0.6, 0.0, 0.7, 0.8, 0.9]) >= 0.5
    valid = np.array([False, True, True, False, True, True, True])
    time_s = np.arange(7) * 0.5
    assert time_to_lock(locked, valid, time_s, num_frames=3) == pytest.approx(0.5)  # 1.0 s - 0.5 s
    assert time_to_lock(locked, valid, time_s, num_frames=5) == float("inf")
    assert np.isnan(time_to_lock(locked, np.zeros(7, dtype=bool), time_s))


@pytest.mark.parametrize("rate_hz", [7.0, 30.0])
def test_first_motion_is_the_first_frame_at_the_speed(rate_hz: float) -> None:
    time_s = np.arange(int(4 * rate_hz)) / rate_hz
    range_m = 2.0 + 0.3 * np.maximum(time_s - 2.0, 0.0)
    begin = first_motion(Truth(tag_range_m={"a": range_m}), "a", time_s)
    assert begin is not None
    assert abs(time_s[begin] - 2.0) <= max(0.1, 1 / rate_hz) + 1e-9  # half of the speed's window
    still = Truth(tag_range_m={"a": np.full(len(time_s), 2.0)})
    assert first_motion(still, "a", time_s) is None
    assert first_motion(still, "b", time_s) == 0  # nothing is known of it
    # A tag that circles the antenna moves although its range does not change.
    circle = np.stack([np.cos(time_s), 0 * time_s, np.sin(time_s)], axis=-1)
    assert first_motion(Truth(tag_range_m=still.tag_range_m, tag_position_m={"a": circle}), "a", time_s) == 0
    noise = 0.003 * np.random.default_rng(0).standard_normal((len(time_s), 3))
    assert first_motion(Truth(tag_position_m={"a": noise}), "a", time_s) is None
    unknown = Truth(tag_range_m={"a": np.where(time_s < 3.0, np.nan, range_m)})
    late = first_motion(unknown, "a", time_s)
    assert late is not None
    assert time_s[late] == pytest.approx(3.0, abs=0.1 + 1 / rate_hz)


def test_frames_in_a_time() -> None:
    assert frames_in(0.33, np.arange(50) / 30) == 10
    assert frames_in(0.33, np.arange(50) / 10) == 4
    assert frames_in(0.33, np.zeros(1), minimum=3) == 3


def test_recent_reads_are_those_of_the_last_second() -> None:
    recording = synthetic.recording(30)
    seconds = np.array([-0.2, 0.1, 0.4, 1.2, 1.21])
    rssi_dbm = np.array([-60, -50, np.nan, -40, -50], np.float32)
    time_ns = recording.time_ns[0] + (seconds * 1e9).astype(np.int64)
    row = recording.reads[np.zeros(5, dtype=int)]
    changed: TagReads = dataclasses.replace(row, time_ns=time_ns, rssi_dbm=rssi_dbm)
    reads, mean_dbm = recent_reads(recording.with_reads(changed), str(row.epc[0]))
    for frame, time_s in enumerate(recording.frame_time_s()):
        inside = (seconds > time_s - 1.0) & (seconds <= time_s)
        assert reads[frame] == inside.sum()
        known = rssi_dbm[inside & np.isfinite(rssi_dbm)]
        np.testing.assert_allclose(mean_dbm[frame], known.mean() if len(known) else np.nan, rtol=1e-6)


def test_masked_mean_merges_to_the_mean_of_all() -> None:
    rng = np.random.default_rng(1)
    values, valid = rng.normal(size=30), rng.random(30) > 0.4
    merged = MaskedMean.of(values[:11], valid[:11]).merge(MaskedMean.of(values[11:], valid[11:]))
    assert merged.result() == pytest.approx(values[valid].mean())
    assert np.isnan(MaskedMean().result())


def _frames(iou: list[float], found: list[bool], identified: list[int]) -> FrameScores:
    n = len(iou)
    shown = np.array([True] * (n - 1) + [False])
    return frame_scores(
        iou, detected=found, identified=identified, visible=shown, since_motion=np.arange(-1, n - 1), label=2
    )


def test_scores_select_frames_and_punish_missing_claims() -> None:
    found = [True, True, True, True, False, True]
    frames = _frames([1.0, 0.8, 0.6, 0.9, 1.0, 1.0], found, [2, 2, 1, 2, 2, 2])
    result = Scores.of(frames, lock_s=0.2).result()
    assert result["num_frames"] == 4  # frames 1 to 4
    assert result["iou"] == pytest.approx((0.8 + 0.6 + 0.9 + 0.0) / 4)
    assert result["identification"] == pytest.approx(2 / 4)
    assert result["p_d"] == pytest.approx(3 / 4)
    assert result["cle_px"] == pytest.approx(7.0)
    assert result["counted"] == pytest.approx(4 / 6)
    assert result["range_error_mm"] == pytest.approx(20.0)
    assert result["time_to_lock_s"] == 0.0
    assert result["time_to_identification_s"] is None  # never three frames in a row


def test_the_carriers_overlap_is_averaged_where_the_carrier_is_known() -> None:
    chosen = {"detected": [True, True, False, True], "carrier_iou": [0.8, np.nan, 0.9, 0.4]}
    known = Scores.of(frame_scores(np.full(4, 0.1), **chosen)).result()
    assert known["carrier_iou"] == pytest.approx((0.8 + 0.0 + 0.4) / 3)  # frame 2 is not detected
    assert known["iou"] == pytest.approx(0.1 * 3 / 4)
    assert Scores.of(frame_scores(np.full(4, 0.1))).result()["carrier_iou"] is None


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
    found = times_to_recover(iou >= 0.5, shown, time_s, num_frames=2)
    assert found == pytest.approx((0.2, np.inf))  # the last appearance is too short to lock
    assert times_to_recover(iou[:5] >= 0.5, shown[:5], time_s[:5], num_frames=2) == ()
    frames = frame_scores(np.repeat(iou, 2), detected=np.repeat(iou, 2) > 0, visible=np.repeat(shown, 2))
    scores = Scores.of(frames, lock_s=0.4)
    numbers = scores.merge(scores).result()
    assert numbers["recovered"] == 0.5
    assert numbers["time_to_recover_s"] == pytest.approx(0.4)
    assert "recovered" not in Scores().result()


def test_a_tag_that_never_moves_has_only_false_detections() -> None:
    frames = frame_scores([0.9, 0.9, 0.0, 0.9], detected=[True, True, False, False], moves=False)
    result = Scores.of(frames).result()
    assert result["p_fa"] == 0.5
    assert result["num_frames"] == 0
    assert result["num_tags"] == 0


def test_clearly_read_frames_are_scored_apart() -> None:
    iou = np.array([0.9, 0.5, 0.7, 0.1])
    reads, sight = np.array([9, 4, 5, 9]), np.array([1.0, 1.0, np.nan, 0.5])
    result = Scores.of(frame_scores(iou, reads=reads, line_of_sight=sight)).result()
    assert result["iou"] == pytest.approx(iou.mean())
    assert result["clear_iou"] == pytest.approx((0.9 + 0.7) / 2)  # too few reads; unknown counts as free; blocked
    assert result["clearly_read"] == 0.5
    assert result["counted"] == 1.0


def test_the_limits_in_time_select_frames() -> None:
    iou = np.array([0.1, 0.2, 0.3, 0.4])
    result = Scores.of(frame_scores(iou, selected=np.array([False, True, True, False]))).result()
    assert result["iou"] == pytest.approx(0.25)
    assert result["counted"] == 0.5
