"""Evaluation of whole recordings: agreement with one scan, sizes, pictures, report."""

from __future__ import annotations

import csv
import dataclasses
import io
import itertools
import json
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import synthetic_clips as synthetic
from rich.console import Console

from tagjax.core.results import to_json_values
from tagjax.metrics.boxes import box_iou, label_box
from tagjax.metrics.recordings import ScoreSettings, box_to_picture, evaluate_recording, mask_to_picture, score_traces
from tagjax.recording import RecordingError
from tagjax.report.overlay import MIN_WIDTH, _extent, _free_place, draw_overlay
from tagjax.report.report import score_table, summarise, write_frames, write_report
from tagjax.tagattention.frame_trace import describe
from tagjax.tracing.clips import ClipSettings, clip_loader
from tagjax.tracing.recordings import _tags, trace_recording
from tagjax.tracing.status import Status
from tagjax.tracing.tracer import Trace, trace

EPCS = list(synthetic.EPCS)


@pytest.mark.parametrize(("frames_at_once", "tags_at_once"), [(7, 1), (50, 2), (16, 6)])
def test_pieces_and_groups_give_what_one_scan_gives(frames_at_once: int, tags_at_once: int) -> None:
    recording = synthetic.recording(20)
    tracer = synthetic.SmallTracer()
    clip = synthetic.load(recording, 0, 20, epcs=EPCS)
    whole = trace(tracer, clip.camera, clip.frames)
    settings = ScoreSettings(frames_at_once=frames_at_once, tags_at_once=tags_at_once)
    pieces = list(trace_recording(tracer, recording, synthetic.load, epcs=EPCS, settings=settings))
    assert [number for number, _ in pieces] == list(range(20))
    for number, found in pieces:
        expected = jax.tree.map(lambda leaf, n=number: np.asarray(leaf[n]), whole)
        for got, wanted in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(got, wanted, rtol=2e-5, atol=2e-6)


def test_three_tags_in_groups_of_two_keep_their_order() -> None:
    recording = synthetic.recording(8)
    names = ["tag-b", "tag-a", "tag-b"]
    settings = ScoreSettings(tags_at_once=2)
    _, found = list(trace_recording(synthetic.SmallTracer(), recording, synthetic.load, epcs=names, settings=settings))[
        -1
    ]
    assert found.mask.shape[0] == 3
    np.testing.assert_allclose(found.mask[0], found.mask[2], rtol=1e-5)
    assert np.abs(found.mask[0] - found.mask[1]).max() > 0.1


def test_a_group_is_filled_up_with_tags_that_are_never_read() -> None:
    """Not with one of its own once more, which would compete with itself."""
    frames = synthetic.load(synthetic.recording(8), 0, 8, epcs=["tag-b", "tag-a", "tag-b"]).frames
    last = _tags(frames, 2, 2)
    np.testing.assert_array_equal(last.radio.relative_m[:, 0], frames.radio.relative_m[:, 2])
    np.testing.assert_array_equal(last.reads.valid[:, 0], frames.reads.valid[:, 2])
    assert np.isinf(last.radio.std_m[:, 1]).all()
    assert not np.asarray(last.radio.relative_m[:, 1]).any()
    assert not np.asarray(last.reads.valid[:, 1]).any()


def test_the_object_is_detected_identified_and_outlined() -> None:
    recording = synthetic.recording(40)
    settings = ScoreSettings(from_s=0.5)  # the first frames of motion are too few to know
    result = evaluate_recording(synthetic.SmallTracer(), recording, synthetic.load, stride=1, settings=settings)
    scores = result.scores().result()
    assert scores["iou"] == pytest.approx(1.0)
    assert scores["mask_j"] == pytest.approx(1.0)
    assert scores["cle_px"] == pytest.approx(0.0)
    assert scores["identification"] == 1.0
    assert len(result.pictures) == ScoreSettings().num_pictures
    # Swapped names in the truth must show as wrong identification and no overlap.
    assert recording.truth is not None
    truth = dataclasses.replace(recording.truth, tag_to_label={"tag-a": 2, "tag-b": 1})
    swapped = evaluate_recording(
        synthetic.SmallTracer(),
        dataclasses.replace(recording, truth=truth),
        synthetic.load,
        stride=1,
        settings=settings,
    )
    assert swapped.scores().result()["identification"] == 0.0
    assert swapped.scores().result()["iou"] < 0.02


