"""Scores of flow against values made by hand, .flo files, pictures of flow, and whole evaluations."""

from __future__ import annotations

import dataclasses
import json
import struct
from pathlib import Path

import cv2
import numpy as np
import pytest
import synthetic_clips as synthetic
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from tagjax.benchmarks.flow_speed import moved_pictures
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.flow import FlowEvaluationSettings, _labels, evaluate_flows, flow_tables
from tagjax.evaluation.flow_cases import drawn_material, folder_material, recording_material, sequence_material
from tagjax.flow.flo_files import read_flo, write_flo
from tagjax.flow.registry import make_flow
from tagjax.metrics.flow import FlowScores, endpoint_error, warped_error
from tagjax.recording import RecordingError, Truth
from tagjax.recording.store import save_recording
from tagjax.report.flow import colour_wheel, error_colours, flow_colours
from tagjax.report.flow_speed import error_by_time
from tagjax.sim.flow_pairs import FlowPairSettings

CONF = Path(__file__).parents[1] / "conf"
SMALL = FlowPairSettings(height=32, width=48, num_layers=(1, 2), radius_px=(4.0, 12.0))


# Scores


def test_scores_are_those_made_by_hand():
    truth = np.zeros((2, 4, 2), np.float32)
    truth[0] = [[0, 0], [0, 0.5], [3, 4], [0, 100]]  # lengths 0, 0.5, 5, 100
    truth[1] = [[60, 80], [np.nan, 0], [0, 0], [6, 8]]  # 100, unknown, 0, 10
    error = np.array([[0.5, 2.0, 4.0, 4.0], [6.0, 99.0, 0.0, 1.0]], np.float32)
    flow = np.nan_to_num(truth)
    flow[0] += error[0, :, None] * np.float32([0.6, -0.8])
    flow[1, :, 1] += error[1]
    hidden = np.zeros((2, 4), bool)
    hidden[0, 2] = hidden[1, 1] = hidden[1, 0] = True
    scores = FlowScores.of_truth(flow, truth, hidden).result()
    expected = {
        "epe_px": (0.5 + 2 + 4 + 4 + 6 + 0 + 1) / 7,
        "epe_moving_px": (4 + 4 + 6 + 1) / 4,  # 0.5 px is not above the limit
        "epe_still_px": (0.5 + 2 + 0) / 3,
        "epe_visible_px": (0.5 + 2 + 4 + 0 + 1) / 5,
        "epe_hidden_px": (4 + 6) / 2,
        "above_1px": 4 / 7,  # not 1 itself
        "above_3px": 3 / 7,
        "above_5px": 1 / 7,
        "fl": 2 / 7,  # 4 of 5 px, and 6 of 100; not 4 of 100
        "num_pixels": 7,
    }
    assert set(scores) == set(expected)
    for name, value in expected.items():
        assert scores[name] == pytest.approx(value, rel=1e-5), name
    without = FlowScores.of_truth(flow, truth).result()
    assert "epe_hidden_px" not in without
    assert without["epe_px"] == scores["epe_px"]
    slower = FlowScores.of_truth(flow, truth, moving_px=0.4).result()
    assert slower["epe_moving_px"] == pytest.approx((2 + 4 + 4 + 6 + 1) / 5, rel=1e-5)


def test_scores_of_pairs_merge_to_those_of_all_pixels():
    rng = np.random.default_rng(0)
    truth, flow = rng.normal(0, 3, (2, 6, 8, 2)).astype(np.float32), rng.normal(0, 3, (2, 6, 8, 2)).astype(np.float32)
    hidden = rng.random((2, 6, 8)) < 0.3
    truth[0, :4] = np.nan
    parts = [FlowScores.of_truth(f, t, h) for f, t, h in zip(flow, truth, hidden, strict=True)]
    whole = FlowScores.of_truth(flow.reshape(12, 8, 2), truth.reshape(12, 8, 2), hidden.reshape(12, 8))
    merged = parts[0].merge(parts[1]).result()
    assert merged == pytest.approx(whole.result())
    assert parts[0].merge(FlowScores()) == parts[0]
    nothing = FlowScores.of_truth(flow[0], np.full((6, 8, 2), np.nan, np.float32), hidden[0]).result()
    assert nothing["num_pixels"] == 0
    assert nothing["epe_px"] is None
    assert nothing["fl"] is None


