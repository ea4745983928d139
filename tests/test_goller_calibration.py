"""Goller et al.: room frame, RSSI, calibration and training."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import goller_scenes as scenes
import jax
import numpy as np
import pytest

from tagjax.baselines.goller import load_calibration, save_calibration
from tagjax.baselines.goller.calibration import calibrate
from tagjax.baselines.goller.offline import observe
from tagjax.baselines.goller.room import RoomFrame, find_room_frame, level_room_frame
from tagjax.baselines.goller.rssi import grid_statistic, mean_rssi, rssi_reads
from tagjax.baselines.goller.training import fit_association
from tagjax.baselines.goller.truth import true_tags
from tagjax.recording import RecordingError, TagReads, Truth


@pytest.fixture(scope="module")
def shop():
    return scenes.shop()


@pytest.fixture(scope="module")
def calibration():
    return scenes.calibration()


def test_the_room_frame_lies_below_the_antennas(shop):
    room_frame = find_room_frame(shop)
    room = room_frame.to_room(scenes.ANTENNAS_M)
    np.testing.assert_allclose(room, [[0, 0, 2.8], [2.1, 0, 2.8], [4.2, 0, 2.8]], atol=0.01)
    np.testing.assert_allclose(room_frame.to_camera(room), scenes.ANTENNAS_M, atol=1e-9)
    np.testing.assert_allclose(room_frame.axes @ room_frame.axes.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(room_frame.axes) > 0
    point = np.array([1.3, -0.4])
    camera = room_frame.to_camera(np.append(point, 0.85)[None])[0]
    pixel = scenes.FOCAL * camera[:2] / camera[2] + np.array([scenes.LENS.cx_px, scenes.LENS.cy_px])
    np.testing.assert_allclose(room_frame.pixels_on_plane(pixel[None], scenes.LENS, 0.85)[0], point, atol=1e-6)
    assert np.isnan(room_frame.pixels_on_plane(pixel[None], scenes.LENS, 10.0)).all()


def test_a_level_camera_needs_no_depth():
    # The camera looks along the room, 20 degrees down, from 2.5 m above the floor and 1 m in front of antenna 1.
    tilt = np.deg2rad(20.0)
    axes = np.array([[0.0, np.sin(tilt), np.cos(tilt)], [-1.0, 0.0, 0.0], [0.0, -np.cos(tilt), np.sin(tilt)]])
    truth = RoomFrame(np.zeros(3), axes)
    room = np.array([[0.0, 0.0, 2.8], [2.1, 0.0, 2.8], [4.2, 0.0, 2.8]])
    offset = np.array([1.0, 0.0, -2.5])
    antennas_m = (room + offset) @ truth.axes
    room_frame = level_room_frame(antennas_m, 2.8)
    np.testing.assert_allclose(room_frame.axes, axes, atol=1e-9)
    np.testing.assert_allclose(room_frame.to_room(antennas_m), room, atol=1e-9)
    with pytest.raises(ValueError, match="expected at least 2"):
        level_room_frame(antennas_m[:1], 2.8)
    with pytest.raises(ValueError, match="positive height"):
        level_room_frame(antennas_m, 0.0)


def test_a_recording_without_floor_is_refused(shop):
    wall = dataclasses.replace(shop, antennas_m=np.array([[0.0, 0.0, 4.0], [0.0, 0.0, 6.0]]))
    with pytest.raises(RecordingError, match=r"no floor found|upright"):
        find_room_frame(wall)
    with pytest.raises(RecordingError, match="no floor found"):
        find_room_frame(dataclasses.replace(shop, depth=np.zeros_like(shop.depth)))


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
    found = mean_rssi(rssi_reads(reads, ["b", "a", "c"]), frames, (3, 2), 0.3)
    for frame, now in enumerate(frames):
        for tag, epc in enumerate(["b", "a", "c"]):
            for antenna in range(2):
                mine = (reads.epc == epc) & (reads.antenna == antenna + 1) & np.isfinite(reads.rssi_dbm)
                mine &= (reads.time_ns <= now) & (reads.time_ns > now - 300_000_000)
                assert found.received[frame, tag, antenna] == mine.any()
                if mine.any():
                    np.testing.assert_allclose(
                        found.rssi_dbm[frame, tag, antenna], reads.rssi_dbm[mine].mean(), rtol=1e-4
                    )
    with pytest.raises(ValueError, match="period_s is 0"):
        mean_rssi(rssi_reads(reads, ["a"]), frames, (1, 2), 0.0)


def test_calibration_from_a_grid_recording_finds_the_antennas(tmp_path):
    recording = scenes.grid_recording()
    statistic = grid_statistic(recording, find_room_frame(recording))
    assert len(statistic.position_m) == len(scenes.grid_points(0.7))
    found = calibrate(recording)
    model = found.location.antennas
    np.testing.assert_allclose(model.mean_m, [[0, 0], [2.1, 0], [4.2, 0]], atol=0.02)
    np.testing.assert_allclose(np.exp(model.log_scale_m), scenes.SCALES, rtol=0.15)
    save_calibration(found, tmp_path / "c.json")
    again = load_calibration(tmp_path / "c.json")
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6)


def test_recordings_and_files_without_a_calibration_are_refused(shop, tmp_path):
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
    with pytest.raises(RecordingError, match="never stationary"):
        calibrate(dataclasses.replace(moving, time_ns=shop.time_ns[8:60]))
    with pytest.raises(RecordingError, match="tag_position_m"):
        true_tags(dataclasses.replace(shop, truth=None))


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
        (".alarm_threshold", float("nan"), "expected finite numbers"),
        (".rssi_threshold_dbm", float("-inf"), "expected finite numbers"),
        (".rssi_threshold_dbm", 1e300, "finite as float32"),
        (".rssi_threshold_dbm", 10**400, "expected finite numbers"),
        (_MEAN, [[0.0, 0.0], [1.0], [2.0, 0.0]], r"expected finite numbers of shape \(3, 2\)"),
        (_MEAN, [[0.0, 0.0]], r"is \[\[0\.0, 0\.0\]\]; expected finite numbers of shape \(3, 2\)"),
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


@pytest.mark.ci
def test_training_lowers_the_loss_and_keeps_the_antennas(shop, calibration):
    examples = [(observe(shop, scenes.LOOKING_DOWN), true_tags(shop))]
    fitted, losses = fit_association(calibration, examples, scenes.LOOKING_DOWN, num_steps=12, learning_rate=0.1)
    assert losses[-1] < 0.9 * losses[0]
    np.testing.assert_array_equal(fitted.location.antennas.log_scale_m, calibration.location.antennas.log_scale_m)
    assert float(fitted.association.log_speed_m_s) != float(calibration.association.log_speed_m_s)
    silent = [(observe(shop.with_reads(TagReads.empty()), scenes.LOOKING_DOWN), true_tags(shop))]
    with pytest.raises(ValueError, match="Found no read tag"):
        fit_association(calibration, silent, scenes.LOOKING_DOWN)