def test_the_traced_box_is_compared_with_that_of_the_carrier(tmp_path: Path) -> None:
    recording = synthetic.recording(3)
    assert recording.truth is not None
    carrier_px = np.array([[4.0, 2.0, 23.0, 11.0], [4.0, 2.0, 23.0, 16.0], [np.nan] * 4], np.float32)
    truth = dataclasses.replace(recording.truth, carrier_box_px={"tag-a": carrier_px})
    trace = Trace(
        mask=jnp.zeros((2, synthetic.HEIGHT, synthetic.WIDTH)),
        box_px=jnp.tile(jnp.array([4.0, 2.0, 13.0, 11.0]), (2, 1)),
        centre_px=jnp.zeros((2, 2)),
        centre_m=jnp.zeros((2, 3)),
        step_m=jnp.zeros((2, 1)),
        confidence=jnp.ones(2),
        detected=jnp.ones(2, bool),
    )
    traces = [(number, trace) for number in range(3)]
    result = score_traces(traces, dataclasses.replace(recording, truth=truth), EPCS)
    np.testing.assert_allclose(result.frames["tag-a"].carrier_iou, [1 / 2, 1 / 3, np.nan])
    assert np.isnan(result.frames["tag-b"].carrier_iou).all()
    write_frames(tmp_path / "frames.csv", {"one": [result]})
    with (tmp_path / "frames.csv").open() as file:
        written = [row["carrier_iou"] for row in csv.DictReader(file) if row["epc"] == "tag-a"]
    assert written == ["0.5", "0.333333", "nan"]


def test_a_claim_of_a_tag_that_nothing_carries_is_a_false_one(tmp_path: Path) -> None:
    recording = synthetic.recording(12)
    assert recording.truth is not None
    names = [*EPCS, "on-a-shelf"]

    def trace_of(claimed: bool) -> Trace:
        return Trace(
            mask=jnp.zeros((3, synthetic.HEIGHT, synthetic.WIDTH)),
            box_px=jnp.zeros((3, 4)),
            centre_px=jnp.zeros((3, 2)),
            centre_m=jnp.zeros((3, 3)),
            step_m=jnp.zeros((3, 1)),
            confidence=jnp.ones(3),
            detected=jnp.array([True, False, claimed]),
        )

    traces = [(number, trace_of(number in (3, 4, 9))) for number in range(12)]
    result = score_traces(traces, recording, names)
    write_frames(tmp_path / "frames.csv", {"one": [result]})
    with (tmp_path / "frames.csv").open() as file:
        on_shelf = [row for row in csv.DictReader(file) if row["epc"] == "on-a-shelf"]
    assert [int(row["frame"]) for row in on_shelf if row["detected"] == "1"] == [3, 4, 9]
    assert {(row["label"], row["iou"], row["valid"]) for row in on_shelf} == {("0", "nan", "0")}
    scores = result.scores().result()
    assert scores["p_fa"] == pytest.approx(3 / 12)
    of_labelled = [tag.result() for tag in result.tag_scores().values()]
    assert scores["num_frames"] == sum(tag["num_frames"] or 0 for tag in of_labelled)
    assert all("p_fa" not in tag for tag in of_labelled)
    blind = dataclasses.replace(recording, truth=None)
    assert "p_fa" not in score_traces(traces, blind, names).scores().result()


def test_without_truth_there_are_pictures_but_no_scores() -> None:
    recording = synthetic.recording(12)

    def load(_, start, stop, *, epcs):  # the clip still needs the true radio
        return synthetic.load(recording, start, stop, epcs=epcs)

    blind = dataclasses.replace(recording, truth=None)
    result = evaluate_recording(synthetic.SmallTracer(), blind, load, stride=1)
    assert result.frames == {}
    assert result.pictures
    assert summarise({"it": [result]})["it"]["all"]["num_frames"] == 0


def test_bad_requests_are_refused_with_the_reason() -> None:
    recording = synthetic.recording(12)
    with pytest.raises(RecordingError, match="never read"):
        evaluate_recording(synthetic.SmallTracer(), recording, synthetic.load, stride=1, epcs=["unknown"])
    with pytest.raises(RecordingError, match="0 to 12"):
        evaluate_recording(synthetic.SmallTracer(), recording, synthetic.load, stride=1, frames=(5, 40))
    with pytest.raises(RecordingError, match="no tag to trace"):
        list(trace_recording(synthetic.SmallTracer(), recording, synthetic.load, epcs=[]))