def test_a_flow_that_is_not_finite_or_of_another_size_is_refused():
    truth = np.zeros((4, 5, 2), np.float32)
    flow = truth.copy()
    flow[1, 2, 0] = np.nan
    with pytest.raises(ValueError, match="The flow of 1 pixels is not finite"):
        endpoint_error(flow, truth)
    truth[1, 2, 1] = np.inf
    assert np.isnan(endpoint_error(flow, truth)[1, 2])
    with pytest.raises(ValueError, match="expected one shape"):
        endpoint_error(flow[:3], truth)


def test_warped_error_is_zero_for_the_true_shift_and_counts_levels():
    rng = np.random.default_rng(1)
    second = rng.integers(0, 256, (10, 12, 3)).astype(np.uint8)
    first = np.zeros_like(second)
    first[:-1, :-2] = second[1:, 2:]  # what is at x now was to come at x + (2, 1)
    flow = np.broadcast_to(np.float32([2, 1]), (10, 12, 2)).copy()
    error, inside = warped_error(first, second, flow)
    np.testing.assert_allclose(error[:-1, :-2], 0, atol=1e-3)
    assert inside.sum() == 9 * 10
    assert inside[:9, :10].all()
    scores = FlowScores.of_pictures(first, second, flow).result()
    assert scores["warped_levels"] == pytest.approx(0, abs=1e-3)
    assert scores["inside"] == pytest.approx(90 / 120)
    still = FlowScores.of_pictures(first, second, np.zeros_like(flow)).result()
    assert still["warped_levels"] == pytest.approx(np.abs(first.astype(float) - second).mean(), rel=1e-4)
    as_floats = warped_error(first / np.float32(255), second, flow)
    np.testing.assert_allclose(as_floats[0], error, atol=1e-3)


# Files


def test_flo_files_come_back_with_their_unknown_pixels(tmp_path):
    flow = np.random.default_rng(2).normal(0, 30, (3, 5, 2)).astype(np.float32)
    flow[1, 2] = [np.nan, 1.0]
    write_flo(tmp_path / "a.flo", flow)
    found = read_flo(tmp_path / "a.flo")
    flow[1, 2] = np.nan
    np.testing.assert_array_equal(found, flow)
    # The layout of the published description, byte by byte.
    plain = struct.pack("<4sii", b"PIEH", 2, 1) + struct.pack("<4f", 1.5, -2.0, 1.7e9, 0.0)
    (tmp_path / "b.flo").write_bytes(plain)
    np.testing.assert_array_equal(read_flo(tmp_path / "b.flo"), [[[1.5, -2.0], [np.nan, np.nan]]])
    write_flo(tmp_path / "c.flo", np.float32([[[1.5, -2.0]]]))
    assert (tmp_path / "c.flo").read_bytes() == struct.pack("<4siiff", b"PIEH", 1, 1, 1.5, -2.0)
    if hasattr(cv2, "readOpticalFlow"):
        np.testing.assert_array_equal(cv2.readOpticalFlow(str(tmp_path / "c.flo")), [[[1.5, -2.0]]])


def test_damaged_flo_files_are_refused(tmp_path):
    path = tmp_path / "a.flo"
    write_flo(path, np.zeros((4, 6, 2), np.float32))
    good = path.read_bytes()
    for content, message in (
        (b"", "does not begin with 202021.25"),
        (good[:11], "does not begin with"),
        (b"PNG!" + good[4:], "does not begin with"),
        (good[:-1], "holds 203 bytes; 6 x 4 pixels need 204"),
        (good + b"0", "holds 205 bytes"),
        (good[:4] + struct.pack("<ii", -6, 4) + good[12:], "states -6 x 4 pixels"),
        (good[:4] + struct.pack("<ii", 6, 10**6) + good[12:], "states 6 x 1000000 pixels"),
    ):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            read_flo(path)
    with pytest.raises(RecordingError, match="no such file"):
        read_flo(tmp_path / "none.flo")


# Pictures


