"""Replay of a recording, and the stream command on it: order, reads, dropped frames, Ctrl-C, percentiles."""

from __future__ import annotations

import itertools
import json
import time
from pathlib import Path

import numpy as np
import pytest
import yaml
from synthetic_clips import recording
from test_segment_tracer import CONF, scene

from tagjax.core.settings import ConfigError
from tagjax.live.config import StreamConfig
from tagjax.live.durations import Milliseconds
from tagjax.live.stream import run_stream
from tagjax.recording.store import save_recording
from tagjax.tracing.replay import Replay, ReplaySettings

FAST = ReplaySettings(real_time=False)


def test_every_frame_comes_once_with_the_reads_since_the_last():
    one = recording(12)
    frames = list(Replay(one, FAST))
    assert [frame.number for frame in frames] == list(range(12))
    assert [frame.time_ns for frame in frames] == one.time_ns.tolist()
    stamps = np.concatenate([frame.reads.time_ns for frame in frames])
    np.testing.assert_array_equal(stamps, one.reads.time_ns[one.reads.time_ns <= one.time_ns[-1]])
    for before, frame in itertools.pairwise(frames):
        assert np.all((frame.reads.time_ns > before.time_ns) & (frame.reads.time_ns <= frame.time_ns))
    np.testing.assert_array_equal(frames[5].depth_m, one.depth_metres(5))


def test_loops_follow_each_other_at_the_frame_rate():
    frames = list(Replay(recording(6, rate_hz=10.0), ReplaySettings(real_time=False, loops=3)))
    assert [frame.number for frame in frames] == [*range(6)] * 3
    np.testing.assert_array_equal(np.diff([frame.time_ns for frame in frames]), 100_000_000)
    assert all(np.all(frame.reads.time_ns <= frame.time_ns) for frame in frames)
    assert sum(frame.reads.num_reads for frame in frames[6:12]) > 0


def test_late_frames_are_dropped_and_counted_and_their_reads_are_not_lost():
    one = recording(20, rate_hz=20.0)
    replay, taken = Replay(one, ReplaySettings(speed=2.0)), []
    for frame in replay:
        taken.append(frame)
        time.sleep(0.11)  # four frames come meanwhile
    assert replay.num_dropped > 5
    assert len(taken) + replay.num_dropped == 20
    assert taken[-1].number == 19  # the newest is never dropped
    stamps = np.concatenate([frame.reads.time_ns for frame in taken])
    np.testing.assert_array_equal(stamps, one.reads.time_ns[one.reads.time_ns <= one.time_ns[-1]])


def test_real_time_is_real():
    begun = time.monotonic()
    assert len(list(Replay(recording(11, rate_hz=20.0), ReplaySettings(queue=20)))) == 11
    assert time.monotonic() - begun >= 0.5


def test_a_replay_that_is_closed_ends():
    replay = Replay(recording(40), ReplaySettings())
    next(replay)
    replay.close()
    assert list(replay) == []


@pytest.mark.parametrize("wrong", [{"speed": 0.0}, {"queue": 0}, {"loops": -1}])
def test_a_replay_that_cannot_be_is_refused(wrong):
    with pytest.raises(ValueError, match="expected a positive number"):
        ReplaySettings(**wrong)


def test_percentiles_are_those_of_numpy():
    values = np.random.default_rng(0).gamma(3.0, 5e-3, 5000)
    found = Milliseconds()
    for value in values:
        found.add(value)
    for percent in (50, 90, 99):
        assert found.percentile(percent) == pytest.approx(1e3 * np.percentile(values, percent), rel=0.02)
    assert found.summary()["max"] == pytest.approx(1e3 * values.max(), abs=0.01)
    assert np.isnan(Milliseconds().percentile(50))


def _config(folder: Path, **changed) -> StreamConfig:
    save_recording(scene(24), folder / "scene.zarr")
    settings = yaml.safe_load(CONF.read_text())
    settings["segments"]["segmenter"]["num_segments"] = 512
    return StreamConfig(
        recording=str(folder / "scene.zarr"),
        tracer=settings,
        flow="zero",
        num_places=2,
        replay=FAST,
        **changed,
    )


def test_a_stream_writes_a_line_a_frame_and_a_summary(tmp_path):
    seen = []
    summary = run_stream(_config(tmp_path), tmp_path / "run", on_progress=lambda *one: seen.append(one))
    lines = [json.loads(line) for line in (tmp_path / "run/frames.jsonl").read_text().splitlines()]
    assert len(lines) == summary["frames"] == 24
    assert [one[:3] for one in seen] == [("stream", done, 24) for done in range(25)]
    assert summary["dropped_frames"] == 0
    assert summary["unused_reads"] == 1  # at the time of the first frame, which has none
    assert summary["camera_moved"] is False
    assert not summary["interrupted"]
    assert json.loads((tmp_path / "run/stream.json").read_text())["frames"] == 24
    assert set(lines[-1]["tags"]) == {"tag-a", "tag-b"}
    x0, _, x1, _ = lines[-1]["tags"]["tag-a"]["box_px"]  # every pixel of a picture 64 pixels wide
    np.testing.assert_allclose([x0, x1], [8, 23], atol=1.0)
    tag = lines[-1]["tags"]["tag-a"]
    assert tag["detected"]
    assert tag["confidence"] > 0.5
    every = [one["status"] for line in lines for one in line["tags"].values()]
    assert tag["status"] == "detected"
    assert {status: every.count(status) for status in summary["status"]} == summary["status"]
    assert sum(summary["status"].values()) == len(every)
    assert summary["status"]["not_read"] > 0  # at the start
    assert len(tag["box_px"]) == 4
    assert len(tag["centre_m"]) == 3
    assert 0 < summary["process_ms"]["p50"] <= summary["process_ms"]["p99"] <= summary["process_ms"]["max"]


def test_ctrl_c_keeps_what_was_traced(tmp_path):
    def interrupt(stage: str, done: int, total: int, now: str = "") -> None:
        if done == 5:
            raise KeyboardInterrupt

    summary = run_stream(_config(tmp_path), tmp_path / "run", on_progress=interrupt)
    assert summary["interrupted"]
    assert summary["frames"] == 5
    assert len((tmp_path / "run/frames.jsonl").read_text().splitlines()) == 5


def test_a_tracer_that_does_not_run_live_is_refused(tmp_path):
    config = StreamConfig(
        recording=str(tmp_path), tracer={"_target_": "tagjax.tagattention.literal.TagAttentionLiteral"}
    )
    with pytest.raises(ConfigError, match="expected one that runs live"):
        run_stream(config, tmp_path / "run")
