"""What the web page gets of a running stream, frame by frame."""

from __future__ import annotations

import collections
import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from ..tracing.live import LiveFrame
from ..tracing.replay import SensorFrame
from .durations import ReadRates
from .events import Event, Sighting
from .page import LivePage
from .results import Totals
from .view import Overlay, View, event_rows, tag_rows

_NUM_EVENTS = 30


class Feed:
    """Hands a page the frames that a browser waits for. Without a browser it counts reads and keeps events, nothing else.

    `num_dropped` counts frames that were not traced; `notes` gives what is wrong, a line each.
    """

    def __init__(
        self,
        page: LivePage,
        stride: int,
        width: int,
        *,
        num_dropped: Callable[[], int],
        notes: Callable[[], Sequence[str]],
    ):
        self._page, self._stride, self._width = page, stride, width
        self._num_dropped, self._notes = num_dropped, notes
        self._rates, self._events = ReadRates(), collections.deque[Event](maxlen=_NUM_EVENTS)
        self._first_ns: int | None = None
        self._taken_s: collections.deque[float] = collections.deque(maxlen=61)

    def add(
        self,
        frame: SensorFrame,
        found: LiveFrame,
        tags: Mapping[str, Sighting],
        events: Sequence[Event],
        totals: Totals,
    ) -> None:
        """Take a frame and its result."""
        self._first_ns = found.time_ns if self._first_ns is None else self._first_ns
        self._rates.add(found.time_ns, frame.reads.epc)
        self._events.extendleft(events)
        self._taken_s.append(time.monotonic())
        if not self._page.due():
            return
        rates_hz = self._rates.rates_hz()
        state = {
            "number": totals.num_frames,
            "time_s": 1e-9 * (found.time_ns - self._first_ns),
            "frames_per_s": self._frame_rate_hz(),
            "latency_ms": totals.latency.percentile(50),
            "dropped_frames": self._num_dropped(),
            "reads_hz": sum(rates_hz.values()),
            "tags": tag_rows(tags, rates_hz),
            "events": event_rows(self._events, self._first_ns),
            "notes": list(self._notes()),
        }
        # Copies: the tracer may reuse its buffers for the next frame.
        membership = np.array(found.trace.tags.membership)[[found.places[epc] for epc in tags]]
        overlay = Overlay(frame.colour, np.array(found.trace.labels), self._stride, membership, dict(tags))
        self._page.show(View(state, overlay, self._width))

    def _frame_rate_hz(self) -> float:
        """Of the last frames."""
        passed_s = self._taken_s[-1] - self._taken_s[0]
        return (len(self._taken_s) - 1) / passed_s if passed_s > 0 else 0.0
