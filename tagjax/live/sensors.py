"""Frames and reads of running sensors, on one clock, for a tracer: what `Replay` is for a stored recording.

Camera and reader have a thread each, and a recording that is kept a third. The newest frame waits for the tracer; one that
is not taken in time is dropped and counted. A frame waits `reads_wait_s` for reads that were made before it and are still
under way; what comes later than that is not used by the tracer, and is recorded all the same.
"""

from __future__ import annotations

import asyncio
import collections
import contextlib
import dataclasses
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import RecordingError
from ..recording import TagReads
from ..recording.capture.camera import CameraFrame
from ..recording.capture.finish import finish_recording
from ..recording.capture.progress import Progress
from ..recording.capture.reads import HOST_CLOCK, CapturedRead, ReaderEvent, ReaderInfo, as_tag_reads
from ..recording.capture.record import hand_over_reads
from ..recording.capture.settings import SensorConfig, make_sensors
from ..recording.capture.writer import RecordingWriter, VideoFormat
from ..recording.capture.writing_thread import FilmingThread, WritingThread
from ..tracing.replay import SensorFrame
from .online_clock import OnlineClock

_MAX_READS = 100_000  # that wait for a frame
_POLL_S = 0.05


class SensorStream:
    """An iterator over `SensorFrame`. It ends where the camera has no more frames.

    `open` starts the camera, and `start` the reader; frames count from then on. `close` ends all, and finishes the recording
    at `record`, which must not exist. `next_pictures` and `with_reads` are the two halves of a step: what works on the pictures
    meanwhile need not wait for the reads. Raises `CameraError`, `ReaderError` or `RecordingError` as they occur.
    """

    def __init__(self, config: SensorConfig, *, record: str | None = None, reads_wait_s: float = 0.02):
        if record is not None and Path(record).exists():
            raise RecordingError(f"{record} exists. Remove it or choose another name.")
        self.sensors = make_sensors(config)
        self.name = self.sensors.camera.name
        self._config, self._record, self._wait_s = config, record, reads_wait_s
        self._progress, self._changed = Progress(), threading.Condition()
        self._frames: collections.deque[tuple[int, CameraFrame]] = collections.deque()
        self._reads: collections.deque[tuple[int, CapturedRead]] = collections.deque()
        self._info, self._last_event = ReaderInfo("", ""), ReaderEvent("reader", "")
        self._video: VideoFormat | None = None
        self._clocks = {"camera": OnlineClock(), "reader": OnlineClock()}
        self._started, self._closed = False, threading.Event()
        self._error: Exception | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[Any] | None = None
        self._filming: FilmingThread | None = None
        self._reading: threading.Thread | None = None
        self._writing: WritingThread | None = None
        self._number, self._taken_ns = 0, -1
        self.num_dropped = self.num_dropped_reads = 0

    def open(self) -> VideoFormat:
        """Start the camera and wait for the format of its frames."""
        self._filming = FilmingThread(self.sensors.camera, self)
        with self._changed:
            while self._video is None:
                self._changed.wait(_POLL_S)
                if self._filming.ended and self._video is None:
                    raise self._filming.error or RecordingError(f"{self.name}: the camera gave no frame.")
            return self._video

    def start(self) -> None:
        """Start the reader, and the recording; call it once the tracer is ready."""
        assert self._video is not None, "open comes first"
        if self._record is not None:
            self._writing = WritingThread(self._writer, self._progress)
            self._writing.put(self._video)
        self._started = True
        self._reading = threading.Thread(target=self._read, name="reading", daemon=True)
        self._reading.start()

    def put(self, item: VideoFormat | CameraFrame | CapturedRead | ReaderEvent | ReaderInfo) -> None:
        """Take what camera and reader give, from their threads."""
        if self._started and self._writing is not None:
            self._writing.put(item)
        with self._changed:
            if isinstance(item, VideoFormat):
                self._video = item
            elif isinstance(item, CameraFrame):
                self._take_frame(item)
            elif isinstance(item, CapturedRead):
                time_ns = self._clocks["reader"].host_ns(item.reader_time_ns, item.arrival_time_ns)
                if len(self._reads) >= _MAX_READS:
                    self._reads.popleft()
                    self.num_dropped_reads += 1
                self._reads.append((time_ns, item))
            elif isinstance(item, ReaderInfo):
                self._info = item
            else:
                self._last_event = item
            self._changed.notify_all()

    def __iter__(self) -> Iterator[SensorFrame]:
        return self

    def __next__(self) -> SensorFrame:
        frame = self.next_pictures()
        if frame is None:
            raise StopIteration
        return self.with_reads(frame)

    def next_pictures(self) -> SensorFrame | None:
        """The newest frame, still without reads; None where no more come."""
        with self._changed:
            while not self._frames and self._error is None and not self._over():
                self._changed.wait(_POLL_S)
            if self._error is not None:
                raise self._error
            if not self._frames:
                if self._filming is not None and self._filming.error is not None:
                    raise self._filming.error
                return None
            time_ns, frame = self._frames.popleft()
        time_ns = max(time_ns, self._taken_ns + 1)
        self._taken_ns, self._number = time_ns, self._number + 1
        due_s = time.monotonic() - 1e-9 * (HOST_CLOCK.now_ns() - frame.arrival_time_ns)
        return SensorFrame(self._number - 1, time_ns, due_s, frame.colour, _metres(frame.depth), TagReads.empty())

    def with_reads(self, frame: SensorFrame) -> SensorFrame:
        """The frame with the reads made until then, once those that were under way had their time to come."""
        left_s = frame.due_s + self._wait_s - time.monotonic()
        if left_s > 0:
            self._closed.wait(left_s)
        return dataclasses.replace(frame, reads=self._reads_until(frame.time_ns))

    @property
    def num_waiting_reads(self) -> int:
        """Reads that came after the last frame that was taken, or were made after it."""
        return len(self._reads)

    def notes(self) -> list[str]:
        """What is wrong at present, a line each."""
        event, found = self._last_event, []
        if event.kind in ("lost", "malformed", "overflow", "ended"):
            found.append(f"reader: {event.text}")
        if self._writing is not None and self._writing.error is not None:
            found.append(f"nothing is recorded any more: {self._writing.error}")
        return found

    def close(self) -> None:
        """End camera, reader and recording."""
        if self._closed.is_set():
            return
        self._closed.set()
        if self._filming is not None:
            self._filming.close()
        if self._loop is not None and self._task is not None:
            with contextlib.suppress(RuntimeError):  # the loop has ended by itself
                self._loop.call_soon_threadsafe(self._task.cancel)
        if self._reading is not None:
            self._reading.join()
        if self._writing is not None:
            self._writing.close()

    def summary(self) -> dict[str, Any]:
        """What happened to the reader's stream, and the recording, which is finished by this; after `close`."""
        found: dict[str, Any] = {"reader_events": dict(self._progress.events)}
        if self._writing is None or self._record is None:
            return found
        counts = self._progress.summary()
        kept: dict[str, Any] = {
            "out": self._record,
            "dropped_frames": counts["dropped_frames"],
            "dropped_reads": counts["dropped_reads"],
        }
        if self._writing.error is not None:
            kept["error"] = str(self._writing.error)
        if Path(self._record).exists():
            finished = finish_recording(self._record)
            kept |= {"frames": finished.num_frames, "reads": finished.num_reads}
        return {**found, "record": kept}

    def _over(self) -> bool:
        """Whether no more frames come."""
        return self._closed.is_set() or self._filming is None or self._filming.ended

    def _take_frame(self, frame: CameraFrame) -> None:
        device_ns = frame.arrival_time_ns if frame.device_time_ns is None else frame.device_time_ns
        time_ns = self._clocks["camera"].host_ns(device_ns, frame.arrival_time_ns)
        if not self._started:
            return
        if self._frames:
            self._frames.popleft()
            self.num_dropped += 1
        self._frames.append((time_ns, frame))

    def _reads_until(self, time_ns: int) -> TagReads:
        """The reads up to a time, in its order; later ones wait for the next frame."""
        with self._changed:
            waiting = list(self._reads)
            self._reads = collections.deque(one for one in waiting if one[0] > time_ns)
            hop_table_hz = self._info.hop_table_hz
        taken = sorted((one for one in waiting if one[0] <= time_ns), key=lambda one: one[0])
        if not taken:
            return TagReads.empty()
        table = as_tag_reads([read for _, read in taken], hop_table_hz)
        return dataclasses.replace(table, time_ns=np.array([stamp for stamp, _ in taken], np.int64))

    def _writer(self, video: VideoFormat) -> RecordingWriter:
        sensors, out = self.sensors, Path(self._record or "")
        writer = RecordingWriter(out, video, sensors.antennas_m, name=out.stem, source=sensors.source)
        writer.camera = sensors.camera.describe()
        return writer

    def _read(self) -> None:
        try:
            asyncio.run(self._read_all())
        except asyncio.CancelledError:
            return
        except Exception as error:
            with self._changed:
                self._error = error
                self._changed.notify_all()

    async def _read_all(self) -> None:
        self._loop, self._task = asyncio.get_running_loop(), asyncio.current_task()
        if self._closed.is_set():
            return
        async with self.sensors.emulator or contextlib.nullcontext():
            await hand_over_reads(self._config, self.sensors, self, self._progress)


def _metres(depth: np.ndarray) -> np.ndarray:
    """Depth in metres, 0 = missing, of millimetres as uint16 or metres as float32."""
    if depth.dtype.kind == "u":
        return depth * np.float32(1e-3)
    metres = depth.astype(np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))