def test_working_pixels_land_on_their_own_place_in_the_picture() -> None:
    mask = np.zeros((6, 8), np.float32)
    mask[2:4, 3:6] = 1.0
    large = mask_to_picture(mask, 4, 24, 32)
    np.testing.assert_allclose(large[::4, ::4], mask, atol=1e-6)
    box = box_to_picture(np.array([3.0, 2.0, 5.0, 3.0]), 4, 24, 32)
    # Pixel i stands for the pixels around i * 4: each side reaches 1.5 pixels beyond the outermost centres.
    np.testing.assert_allclose(box, [10.5, 6.5, 21.5, 13.5])
    rows, columns = np.nonzero(large >= 0.5)
    assert abs(columns.min() - box[0]) <= 1
    assert abs(rows.max() - box[3]) <= 1
    np.testing.assert_array_equal(box_to_picture(np.array([0.0, 0.0, 7.0, 5.0]), 4, 24, 32), [0, 0, 29.5, 21.5])


def test_without_a_stride_masks_are_those_of_the_pictures_width() -> None:
    """512 columns: clips and scores agree on every second pixel."""
    wide = synthetic.enlarged(synthetic.recording(8), 16)
    load = clip_loader(ClipSettings(flow="zero"))
    settings = ScoreSettings(num_pictures=1, min_pixels=1)
    found = evaluate_recording(synthetic.SmallTracer(), wide, load, settings=settings)
    given = evaluate_recording(synthetic.SmallTracer(), wide, load, stride=2, settings=settings)
    assert found.pictures[0].masks.shape[1:] == (384, 512)
    np.testing.assert_array_equal(found.pictures[0].boxes_px, given.pictures[0].boxes_px)
    assert to_json_values(found.scores().result()) == to_json_values(given.scores().result())


@pytest.mark.parametrize("stride", [1, 2, 4])
def test_the_box_of_a_right_mask_is_the_true_box(stride: int) -> None:
    """From a tracer's mask to its score: no side is too long or too short, wherever the thing lies on the grid."""
    sides, overlaps = [], []
    for shift in itertools.product(range(stride), repeat=2):
        labels = np.zeros((96, 128), np.int32)
        labels[20 + shift[0] : 60 + shift[0], 40 + shift[1] : 70 + shift[1]] = 1
        box, true_box = _box_of_the_true_mask(labels, stride), label_box(labels, 1)
        sides.append((box[2:] - box[:2]) - (true_box[2:] - true_box[:2]))
        overlaps.append(box_iou(box, true_box))
    np.testing.assert_allclose(np.mean(sides, axis=0), 0.0, atol=1e-9)
    off = 0.5 * (stride - 1)  # what a grid of this step may be off by, at most
    shared = (40 - off) * (30 - off)
    assert min(overlaps) >= shared / (2 * 40 * 30 - shared) - 1e-9


def test_what_is_thin_at_its_ends_is_boxed_whole() -> None:
    labels = np.zeros((96, 128), np.uint8)
    cv2.ellipse(labels, (60, 50), (16, 40), 0, 0, 360, 1, -1)
    np.testing.assert_array_equal(
        _box_of_the_true_mask(labels.astype(np.int32), 1), label_box(labels.astype(np.int32), 1)
    )


def _box_of_the_true_mask(labels: np.ndarray, stride: int) -> np.ndarray:
    mask = jnp.asarray(labels[::stride, ::stride] == 1, jnp.float32)[None]
    none = jnp.zeros((1, *mask.shape[1:]))
    found = describe(mask, jnp.zeros((1, 3)), none, none[0] > 0)
    return box_to_picture(np.asarray(found.box_px[0]), stride, *labels.shape)


