"""A recording played as if its sensors were running: frames at their times, or as fast as they are taken.

Frames wait in a queue of bounded length. In real time the oldest waiting frame is dropped where the queue is full, so that the
newest is never late; the reads of dropped frames come with the next frame that is taken. As fast as it goes, the reader of the queue sets the pace and nothing
is dropped.
"""

from __future__ import annotations

import collections
import dataclasses
import threading
import time
from collections.abc import Iterator

import numpy as np

from ..recording import Recording, TagReads


@dataclasses.dataclass(frozen=True)
class ReplaySettings:
    """How a recording is played. Raises `ValueError` for values that are not positive."""

    real_time: bool = True  # false: as fast as frames are taken
    speed: float = 1.0  # of real time
    queue: int = 1  # frames that may wait
    loops: int = 1  # times that the recording is played, one after the other

    def __post_init__(self) -> None:
        for name in ("speed", "queue", "loops"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number.")


@dataclasses.dataclass(frozen=True)
class SensorFrame:
    """One frame as it leaves the sensors."""

    number: int  # of the recording's frames
    time_ns: int  # of the recording, later by its length in every further loop
    due_s: float  # `time.monotonic` at which the sensors gave it
    colour: np.ndarray  # (height, width, 3) uint8
    depth_m: np.ndarray  # (height, width), 0 = missing
    reads: TagReads  # since the frame taken before


class Replay:
    """An iterator over `SensorFrame`; `close` ends it early. `num_dropped` counts frames that were not taken in time.

    `next_pictures` and `with_reads` are its two halves, for one that has work to do on the pictures before the reads.
    """

    def __init__(self, recording: Recording, settings: ReplaySettings | None = None):
        self._recording, self._settings = recording, settings or ReplaySettings()
        self._waiting: collections.deque[SensorFrame] = collections.deque()
        self._changed, self._ended, self._error = threading.Condition(), False, None
        self._taken_ns = -1
        self.num_dropped = 0
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[SensorFrame]:
        return self

    def __next__(self) -> SensorFrame:
        frame = self.next_pictures()
        if frame is None:
            raise StopIteration
        return self.with_reads(frame)

    def next_pictures(self) -> SensorFrame | None:
        """The next frame, still without reads; None after the last."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._ended)
            if self._waiting:
                frame = self._waiting.popleft()
                self._changed.notify_all()
                return frame
            if self._error is not None:
                raise self._error
            return None

    def close(self) -> None:
        """End the replay; frames that wait are dropped."""
        with self._changed:
            self._ended = True
            self._waiting.clear()
            self._changed.notify_all()
        self._thread.join()

    def _play(self) -> None:
        try:
            for frame in self._frames():
                if not self._offer(frame):
                    return
        except Exception as error:
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _frames(self) -> Iterator[SensorFrame]:
        recording, settings = self._recording, self._settings
        times, length_ns = np.asarray(recording.time_ns, np.int64), self._length_ns()
        begun = time.monotonic()
        for loop in range(settings.loops):
            for number, now_ns in enumerate((times + loop * length_ns).tolist()):
                colour, depth_m = np.asarray(recording.colour[number]), recording.depth_metres(number)
                due_s = begun + (now_ns - int(times[0])) * 1e-9 / settings.speed
                if settings.real_time:
                    time.sleep(max(0.0, due_s - time.monotonic()))
                else:
                    due_s = time.monotonic()
                yield SensorFrame(number, now_ns, due_s, colour, depth_m, TagReads.empty())

    def _length_ns(self) -> int:
        times = self._recording.time_ns
        return int(times[-1] - times[0]) + (int(np.median(np.diff(times))) if len(times) > 1 else 33_333_333)

    def with_reads(self, frame: SensorFrame) -> SensorFrame:
        """The frame with the reads since the one before it for which this was called, of this loop."""
        reads = self._recording.reads
        shift_ns = frame.time_ns - int(self._recording.time_ns[frame.number])
        first, last = np.searchsorted(reads.time_ns + shift_ns, [self._taken_ns, frame.time_ns], side="right")
        self._taken_ns = frame.time_ns
        own = reads[slice(int(first), int(last))]
        return dataclasses.replace(frame, reads=dataclasses.replace(own, time_ns=own.time_ns + shift_ns))

    def _offer(self, frame: SensorFrame) -> bool:
        """Put a frame into the queue; false where the replay was closed."""
        with self._changed:
            full = len(self._waiting) >= self._settings.queue
            if full and not self._settings.real_time:
                self._changed.wait_for(lambda: self._ended or len(self._waiting) < self._settings.queue)
            elif full:
                self._waiting.popleft()
                self.num_dropped += 1
            if self._ended:
                return False
            self._waiting.append(frame)
            self._changed.notify_all()
            return True