def test_directions_have_the_usual_colours():
    wheel = colour_wheel()
    assert wheel.shape == (55, 3)
    np.testing.assert_array_equal(wheel[[0, 15, 21, 25, 36, 49]],
        [[255, 0, 0], [255, 255, 0], [0, 255, 0], [0, 255, 255], [0, 0, 255], [255, 0, 255]])  # fmt: skip
    flow = np.float32([[[0, 0], [10, 0], [-10, 0], [0, 10], [0, -10], [5, 0], [40, 0], [np.nan, 0]]])
    colours = flow_colours(flow, 10.0)[0].astype(int)
    np.testing.assert_array_equal(colours[0], [255, 255, 255])
    right, left, down, up, half, beyond, unknown = colours[1:]
    assert right[0] > 200 > 100 > max(right[1:])  # red
    assert left[0] < 100 < 200 < min(left[1:])  # cyan
    assert down[2] < 100 < 200 < min(down[:2])  # yellow
    assert up[2] > 200 > 150 > max(up[:2])  # blue
    np.testing.assert_allclose(half, (255 + right) / 2, atol=2)
    assert max(beyond) < max(right)
    np.testing.assert_array_equal(unknown, [128, 128, 128])
    errors = error_colours(np.array([[0.0, 1.0, 3.0, 9.0, np.nan]]), 3.0)[0].astype(int)
    assert np.all(np.diff(errors[:3].sum(axis=1)) > 0)
    np.testing.assert_array_equal(errors[2], errors[3])
    np.testing.assert_array_equal(errors[4], [128, 128, 128])


# Evaluations


def _scene(folder: Path, first: np.ndarray, second: np.ndarray, flow: np.ndarray | None) -> None:
    folder.mkdir(parents=True)
    for name, picture in (("frame10.png", first), ("frame11.png", second)):
        cv2.imwrite(str(folder / name), picture[..., ::-1])
    if flow is not None:
        write_flo(folder / "flow10.flo", flow)


@pytest.fixture
def scenes(tmp_path) -> Path:
    """Two scenes of Middlebury's kind, moved by (2, 0) and not at all, and one without truth."""
    wall = moved_pictures(40, 64, 1, 0)[0]
    shift = np.zeros((40, 60, 2), np.float32)
    shift[..., 0] = 2
    shift[:3] = np.nan
    _scene(tmp_path / "scenes" / "moved", wall[:, 2:62], wall[:, :60], shift)
    _scene(tmp_path / "scenes" / "still", wall, wall, np.zeros((40, 64, 2), np.float32))
    _scene(tmp_path / "scenes" / "unknown", wall, wall, None)
    return tmp_path / "scenes"


@pytest.fixture
def filmed(tmp_path) -> Path:
    """A stored recording that moves by (2, 0) a frame, with its flow."""
    made = synthetic.enlarged(synthetic.recording(7), 2)
    wall = np.concatenate([moved_pictures(48, 64, 1, 3)[0]] * 2, axis=1)
    colour = np.stack([wall[:, 40 - 2 * t : 104 - 2 * t] for t in range(7)])
    flow = np.zeros((7, 48, 64, 2), np.float32)
    flow[..., 0] = 2
    flow[-1] = np.nan
    hidden = np.zeros((7, 48, 64), bool)
    hidden[:, :, -2:] = True
    truth = Truth(flow_px=flow, occluded=hidden)
    save_recording(dataclasses.replace(made, colour=colour, truth=truth, name="a-b"), tmp_path / "a.zarr")
    return tmp_path / "a.zarr"


