"""Frames that are prepared in a thread of their own: the same results, in order, and an end in every case."""

from __future__ import annotations

import dataclasses
import threading
import time

import numpy as np
import pytest
from test_segment_tracer import TRACER, scene

from tagjax.live.ahead import FramesAhead
from tagjax.tracing.live import LiveTracer
from tagjax.tracing.replay import Replay, ReplaySettings, SensorFrame

SCENE = scene(12)


def _no_flow(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.full((*first.shape[:2], 2), float(np.mean(first) - np.mean(second)), np.float32)


def _live() -> LiveTracer:
    return LiveTracer(TRACER, SCENE.intrinsics, SCENE.antennas_m, flow=_no_flow, stride=1, num_places=2)


def test_results_are_those_of_one_frame_after_the_other() -> None:
    one, other = _live(), _live()
    ahead = FramesAhead(Replay(SCENE, ReplaySettings(real_time=False)), other)
    numbers = []
    for frame, prepared in zip(Replay(SCENE, ReplaySettings(real_time=False)), ahead, strict=True):
        numbers.append(prepared.frame.number)
        assert prepared.frame.reads.num_reads == frame.reads.num_reads
        expected = one.process(frame.colour, frame.depth_m, frame.time_ns, frame.reads)
        found = other.follow(prepared.pictures, prepared.frame.time_ns, prepared.frame.reads)
        np.testing.assert_array_equal(found.trace.labels, expected.trace.labels)
        np.testing.assert_array_equal(found.trace.tags.membership, expected.trace.tags.membership)
        assert found.places == expected.places
    assert numbers == list(range(12))
    ahead.close()


def test_the_next_frame_is_prepared_while_one_is_followed() -> None:
    ahead = FramesAhead(Replay(SCENE, ReplaySettings(real_time=False)), _live())
    next(ahead)
    until = time.monotonic() + 10
    while ahead._waiting is None and time.monotonic() < until:
        time.sleep(0.001)
    assert ahead._waiting is not None
    assert ahead._waiting.frame.number == 1
    time.sleep(0.05)
    assert ahead._waiting.frame.number == 1  # no more than one waits: a later frame would be newer
    ahead.close()


class _Broken:
    """One frame, and then an error, or nothing for ever."""

    num_dropped = 0

    def __init__(self, error: Exception | None):
        self._replay, self._error = Replay(SCENE, ReplaySettings(real_time=False)), error
        self._count, self._closed = 0, threading.Event()

    def next_pictures(self) -> SensorFrame | None:
        self._count += 1
        if self._count == 1:
            return self._replay.next_pictures()
        if self._error is not None:
            raise self._error
        self._closed.wait()
        return None

    def with_reads(self, frame: SensorFrame) -> SensorFrame:
        return self._replay.with_reads(frame)

    def close(self) -> None:
        self._closed.set()
        self._replay.close()


def test_an_error_of_the_sensors_comes_after_the_frames_before_it() -> None:
    ahead = FramesAhead(_Broken(OSError("unplugged")), _live())
    assert next(ahead).frame.number == 0
    with pytest.raises(OSError, match="unplugged"):
        next(ahead)
    ahead.close()


def test_pictures_of_another_size_are_an_error_here_too() -> None:
    live, replay = _live(), Replay(SCENE, ReplaySettings(real_time=False))
    larger = dataclasses.replace(SCENE.intrinsics, width=SCENE.intrinsics.width + 1)
    live._intrinsics = larger
    ahead = FramesAhead(replay, live)
    with pytest.raises(ValueError, match="as the intrinsics say"):
        next(ahead)
    ahead.close()


def test_a_camera_that_gives_nothing_any_more_does_not_hold_up_the_end() -> None:
    ahead = FramesAhead(_Broken(None), _live())
    next(ahead)
    ahead.close()
    assert not ahead._thread.is_alive()
    with pytest.raises(StopIteration):
        next(ahead)
