"""Frames whose flow is computed in a thread of its own, while the tracer follows the frame before them.

Flow takes about as long as the tracer's step, and needs no reads: it also fills the time in which the reads of a frame are
still under way. One prepared frame waits at most, and the next one is taken only after that: so the newest is prepared.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterator
from typing import Protocol, runtime_checkable

from ..tracing.live import LiveTracer, Pictures
from ..tracing.replay import SensorFrame


@runtime_checkable
class Frames(Protocol):
    """What gives frames: `Replay` and `SensorStream`."""

    num_dropped: int

    def next_pictures(self) -> SensorFrame | None: ...

    def with_reads(self, frame: SensorFrame) -> SensorFrame: ...

    def close(self) -> None: ...


@dataclasses.dataclass(frozen=True)
class PreparedFrame:
    """A frame, what its pictures bring, and the seconds that this took."""

    frame: SensorFrame
    pictures: Pictures
    prepared_s: float


class FramesAhead:
    """An iterator over `PreparedFrame`, with reads. It ends where the frames end, and raises what they raise.

    `close` closes the frames, too.
    """

    def __init__(self, frames: Frames, live: LiveTracer):
        self._frames, self._live = frames, live
        self._changed, self._ended = threading.Condition(), False
        self._waiting: PreparedFrame | None = None
        self._error: Exception | None = None
        self._thread = threading.Thread(target=self._run, name="flow", daemon=True)
        self._thread.start()

    def __iter__(self) -> Iterator[PreparedFrame]:
        return self

    def __next__(self) -> PreparedFrame:
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._ended)
            one, self._waiting = self._waiting, None
            self._changed.notify_all()
        if one is not None:
            return dataclasses.replace(one, frame=self._frames.with_reads(one.frame))
        if self._error is not None:
            raise self._error
        raise StopIteration

    def close(self) -> None:
        """Take no more frames."""
        with self._changed:
            self._ended = True
            self._changed.notify_all()
        self._frames.close()
        self._thread.join()

    def _run(self) -> None:
        try:
            while self._free() and (frame := self._frames.next_pictures()) is not None:
                begun = time.monotonic()
                pictures = self._live.prepare(frame.colour, frame.depth_m)
                one = PreparedFrame(frame, pictures, time.monotonic() - begun)
                with self._changed:
                    self._waiting = one
                    self._changed.notify_all()
        except Exception as error:
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _free(self) -> bool:
        """Wait until no prepared frame waits; false where there is nothing more to do."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is None or self._ended)
            return not self._ended