def test_an_evaluation_scores_every_flow_on_every_material(scenes, filmed, tmp_path):
    frames = tmp_path / "frames"
    frames.mkdir()
    for number, picture in enumerate(moved_pictures(40, 64, 3, 5)):
        cv2.imwrite(str(frames / f"{number}.png"), picture[..., ::-1])
    settings = FlowEvaluationSettings(
        flows=("zero", "dis"),
        num_pairs=3,
        pairs=SMALL,
        recordings=(str(filmed),),
        folders=(str(scenes),),
        sequences=(str(frames),),
        every=2,
        num_panels=2,
        progress=False,
    )
    folder = tmp_path / "report"
    summary = evaluate_flows(settings, folder)
    assert json.loads((folder / "metrics.json").read_text())["flows"] == {"zero": "zero", "dis": "dis"}
    found = summary["materials"]
    assert list(found) == ["drawn pairs", "recordings", "scenes", "without truth"]
    zero, dis = found["recordings"]["zero"]["all"], found["recordings"]["dis"]["all"]
    assert zero["epe_px"] == pytest.approx(2)
    assert zero["num_pixels"] == 3 * 48 * 64
    assert dis["epe_visible_px"] < 0.2
    assert dis["warped_levels"] < 0.3 * zero["warped_levels"]
    each = found["scenes"]["zero"]["sources"]
    assert each["moved"]["epe_px"] == pytest.approx(2)
    assert each["moved"]["num_pixels"] == 37 * 60
    assert each["still"]["epe_px"] == 0
    assert "epe_px" not in each["unknown"]
    assert found["scenes"]["zero"]["mean_epe_px"] == pytest.approx(1)
    assert found["scenes"]["zero"]["all"]["epe_px"] == pytest.approx(2 * 37 * 60 / (37 * 60 + 40 * 64))
    assert found["without truth"]["dis"]["all"].get("epe_px") is None
    assert (
        found["without truth"]["dis"]["all"]["warped_levels"] < found["without truth"]["zero"]["all"]["warped_levels"]
    )
    names = sorted(path.name for path in (folder / "panels").iterdir())
    assert names == [
        "a-b-0000.png", "a-b-0004.png", "drawn-000.png", "drawn-002.png", "frames-0000.png", "moved.png", "unknown.png",
    ]  # fmt: skip
    panel = cv2.imread(str(folder / "panels" / "moved.png"))
    assert panel is not None
    assert panel.shape[1] == 3 * 320 + 2 * 4
    text = (folder / "flow.md").read_text()
    assert "| zero | 2.000 | 2.000 | 2.000 | 2.000 | 100.0 | 0.0 | 0.0 | 0.0 |" in text
    assert "| EPE px | moved | still | unknown | mean |" in text
    assert "| zero | 2.000 | 0.000 | - | 1.000 |" in text
    assert len(flow_tables(summary)) == 5


def test_scores_before_a_case_that_fails_are_kept_and_called_unfinished(scenes, tmp_path):
    second = scenes / "still" / "frame11.png"
    whole = second.read_bytes()
    second.unlink()
    settings = FlowEvaluationSettings(
        flows=("zero", "dis"), num_pairs=2, pairs=SMALL, folders=(str(scenes),), num_panels=0, progress=False
    )
    folder = tmp_path / "report"
    with pytest.raises(RecordingError, match=r"frame11\.png is missing") as found:
        evaluate_flows(settings, folder)
    assert "unfinished.md" in found.value.__notes__[0]
    assert not (folder / "metrics.json").exists()
    kept = json.loads((folder / "unfinished.json").read_text())
    assert kept["materials"]["drawn pairs"]["zero"]["all"]["num_pixels"] == 2 * 32 * 48
    assert list(kept["materials"]["scenes"]["dis"]["sources"]) == ["moved"]
    text = (folder / "unfinished.md").read_text()
    assert text.startswith("**Unfinished**: 1 of 3 cases of scenes were scored when it ended (RecordingError")
    assert "**drawn pairs**" in text
    second.write_bytes(whole)
    summary = evaluate_flows(settings, folder)
    assert "unfinished" not in summary
    assert sorted(path.name for path in folder.iterdir()) == ["flow.md", "metrics.json"]
    for name in ("frame10.png", "flow10.flo"):
        (scenes / "moved" / name).write_bytes(b"")
    with pytest.raises(RecordingError) as found:
        evaluate_flows(dataclasses.replace(settings, num_pairs=0), tmp_path / "nothing")
    assert not hasattr(found.value, "__notes__")
    assert not (tmp_path / "nothing").exists()


def test_flows_have_short_names():
    names = [
        "dis",
        "pyramid_fine+wls",
        "runs/a/new.safetensors+rest",
        "pyramid_mid:runs/a/new.safetensors",
        "a/w.safetensors",
        "b/w.safetensors",
    ]
    assert list(_labels(names)) == [
        "dis",
        "pyramid_fine+wls",
        "new+rest",
        "pyramid_mid:new",
        "a/w.safetensors",
        "b/w.safetensors",
    ]


def test_errors_are_drawn_against_times_where_both_are_known(tmp_path):
    def scores(error_px: float | None, ms: float | None) -> dict[str, dict[str, float | None]]:
        return {"all": {"epe_moving_px": error_px, "median_ms": ms}}

    flows = {"zero": scores(3.0, 0.1), "dis": scores(1.0, 8.0), "pyramid": scores(0.9, 30.0)}
    assert error_by_time(tmp_path / "a.png", {"recordings": flows, "without truth": {"dis": scores(None, 8.0)}})
    picture = cv2.imread(str(tmp_path / "a.png"))
    assert picture is not None
    assert picture.std() > 10
    assert not error_by_time(tmp_path / "b.png", {"recordings": {"dis": scores(1.0, None)}})
    assert not (tmp_path / "b.png").exists()


