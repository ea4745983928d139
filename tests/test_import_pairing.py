"""Pairing by time against a search over all pictures, and the memory that an import takes."""

from __future__ import annotations

import tracemalloc
import weakref
from pathlib import Path

import numpy as np
import pytest
from rgbd_files import CAMERA

from tagjax.recording import Intrinsics, RecordingError, TagReads
from tagjax.recording.importers.rgbd.pairing import MAX_WAITING, Tally, pairs
from tagjax.recording.importers.rgbd.source import Picture, RgbdSource, Rig
from tagjax.recording.importers.rgbd.streaming import stream_recording

GAP_S = 0.02


def _picture(stream, time_ms) -> Picture:
    return Picture(stream, round(time_ms * 1e6), f"{stream} {time_ms}", lambda: np.zeros(1))


def _found(events) -> tuple[list[tuple[float, float]], Tally]:
    tally = Tally()
    found = [(one.time_ns / 1e6, other.time_ns / 1e6) for one, other in pairs(events, GAP_S, tally)]
    return found, tally


@pytest.mark.parametrize("seed", range(8))
def test_pairs_are_those_of_a_search_over_all_pictures(seed):
    rng = np.random.default_rng(seed)
    times = {
        stream: np.cumsum(rng.integers(1, 60, 120)).astype(float) for stream in ("colour", "depth")
    }  # whole milliseconds
    events = [_picture(stream, time) for stream, own in times.items() for time in own]
    # Stored a little out of order: each stream in order, the two shifted against each other by up to 300 ms.
    delay = {"colour": rng.uniform(0, 300), "depth": rng.uniform(0, 300)}
    events.sort(key=lambda one: one.time_ns / 1e6 + delay[one.stream])
    expected = []
    for time in times["colour"]:
        gaps = np.abs(times["depth"] - time)
        if gaps.min() <= 1000 * GAP_S:
            expected.append((time, gaps.min()))
    found, tally = _found(events)
    assert [(one, abs(other - one)) for one, other in found] == expected
    assert (tally.num_colour, tally.num_depth, tally.num_pairs) == (120, 120, len(expected))


def test_one_depth_picture_may_serve_two_colour_pictures():
    events = [_picture("colour", 0), _picture("depth", 8), _picture("colour", 16), _picture("colour", 60)]
    found, tally = _found(events)
    assert found == [(0, 8), (16, 8)]
    assert tally.line() == "2 of 3 colour pictures have depth, of 1 depth pictures"


@pytest.mark.parametrize("stops", ["colour", "depth"])
def test_few_pictures_wait_even_where_one_stream_stops(stops):
    alive: list[weakref.ref] = []
    most = 0

    def events():
        nonlocal most
        for number in range(1000):
            for stream in ("colour", "depth"):
                if stream != stops or number < 10:
                    one = _picture(stream, 30.0 * number)
                    alive.append(weakref.ref(one))
                    yield one
                    del one
            most = max(most, sum(ref() is not None for ref in alive))

    tally = Tally()
    assert len(list(pairs(events(), GAP_S, tally))) == 10
    assert tally.num_pairs == 10
    assert most <= 2 * MAX_WAITING + 4 + 2 * 10  # the list of pairs holds 20


def test_streams_that_cannot_be_paired_are_refused():
    for events, message in (
        ([_picture("colour", 0)], "no depth picture"),
        ([_picture("depth", 0)], "no colour picture"),
        (
            [_picture("colour", 0), _picture("depth", 900)],
            r"within 0\.02 s \(colour from 0\.000 to 0\.000 s, depth from 0\.900",
        ),
        (
            [_picture("depth", 0), *(_picture("colour", time) for time in (0, 30, 30))],
            "1 of 3 colour pictures are not later",
        ),
    ):
        _, tally = _found(events)
        with pytest.raises(RecordingError, match=message):
            tally.check("here", GAP_S)


def _source(num_frames: int) -> RgbdSource:
    """Frames that are made when they are decoded: 0.6 MB of colour, 0.4 MB of depth."""
    camera = Intrinsics(**{**CAMERA, "width": 512, "height": 400, "fx_px": 400.0, "fy_px": 400.0})

    def one(stream, number):
        shape, kind = ((400, 512, 3), np.uint8) if stream == "colour" else ((400, 512), np.uint16)
        return Picture(stream, number * 40_000_000, "made", lambda: np.full(shape, number + 1, kind))

    def pictures():
        return (one(stream, number) for number in range(num_frames) for stream in ("colour", "depth"))

    return RgbdSource("made", "made here", Rig(colour=camera, depth_unit_m=0.001), pictures)


def test_memory_does_not_grow_with_the_recording(tmp_path: Path):
    peaks = []
    for num_frames in (5, 10, 80):
        tracemalloc.start()
        video = stream_recording(_source(num_frames), tmp_path / f"{num_frames}.zarr", lambda video: video)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert video.num_frames == num_frames
    assert peaks[2] < peaks[1] + 5e6  # 70 more frames are 70 MB


def test_what_completes_a_recording_may_refuse_it_and_nothing_is_left(tmp_path: Path):
    def refuse(video):
        assert video.depth.shape == (5, 400, 512)
        assert video.reads.num_reads == TagReads.empty().num_reads
        raise RecordingError("no")

    with pytest.raises(RecordingError, match="no"):
        stream_recording(_source(5), tmp_path / "a.zarr", refuse)
    assert list(tmp_path.iterdir()) == []
    stream_recording(_source(5), tmp_path / "a.zarr", lambda video: video)
    with pytest.raises(RecordingError, match="exists"):
        stream_recording(_source(5), tmp_path / "a.zarr", lambda video: video)


def test_depth_that_changes_its_type_is_refused(tmp_path: Path):
    source = _source(1)

    def pictures():
        yield from source.pictures()
        yield Picture("colour", 40_000_000, "made", lambda: np.zeros((400, 512, 3), np.uint8))
        yield Picture("depth", 40_000_000, "floats", lambda: np.ones((400, 512), np.float32))

    with pytest.raises(RecordingError, match="floats: depth is stored in another type"):
        stream_recording(RgbdSource("made", "", source.rig, pictures), tmp_path / "a.zarr", lambda video: video)