def test_report_is_complete(tmp_path: Path) -> None:
    recording = synthetic.recording(30)
    settings = ScoreSettings(num_pictures=3)
    results = {
        "learned": [
            evaluate_recording(synthetic.SmallTracer(), recording, synthetic.load, stride=1, settings=settings)
        ],
        "blunt": [
            evaluate_recording(synthetic.SmallTracer(1.0), recording, synthetic.load, stride=1, settings=settings)
        ],
    }
    summary = write_report(tmp_path, results)
    assert json.loads((tmp_path / "metrics.json").read_text()) == to_json_values(summary)
    assert summary["learned"]["all"]["iou"] > summary["blunt"]["all"]["iou"]
    with (tmp_path / "frames.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 2 * 30
    by_hand = [
        float(r["iou"])
        for r in rows
        if r["tracer"] == "blunt" and r["visible"] == r["detected"] == "1" and int(r["since_motion"]) >= 0
    ]
    assert summary["blunt"]["all"]["iou"] == pytest.approx(np.sum(by_hand) / summary["blunt"]["all"]["num_frames"])
    # This tracer gives no reasons.
    assert all(row["status"] == ("detected" if row["detected"] == "1" else "unknown") for row in rows)
    pictures = sorted((tmp_path / "overlays" / "synthetic" / "learned").glob("*.png"))
    assert len(pictures) == 3
    drawn = cv2.imread(str(pictures[-1]))
    assert drawn is not None
    scale = -(-MIN_WIDTH // synthetic.WIDTH)  # small pictures are enlarged
    assert drawn.shape == (scale * synthetic.HEIGHT, scale * synthetic.WIDTH, 3)
    assert len(np.unique(drawn.reshape(-1, 3), axis=0)) > 3  # something is drawn on the uniform grey
    assert len(list((tmp_path / "curves").glob("*.png"))) == 2
    assert (tmp_path / "motion_curves.png").exists()
    with (tmp_path / "motion_curves.csv").open() as file:
        first = next(row for row in csv.DictReader(file) if (row["tracer"], row["score"]) == ("learned", "iou"))
    assert first["frame"] == "0"
    assert int(first["num_tags"]) >= 1
    assert score_table(summary).row_count == 2
    assert score_table(summary).caption is None
    assert "no scores" in str(score_table({"untrained": {"all": {"num_frames": 0}}}).caption)


def test_the_reason_why_a_tag_is_not_detected_is_reported_and_shown(tmp_path: Path) -> None:
    recording = synthetic.recording(3)
    status = jnp.array([Status.OCCLUDED, Status.DETECTED], jnp.int8)
    trace = Trace(
        mask=jnp.zeros((2, synthetic.HEIGHT, synthetic.WIDTH)),
        box_px=jnp.zeros((2, 4)),
        centre_px=jnp.zeros((2, 2)),
        centre_m=jnp.zeros((2, 3)),
        step_m=jnp.zeros((2, 1)),
        confidence=jnp.ones(2),
        detected=status == Status.DETECTED,
        status=status,
    )
    result = score_traces([(number, trace) for number in range(3)], recording, EPCS)
    write_frames(tmp_path / "frames.csv", {"one": [result]})
    with (tmp_path / "frames.csv").open() as file:
        found = {(row["epc"], row["status"]) for row in csv.DictReader(file)}
    assert found == {("tag-a", "occluded"), ("tag-b", "detected")}

    def drawn(status: np.ndarray | None) -> np.ndarray:
        picture, none = np.full((240, 500, 3), 90, np.uint8), np.zeros((2, 240, 500), bool)
        return draw_overlay(picture, ["a", "b"], none, np.zeros((2, 4)), np.ones(2), np.zeros(2, bool), status=status)

    without, unknown = drawn(None), drawn(np.zeros(2, np.int8))
    np.testing.assert_array_equal(without, unknown)
    rows = np.flatnonzero(np.any(drawn(np.array([Status.NOT_READ, Status.UNKNOWN], np.int8)) != without, axis=(1, 2)))
    both = np.flatnonzero(np.any(drawn(np.array([Status.NOT_READ, Status.OCCLUDED], np.int8)) != without, axis=(1, 2)))
    assert 0 < len(rows) < len(both)
    assert rows.max() < both.max() < 40


def test_the_table_fits_a_terminal_of_eighty_columns() -> None:
    summary = {"learned_smoothed": {"all": {"iou": 0.64172, "cle_px": 21.93, "mask_j": 2.25e-4, "num_frames": 1065}}}
    console = Console(width=80, record=True, quiet=False, file=io.StringIO())
    console.print(score_table(summary))
    shown = console.export_text()
    for found in ("learned_smoothed", "0.642", "21.9", "0.000", "1065", "frames"):
        assert found in shown


def test_plain_json_has_no_nan() -> None:
    odd = {"a": [np.float32(1.5), float("nan")], "b": {"c": np.arange(2), 3: np.bool_(True)}, "d": float("inf")}
    assert json.loads(json.dumps(to_json_values(odd), allow_nan=False)) == {
        "a": [1.5, None],
        "b": {"c": [0, 1], "3": True},
        "d": None,
    }


@pytest.mark.parametrize(
    "box", [(100, 60, 160, 180), (5, 3, 60, 239), (300, 4, 319, 100)], ids=["mid", "tall", "right"]
)
def test_labels_of_boxes_that_overlap_cover_neither_each_other_nor_leave_the_picture(box: tuple[int, int, int, int]):
    taken: list[tuple[int, int, int, int]] = []
    for _ in range(6):
        extent = _extent("..000001 0.50", _free_place("..000001 0.50", box, taken, (240, 320)))
        left, top, right, bottom = extent
        assert left >= 0
        assert top >= 0
        assert right <= 320
        assert bottom <= 240
        assert not any(left < c and right > a and top < d and bottom > b for a, b, c, d in taken)
        taken.append(extent)