def test_drawn_pairs_are_the_same_however_many_are_asked_for():
    few, many = (list(drawn_material(SMALL, number, seed=4).cases()) for number in (2, 9))
    assert len(many) == 9
    for one, other in zip(few, many, strict=False):
        np.testing.assert_array_equal(one.first, other.first)
        np.testing.assert_array_equal(one.truth_px, other.truth_px)
    assert np.any(many[8].first != many[0].first)
    other = next(drawn_material(SMALL, 1, seed=5).cases())
    assert np.any(other.first != few[0].first)


def test_materials_that_cannot_be_used_are_refused(scenes, filmed, tmp_path):
    with pytest.raises(RecordingError, match=r"no frame10\.png, here or in its subfolders"):
        folder_material(str(tmp_path / "nothing"))
    assert [case.source for case in folder_material(str(scenes / "moved")).cases()] == ["moved"]
    (scenes / "moved" / "frame11.png").unlink()
    with pytest.raises(RecordingError, match=r"frame11\.png is missing or not a readable picture"):
        list(folder_material(str(scenes)).cases())
    write_flo(scenes / "still" / "flow10.flo", np.zeros((4, 5, 2), np.float32))
    with pytest.raises(RecordingError, match=r"still: found flow of \(4, 5\) pixels; expected \(40, 64\)"):
        list(folder_material(str(scenes / "still")).cases())
    with pytest.raises(RecordingError, match="no such folder"):
        recording_material((str(tmp_path / "b.zarr"),), every=1, max_pairs=1)
    with pytest.raises(RecordingError, match="expected a recording"):
        sequence_material((str(tmp_path / "b.mp4"),), tmp_path, every=1, max_pairs=1)
    twice = recording_material((str(filmed), str(filmed)), every=5, max_pairs=9)
    assert [case.source for case in twice.cases()] == ["a-b-0", "a-b-0", "a-b-1", "a-b-1"]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"flows": ()}, "flows is empty"),
        ({"num_pairs": 0}, "Nothing to evaluate on"),
        ({"every": 0}, "every is 0; expected at least 1"),
        ({"num_pairs": -1, "folders": ("a",)}, "num_pairs is -1"),
    ],
)
def test_settings_that_evaluate_nothing_are_refused(settings, message):
    with pytest.raises(ValueError, match=message):
        FlowEvaluationSettings(**settings)


def test_unknown_flows_are_refused_before_anything_is_computed(tmp_path):
    with pytest.raises(ValueError, match="Unknown optical flow 'dos'"):
        evaluate_flows(FlowEvaluationSettings(flows=("dos",), progress=False), tmp_path)
    with pytest.raises(ValueError, match="No weights at"):
        evaluate_flows(FlowEvaluationSettings(flows=("none.safetensors",), progress=False), tmp_path)


def test_the_configuration_fits_its_schema_and_names_every_key():
    with initialize_config_dir(str(CONF.resolve()), version_base="1.3"):
        values = OmegaConf.to_container(compose("evaluate_flow"), resolve=True)
    assert isinstance(values, dict)
    for name in ("paths", "suites", "split", "recordings_dir"):  # read by the command itself
        values.pop(name)
    settings = from_mapping(FlowEvaluationSettings, values)
    assert settings.pairs.height == 160
    assert set(values) == {field.name for field in dataclasses.fields(FlowEvaluationSettings)}
    with pytest.raises(ConfigError, match="unknown key 'flow'"):
        from_mapping(FlowEvaluationSettings, {"flow": "dis"})


# Real pictures


@pytest.mark.real_data
def test_dis_on_middlebury_is_as_published_for_it(real_data):
    """0.23, 0.32, 0.65 and 0.16 px were measured with other code (shared/data/README.md)."""
    expected = {"RubberWhale": 0.23, "Grove2": 0.32, "Urban2": 0.65, "Dimetrodon": 0.16}
    cases = list(folder_material(str(real_data / "flow" / "middlebury")).cases())
    assert {case.source for case in cases} == set(expected)
    for case in cases:
        error = np.nanmean(endpoint_error(make_flow("dis")(case.first, case.second), case.truth_px))
        assert error == pytest.approx(expected[case.source], abs=0.006)
