"""The result of a frame as files, events and the page have it, and the totals of a stream."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..metrics.recordings import box_to_picture
from ..tracing.live import LiveFrame
from ..tracing.status import Status
from .durations import Milliseconds
from .events import Sighting


def sightings(found: LiveFrame, stride: int, shape: tuple[int, int]) -> dict[str, Sighting]:
    """The result for each tag that has a place: boxes in pixels of the whole picture (height, width), places in the camera
    frame.
    """
    trace = found.trace
    boxes = box_to_picture(np.asarray(trace.box_px), stride, *shape)
    confidence, detected, status, centre_m = (
        np.asarray(x) for x in (trace.tags.confidence, trace.tags.detected, trace.tags.status, trace.tags.centre_m)
    )
    return {
        epc: Sighting(
            status=Status(int(status[place])).word,
            detected=bool(detected[place]),
            confidence=round(float(confidence[place]), 3),
            box_px=tuple(round(float(value), 1) for value in boxes[place]) if detected[place] else None,
            centre_m=tuple(round(float(value), 3) for value in centre_m[place]) if detected[place] else None,
        )
        for epc, place in found.places.items()
    }


@dataclasses.dataclass
class Totals:
    """What a stream has come to so far."""

    num_frames: int = 0
    num_dropped_reads: int = 0
    num_unused_reads: int = 0
    preparing: Milliseconds = dataclasses.field(default_factory=Milliseconds)
    computing: Milliseconds = dataclasses.field(default_factory=Milliseconds)
    latency: Milliseconds = dataclasses.field(default_factory=Milliseconds)
    statuses: dict[str, int] = dataclasses.field(
        default_factory=lambda: {one.word: 0 for one in Status if one is not Status.UNKNOWN}
    )

    def add(
        self, found: LiveFrame, tags: dict[str, Sighting], *, prepared_s: float, followed_s: float, latency_s: float
    ) -> None:
        """Count a frame: the time that its flow and the tracer's step took, and that from its moment to its result."""
        self.num_frames += 1
        self.num_dropped_reads += found.num_dropped
        self.num_unused_reads += found.num_unused
        self.preparing.add(prepared_s)
        self.computing.add(prepared_s + followed_s)
        self.latency.add(latency_s)
        for tag in tags.values():
            self.statuses[tag.status] = self.statuses.get(tag.status, 0) + 1

    def summary(self) -> dict[str, Any]:
        """Counts, and durations in ms."""
        return {
            "frames": self.num_frames,
            "dropped_reads": self.num_dropped_reads,
            "unused_reads": self.num_unused_reads,
            "status": self.statuses,  # frames of all tags, by status
            "process_ms": self.computing.summary(),  # flow, and then the tracer's step; two frames are worked on at once
            "flow_ms": self.preparing.summary(),
            "latency_ms": self.latency.summary(),
        }
