"""Counts of a running recording, its line of progress, and the summary at its end."""

from __future__ import annotations

import collections
import statistics
import threading
import time
from typing import Any

from .camera import CameraFrame
from .clocks import DriftMeter
from .reads import CapturedRead, ReaderEvent

_MAX_RSSI = 2000


class Progress:
    """Counts frames, reads and events. Any thread may use it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self.num_frames = self.num_dropped_frames = self.num_reads = self.num_dropped_reads = 0
        self.events: collections.Counter[str] = collections.Counter()
        self.last_event = ""
        self.last_frame: CameraFrame | None = None
        self.epcs: set[str] = set()
        self._drift, self._begun = DriftMeter(), time.monotonic()
        self._rssi_dbm: collections.deque[float] = collections.deque(maxlen=_MAX_RSSI)
        self._since = (self._begun, 0, 0)

    def frame(self, frame: CameraFrame, kept: bool) -> None:
        """Count a frame."""
        with self._lock:
            self.num_frames += kept
            self.num_dropped_frames += not kept
            self.last_frame = frame

    def read(self, read: CapturedRead, kept: bool) -> None:
        """Count a read."""
        with self._lock:
            self.num_reads += kept
            self.num_dropped_reads += not kept
            self.epcs.add(read.epc)
            self._rssi_dbm.append(read.rssi_dbm)
            self._drift.add(read.reader_time_ns, read.arrival_time_ns)

    @property
    def num_taken(self) -> int:
        """Reads of the reader so far, with those that were dropped, reported twice, or not usable."""
        with self._lock:
            others = self.events["malformed"] + self.events["duplicate"] + self.events["overflow"]
            return self.num_reads + self.num_dropped_reads + others

    def event(self, event: ReaderEvent) -> None:
        """Count an event."""
        with self._lock:
            self.events[event.kind] += event.count
            self.last_event = event.text

    def line(self) -> str:
        """Rates since the last call, tags, median RSSI, drift of the reader's clock, and the last event."""
        with self._lock:
            now, (since, frames, reads) = time.monotonic(), self._since
            self._since, passed = (now, self.num_frames, self.num_reads), max(now - since, 1e-9)
            heard = [value for value in self._rssi_dbm if value == value]
            self._rssi_dbm.clear()
            parts = [
                f"{now - self._begun:.0f} s",
                f"{(self.num_frames - frames) / passed:.1f} frames/s",
                f"{(self.num_reads - reads) / passed:.0f} reads/s of {len(self.epcs)} tags",
            ]
            parts += [f"RSSI {statistics.median(heard):.1f} dBm"] if heard else []
            drift = self._drift.drift_ppm
            parts += [f"drift {drift:+.0f} ppm"] if drift == drift else []
            parts += [f"{self.num_dropped_frames} frames dropped"] if self.num_dropped_frames else []
            parts += [self.last_event] if self.last_event else []
            return "; ".join(parts)

    def summary(self) -> dict[str, Any]:
        """All counts."""
        with self._lock:
            return {
                "frames": self.num_frames,
                "dropped_frames": self.num_dropped_frames,
                "reads": self.num_reads,
                "dropped_reads": self.num_dropped_reads,
                "tags": sorted(self.epcs),
                "events": dict(self.events),
            }
