"""A second camera in simulated recordings: rendered where it should be, stored, and without effect on the first camera."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tagjax.core.settings import ConfigError, from_mapping
from tagjax.recording import Recording, RecordingError, SecondCamera
from tagjax.recording.store import open_recording, save_recording
from tagjax.recording.time_reversal import time_reversed
from tagjax.stereo.conversion import StereoSettings, stereo_recording
from tagjax.stereo.matching import MatchSettings, depth_of_pair

pytest.importorskip("mujoco")

from tagjax.sim.record import CaptureSettings, simulate_recording
from tagjax.sim.suites import Suite, item_scenario, make_suite

BASELINE_M = 0.15


def _suite(**capture: float) -> Suite:
    settings = yaml.safe_load((Path(__file__).parents[1] / "conf" / "suite" / "single_static.yaml").read_text())
    small = {"width": 256, "frame_rate_hz": 1.0, "jitter_s": 0.0, **capture}
    settings |= {"capture": small, "variants": [{"name": "box", "settings": {"kinds": ["box"]}}], "duration_s": 1.2}
    return from_mapping(Suite, settings, where="suite")


def _simulated(**capture: float) -> Recording:
    suite = _suite(**capture)
    item = suite.items()[0]
    return simulate_recording(item_scenario(item), suite.capture, seed=item.seed, name=item.name, num_frames=2)


@pytest.fixture(scope="module")
def two() -> Recording:
    return _simulated(stereo_baseline_m=BASELINE_M)


def test_a_second_camera_changes_nothing_of_the_first(two: Recording) -> None:
    one = _simulated()
    assert one.second is None
    for name in ("colour", "depth", "time_ns"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    np.testing.assert_array_equal(one.reads.phase_rad, two.reads.phase_rad)
    np.testing.assert_array_equal(one.truth.labels, two.truth.labels)
    assert "stereo" not in one.source
    assert two.source == one.source[:-1] + f", stereo_baseline_m={BASELINE_M})"
    assert "stereo_baseline_m" not in _suite().as_dict()["capture"]
    assert _suite(stereo_baseline_m=0.15).as_dict()["capture"]["stereo_baseline_m"] == BASELINE_M


def test_the_pair_is_consistent_with_the_depth(two: Recording) -> None:
    """The right picture at x - f B / z shows what the left one shows at x, and at x + f B / z it does not."""
    k, z = two.intrinsics, two.depth_metres(1)
    x, y = np.meshgrid(np.arange(k.width, dtype=np.float32), np.arange(k.height, dtype=np.float32))
    shift = np.where(z > 0, k.fx_px * BASELINE_M / np.maximum(z, 0.1), 0).astype(np.float32)
    left, right = two.colour[1].astype(float), two.second.colour[1]
    inside = (z > 0) & (x - shift > 1) & (x + shift < k.width - 2)

    def difference(sign: float) -> float:
        moved = cv2.remap(right, x + np.float32(sign) * shift, y, cv2.INTER_LINEAR).astype(float)
        return float(np.mean(np.abs(moved - left).mean(axis=-1)[inside] > 12))

    assert inside.mean() > 0.5
    assert difference(-1) < 0.12
    assert difference(-1) < 0.4 * min(difference(0), difference(1))
    # The person alone, in front of a background of another disparity.
    inside &= z < 2.6
    assert inside.mean() > 0.02
    assert difference(-1) < 0.5 * min(difference(0), difference(1))


def test_matching_finds_the_depth_of_the_scene(two: Recording) -> None:
    settings = MatchSettings()
    for frame in range(2):
        found = depth_of_pair(two.colour[frame], two.second.colour[frame], two.intrinsics, BASELINE_M, settings) / 1000
        true = two.depth_metres(frame)
        both = (found > 0) & (true > 0) & (true < 2.6)
        assert both.sum() > 0.7 * np.sum((true > 0) & (true < 2.6))
        # Half a pixel of disparity is 0.5 z^2 / (f B) = 9 cm at 2.2 m here.
        assert np.median(np.abs(found - true)[both]) < 0.05


def test_it_is_stored_opened_and_left_out(two: Recording, tmp_path: Path) -> None:
    save_recording(two, tmp_path / "two.zarr")
    opened = open_recording(tmp_path / "two.zarr")
    assert opened.second.baseline_m == BASELINE_M
    np.testing.assert_array_equal(opened.second.colour[1], two.second.colour[1])
    assert time_reversed(opened).second is None
    single = dataclasses.replace(two, second=None)
    save_recording(single, tmp_path / "one.zarr")
    assert open_recording(tmp_path / "one.zarr").second is None
    assert not (tmp_path / "one.zarr" / "second").exists()
    found, lines = stereo_recording(
        StereoSettings(recording=str(tmp_path / "two.zarr"), out=str(tmp_path / "stereo.zarr"))
    )
    stored = open_recording(tmp_path / "stereo.zarr")
    assert stored.second is None
    assert stored.name == f"{two.name}-stereo"
    assert stored.reads.num_reads == two.reads.num_reads > 0
    np.testing.assert_array_equal(stored.truth.labels[1], two.truth.labels[1])
    expected = depth_of_pair(two.colour[1], two.second.colour[1], two.intrinsics, BASELINE_M, MatchSettings())
    np.testing.assert_array_equal(stored.depth[1], expected)
    np.testing.assert_array_equal(found.depth[0:2], stored.depth[0:2])
    assert any("baseline 150.0 mm" in line for line in lines)
    with pytest.raises(RecordingError, match="one camera; expected a recording with a second one"):
        stereo_recording(StereoSettings(recording=str(tmp_path / "one.zarr")))
    with pytest.raises(RecordingError, match=r"stereo\.zarr exists"):
        stereo_recording(StereoSettings(recording=str(tmp_path / "two.zarr"), out=str(tmp_path / "stereo.zarr")))


def test_swapped_cameras_are_found_in_their_pictures(two: Recording, tmp_path: Path) -> None:
    swapped = dataclasses.replace(two, colour=two.second.colour, second=SecondCamera(two.colour, BASELINE_M))
    save_recording(swapped, tmp_path / "swapped.zarr")
    with pytest.raises(RecordingError, match=r"with left and right exchanged; the cameras are swapped"):
        stereo_recording(StereoSettings(recording=str(tmp_path / "swapped.zarr")))


def test_unusable_second_cameras_are_refused(two: Recording) -> None:
    for baseline_m in (0.0, -0.1, 120.0, float("nan")):
        with pytest.raises(RecordingError, match="baseline_m is"):
            dataclasses.replace(two, second=SecondCamera(two.second.colour, baseline_m)).check()
    with pytest.raises(RecordingError, match=r"second camera's colour is uint8 of shape \(1, "):
        dataclasses.replace(two, second=SecondCamera(two.second.colour[:1], BASELINE_M)).check()
    with pytest.raises(ValueError, match=r"stereo_baseline_m is 0\.0; expected 0\.005 to 2 m"):
        CaptureSettings(stereo_baseline_m=0.0)
    with pytest.raises(ConfigError, match="stereo_baseline_m"):
        _suite(stereo_baseline_m=3.0)


def test_an_older_suite_of_one_camera_is_the_same_suite(tmp_path: Path) -> None:
    """Its suite.json has no key for a second camera; the folder is used as before, and not for another suite of two."""
    one = dataclasses.replace(_suite(), counts=dataclasses.replace(_suite().counts, train=0, validation=0, test=0))
    make_suite(one, tmp_path)
    assert "stereo_baseline_m" not in (tmp_path / one.name / "suite.json").read_text()
    make_suite(one, tmp_path)
    two = dataclasses.replace(one, capture=dataclasses.replace(one.capture, stereo_baseline_m=0.12))
    with pytest.raises(RecordingError, match=r"other settings \(capture\)"):
        make_suite(two, tmp_path)
