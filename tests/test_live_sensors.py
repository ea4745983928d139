"""Running sensors: times on one clock while they come in, every read once, and the stream and its recording as a whole."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from capture_scenes import ORIGIN_NS, reads_table, small_recording, taken_by_a_busy_host
from test_segment_tracer import CONF, scene

from tagjax.core.errors import RecordingError
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.live.config import StreamConfig
from tagjax.live.online_clock import OnlineClock
from tagjax.live.sensors import SensorStream
from tagjax.live.stream import run_stream
from tagjax.recording import TagReads
from tagjax.recording.capture.camera import CameraError
from tagjax.recording.capture.emulation import EmulatedReads, EmulatorSettings
from tagjax.recording.capture.settings import SensorConfig
from tagjax.recording.store import open_recording, save_recording


def delays(number: int, seed: int = 0) -> np.ndarray:
    """Of an idle network half of the time, and held up for 20 ms at most otherwise; seconds."""
    rng = np.random.default_rng(seed)
    return np.where(rng.uniform(size=number) < 0.5, rng.exponential(2e-4, number), rng.uniform(0, 0.02, number))


def times(
    true_s: np.ndarray, delay_s: np.ndarray, drift_ppm: float, offset_s: float = -3600.0
) -> list[tuple[int, int]]:
    sensor_s = true_s * (1 + 1e-6 * drift_ppm) + offset_s
    arrival_s = np.maximum.accumulate(true_s + delay_s)
    return [(round(1e9 * a), round(1e9 * b)) for a, b in zip(sensor_s, arrival_s, strict=True)]


@pytest.mark.parametrize("drift_ppm", [0.0, 200.0, -200.0])
def test_times_are_those_of_the_host_under_drift_and_jitter(drift_ppm):
    true_s = np.sort(np.random.default_rng(1).uniform(0, 120, 40_000))
    clock, found = OnlineClock(), []
    for sensor_ns, arrival_ns in times(true_s, delays(len(true_s)), drift_ppm):
        found.append(clock.host_ns(sensor_ns, arrival_ns))
        assert found[-1] <= arrival_ns
    error_s = np.array(found) * 1e-9 - true_s
    assert np.abs(error_s[true_s > 10]).max() < 1e-3
    assert np.abs(error_s[true_s > 0.5]).max() < 3e-3  # before the drift is known
    assert clock.num_jumps == 0


@pytest.mark.parametrize("load", [0, 1, 2])
def test_a_busy_host_moves_no_clock(load):
    """200 ppm, a network that is held up for 20 ms, pauses of the host of up to 1.5 s: to a millisecond after ten seconds."""
    for seed in range(6):
        network = EmulatorSettings(drift_ppm=200.0, jitter_s=0.02, seed=seed)
        table = EmulatedReads(reads_table(40.0, 76.0, seed=seed), ORIGIN_NS, network)
        arrivals_ns = taken_by_a_busy_host(table.leaves_ns, seed, load=load)
        clock, shown_ns = OnlineClock(), table.reader_time_ns(table.since_ns, 0)
        found = np.array([clock.host_ns(int(a), int(b)) for a, b in zip(shown_ns, arrivals_ns, strict=True)])
        assert np.abs(found - table.since_ns)[table.since_ns > 10**10].max() < 1e6
        assert clock.num_jumps == 0


@pytest.mark.parametrize("step_s", [-500.0, -2.0, 0.5, 500.0])
def test_a_step_of_the_clock_is_one_jump(step_s):
    true_s = np.arange(0, 40, 0.01)
    before, after = (
        times(true_s, delays(len(true_s)), 100.0),
        times(true_s, delays(len(true_s)), 100.0, -3600.0 + step_s),
    )
    clock = OnlineClock()
    found = np.array([clock.host_ns(*one) for one in [*before[:2000], *after[2000:]]])
    assert clock.num_jumps == 1
    assert np.abs(found * 1e-9 - true_s)[-500:].max() < 1e-3


def test_a_clock_that_is_set_anew_is_learnt_anew():
    true_s = np.arange(0, 40, 0.01)
    delay_s = delays(len(true_s))
    before, after = times(true_s, delay_s, 100.0), times(true_s, delay_s, 100.0, offset_s=17.0)
    half = len(true_s) // 2
    clock = OnlineClock()
    found = np.array([clock.host_ns(*one) for one in [*before[:half], *after[half:]]])
    assert clock.num_jumps == 1
    error_s = found * 1e-9 - true_s
    assert np.abs(error_s[-500:]).max() < 1e-3
    assert np.abs(error_s[half:]).max() < 0.021  # the first ones are as late as they arrived


def test_the_first_sample_and_a_single_clock_are_the_arrival():
    clock = OnlineClock()
    assert clock.host_ns(5, 1000) == 1000
    same = OnlineClock()
    assert [same.host_ns(n * 10**7, n * 10**7) for n in range(2000)] == [n * 10**7 for n in range(2000)]


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("played") / "small.zarr"
    save_recording(small_recording(2.0, frame_rate_hz=10.0), path)
    return path


@pytest.mark.parametrize("reader", ["playback", "llrp", "r700"])
def test_every_frame_and_read_comes_once_and_is_recorded(played: Path, tmp_path: Path, reader: str) -> None:
    out = str(tmp_path / "kept.zarr")
    values = {"recording": str(played), "reader": reader, "emulate": reader != "playback"}
    config = from_mapping(SensorConfig, {**values, "emulator": {"jitter_s": 0.01, "drift_ppm": 200.0}})
    stream = SensorStream(config, record=out, reads_wait_s=0.05)
    video = stream.open()
    assert (video.intrinsics.width, video.depth_dtype) == (16, "uint16")
    stream.start()
    frames = list(stream)
    stream.close()
    source = open_recording(played)
    assert len(frames) + stream.num_dropped == source.num_frames
    assert np.all(np.diff([frame.time_ns for frame in frames]) > 0)
    for frame in frames:
        assert np.all(frame.reads.time_ns <= frame.time_ns)
        assert np.all(np.diff(frame.reads.time_ns) >= 0)
        number = [bool(np.array_equal(one, frame.colour)) for one in np.asarray(source.colour)].index(True)
        np.testing.assert_allclose(frame.depth_m, source.depth_metres(number), atol=1e-6)
    summary = stream.summary()
    assert summary["reader_events"]["connected"] == 1
    kept = open_recording(out)
    assert kept.num_frames == summary["record"]["frames"] == source.num_frames - summary["record"]["dropped_frames"]
    traced = [key for frame in frames if frame.reads.num_reads for key in _keys(frame.reads)]
    assert len(set(traced)) == len(traced) > 0
    assert set(traced) <= set(_keys(kept.reads))
    # The others came after the last frame.
    assert len(traced) + stream.num_waiting_reads + stream.num_dropped_reads == kept.reads.num_reads
    assert stream.num_dropped_reads == summary["record"]["dropped_reads"] == 0
    assert stream.notes() == []


def _keys(reads: TagReads) -> list[tuple[str, int, int]]:
    assert reads.reader_time_ns is not None
    return list(zip(reads.epc.tolist(), reads.antenna.tolist(), reads.reader_time_ns.tolist(), strict=True))


def test_a_stream_that_is_closed_at_once_ends(played: Path) -> None:
    stream = SensorStream(from_mapping(SensorConfig, {"recording": str(played)}))
    stream.open()
    stream.close()
    assert list(stream) == []
    with pytest.raises(RecordingError, match="exists"):
        SensorStream(from_mapping(SensorConfig, {"recording": str(played)}), record=str(played))


def test_a_camera_that_is_not_there_is_named(played: Path) -> None:
    stream = SensorStream(from_mapping(SensorConfig, {"recording": str(played), "camera": "k4a"}))
    with pytest.raises(CameraError, match="k4a"):
        stream.open()
    stream.close()


def _config(folder: Path, **changed: Any) -> StreamConfig:
    save_recording(scene(24), folder / "scene.zarr")
    settings = yaml.safe_load(CONF.read_text())
    settings["segments"]["segmenter"]["num_segments"] = 512
    return StreamConfig(recording=str(folder / "scene.zarr"), tracer=settings, flow="zero", num_places=2, **changed)


def test_sensors_are_traced_and_recorded(tmp_path: Path) -> None:
    addresses: list[str] = []
    config = _config(
        tmp_path, camera="playback", reader="playback", record=str(tmp_path / "kept.zarr"),
        page=dataclasses.replace(StreamConfig(recording="a", tracer={}).page, port=0),
    )  # fmt: skip
    summary = run_stream(config, tmp_path / "run", on_page=addresses.append)
    lines = [json.loads(line) for line in (tmp_path / "run/frames.jsonl").read_text().splitlines()]
    assert len(lines) == summary["frames"] > 0
    assert summary["frames"] + summary["dropped_frames"] == 24
    assert set(lines[-1]["tags"]) == {"tag-a", "tag-b"}
    assert summary["sensors"]["record"]["frames"] == open_recording(tmp_path / "kept.zarr").num_frames
    assert addresses[0].startswith("http://127.0.0.1:")


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "found no recording, camera or reader"),
        ({"recording": "r", "camera": "playback"}, "expected both"),
        ({"recording": "r", "record": "a.zarr"}, "without a camera and a reader"),
        ({"camera": "k4a", "reader": "llrp", "address": "x"}, "antennas_m is null"),
        ({"recording": "r", "camera": "playback", "reader": "llrp"}, "emulate=true"),
        ({"recording": "r", "reads_wait_s": 2.0}, "0 to 1 s"),
        ({"recording": "r", "camera": "webcam", "reader": "llrp"}, "webcam"),
        ({"recording": "r", "address": "https://root:a@b"}, "found a user or password"),
    ],
)
def test_settings_that_do_not_fit_together_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        from_mapping(StreamConfig, {"tracer": {}, **values})


def test_the_yaml_repeats_the_defaults_of_the_library() -> None:
    values = yaml.safe_load((CONF.parents[1] / "stream.yaml").read_text())
    own = {field.name for field in dataclasses.fields(StreamConfig)} - {"tracer", "events"}
    assert set(values) - {"defaults", "progress"} == own
    given = {name: values[name] for name in own} | {"recording": "r", "tracer": {}}
    assert from_mapping(StreamConfig, given) == StreamConfig(recording="r", tracer={})
    rules = yaml.safe_load((CONF.parents[1] / "events" / "file.yaml").read_text())
    assert from_mapping(StreamConfig, {"recording": "r", "tracer": {}, "events": rules}).events == StreamConfig(recording="r", tracer={}).events  # fmt: skip
