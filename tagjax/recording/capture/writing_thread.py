"""The threads of a recording: one films, one writes. What waits to be written is bounded; what does not fit is counted."""

from __future__ import annotations

import collections
import dataclasses
import math
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..image_files import write_image
from .camera import AbstractCamera, CameraFrame
from .progress import Progress
from .reads import CapturedRead, ReaderEvent, ReaderInfo
from .writer import RecordingWriter, VideoFormat

MAX_FRAME_BYTES = 1 << 28
"""Of frames that wait to be written: some 170 of 640 x 480 pixels."""

MAX_READS = 200_000
_PREVIEW_WIDTH = 320


@runtime_checkable
class Sink(Protocol):
    """What takes the items of camera and reader, from any thread, without waiting."""

    def put(self, item: VideoFormat | CameraFrame | CapturedRead | ReaderEvent | ReaderInfo) -> None: ...


class WritingThread:
    """Writes what is put into it, and commits it every `commit_s` seconds. `error` is what has ended it early.

    `make` makes the writer once the camera is open. `close` writes what waits and ends the thread.
    """

    def __init__(
        self,
        make: Callable[[VideoFormat], RecordingWriter],
        progress: Progress,
        *,
        commit_s: float = 0.5,
        preview: Path | None = None,  # a picture file of the last frame
        max_frame_bytes: int = MAX_FRAME_BYTES,
    ):
        self.error: Exception | None = None
        self.writer: RecordingWriter | None = None
        self._make, self._progress, self._commit_s, self._preview = make, progress, commit_s, preview
        self._waiting: collections.deque[Any] = collections.deque()
        self._max_bytes = max_frame_bytes
        self._num_bytes = self._num_reads = 0
        self._changed, self._closing = threading.Condition(), False
        self._thread = threading.Thread(target=self._run, name="writing", daemon=True)
        self._thread.start()

    def put(self, item: VideoFormat | CameraFrame | CapturedRead | ReaderEvent | ReaderInfo) -> None:
        """Hand over something to be written. A frame or a read for which there is no room is dropped and counted."""
        with self._changed:
            if isinstance(item, CameraFrame):
                fits = self._num_bytes + _num_bytes(item) <= self._max_bytes
                self._num_bytes += fits * _num_bytes(item)
                self._progress.frame(item, fits)
            elif isinstance(item, CapturedRead):
                fits = self._num_reads < MAX_READS
                self._num_reads += fits
                self._progress.read(item, fits)
            else:
                fits = True
            if fits:
                self._waiting.append(item)
                self._changed.notify()

    def close(self) -> None:
        """Write what waits, commit it, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _run(self) -> None:
        try:
            early: list[Any] = []  # of the reader, before the camera is open
            due = time.monotonic() + self._commit_s
            while True:
                items, closing = self._take(due)
                for item in items:
                    if isinstance(item, VideoFormat):
                        self.writer = self._make(item)
                        for one in early:
                            self._write(self.writer, one)
                    elif self.writer is None:
                        early.append(item)
                    else:
                        self._write(self.writer, item)
                    due = self._committed(due)  # also while many wait
                due = self._committed(-math.inf if closing else due)
                if closing:
                    if self.writer is not None:
                        self.writer.close()
                    return
        except Exception as error:
            self.error = error

    def _committed(self, due: float) -> float:
        """Commit what was written if it is due, which nothing is before the camera is open; when the next commit is due."""
        if self.writer is None or (now := time.monotonic()) < due:
            return due
        self.writer.commit()
        self._show()
        return now + self._commit_s

    def _take(self, due: float) -> tuple[list[Any], bool]:
        """What waits, at the latest when a commit is due; and whether nothing more will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting or self._closing, max(0.0, due - time.monotonic()))
            items = list(self._waiting)
            self._waiting.clear()
            self._num_reads = 0
            return items, self._closing

    def _write(self, writer: RecordingWriter, item: Any) -> None:
        if isinstance(item, CameraFrame):
            writer.add_frame(item.colour, item.depth, item.arrival_time_ns, item.device_time_ns)
            with self._changed:
                self._num_bytes -= _num_bytes(item)
        elif isinstance(item, CapturedRead):
            writer.add_reads([item])
        elif isinstance(item, ReaderInfo):
            writer.info = item
        else:
            writer.add_event(item)

    def _show(self) -> None:
        """Write the last frame, colour and depth side by side, as a small picture."""
        frame = self._progress.last_frame
        if self._preview is not None and frame is not None:
            write_preview(self._preview, frame)


def _num_bytes(frame: CameraFrame) -> int:
    return frame.colour.nbytes + frame.depth.nbytes


def write_preview(path: Path, frame: CameraFrame) -> None:
    """A small picture of a frame: colour beside depth, near bright."""
    step = max(1, frame.colour.shape[1] // _PREVIEW_WIDTH)
    colour, depth = frame.colour[::step, ::step], np.nan_to_num(frame.depth[::step, ::step].astype(np.float32))
    far = max(float(np.quantile(depth, 0.98)), 1e-6)
    near = np.where(depth > 0, 255 * (1 - np.clip(depth / far, 0, 1)), 0).astype(np.uint8)
    picture = np.concatenate([colour, np.repeat(near[..., None], 3, 2)], axis=1)
    write_image(path, picture)


class FilmingThread:
    """Opens a camera and hands its frames to the writing thread, or to another sink, until it is closed or the camera has no more."""

    def __init__(self, camera: AbstractCamera, writing: Sink):
        self.error: Exception | None = None
        self.camera, self._writing, self._closing = camera, writing, threading.Event()
        self._thread = threading.Thread(target=self._run, name="filming", daemon=True)
        self._thread.start()

    @property
    def ended(self) -> bool:
        """Whether no more frames come."""
        return not self._thread.is_alive()

    def close(self) -> None:
        """Film no more."""
        self._closing.set()
        self._thread.join()

    def _run(self) -> None:
        try:
            try:
                self._writing.put(self.camera.open())
                for frame in self.camera.frames(self._closing.is_set):
                    self._writing.put(frame)
            finally:
                self.camera.close()
        except Exception as error:
            self.error = error


@dataclasses.dataclass(frozen=True)
class Threads:
    """Both threads of a recording."""

    filming: FilmingThread
    writing: WritingThread

    @property
    def error(self) -> Exception | None:
        """What has ended one of them early."""
        return self.writing.error or self.filming.error
