"""One small interface for RGB-D cameras, and the camera that plays a recording."""

from __future__ import annotations

import abc
import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from ..recording import Recording
from .emulation import PlaybackStart
from .reads import HOST_CLOCK
from .writer import VideoFormat


@dataclasses.dataclass(frozen=True, kw_only=True)
class CameraSettings:
    """What a camera is asked for. Raises `ValueError` for sizes and rates that are not positive."""

    width: int = 640  # of colour, pixels; depth is registered to it
    height: int = 480
    frame_rate_hz: int = 30
    serial: str | None = None  # of one camera among several; None: the first

    def __post_init__(self) -> None:
        for name in ("width", "height", "frame_rate_hz"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number.")


@dataclasses.dataclass(frozen=True)
class CameraFrame:
    """One frame as it arrived."""

    colour: np.ndarray  # (height, width, 3) uint8 RGB
    depth: np.ndarray  # (height, width), as `VideoFormat` says, in the view of the colour camera; 0 = missing
    arrival_time_ns: int  # the host's clock
    device_time_ns: int | None = None  # the camera's clock, of the middle of the exposure where it says so


class CameraError(ValueError):
    """A camera that cannot be used: what was found, what was expected, what to do."""


class AbstractCamera(abc.ABC):
    """An RGB-D camera.

    `open` starts it and says what its frames are. `frames` waits for each frame and ends where `stopped` returns true or the
    camera has no more. `close` may be called at any time. All three are called by one thread. Raises `CameraError`.
    """

    name: str

    @abc.abstractmethod
    def open(self) -> VideoFormat:
        """Start the camera; size, intrinsics and depth of its frames."""

    @abc.abstractmethod
    def frames(self, stopped: Callable[[], bool]) -> Iterator[CameraFrame]:
        """The frames as they come."""

    @abc.abstractmethod
    def close(self) -> None:
        """Stop the camera."""

    def describe(self) -> dict[str, Any]:
        """What is kept of the camera in the recording, in JSON types."""
        return {"name": self.name}


class PlaybackCamera(AbstractCamera):
    """Plays the frames of a recording at their times, from the moment at which `start` begins; its clock is the recording's."""

    def __init__(self, recording: Recording, start: PlaybackStart):
        self.recording, self.start = recording, start
        self.name = f"playback of {recording.name}"

    def open(self) -> VideoFormat:
        """Size, intrinsics and depth of the recording."""
        recording = self.recording
        kind = np.dtype(recording.depth.dtype)
        return VideoFormat(recording.intrinsics, "uint16" if kind == np.uint16 else "float32", recording.depth_kind)

    def frames(self, stopped: Callable[[], bool]) -> Iterator[CameraFrame]:
        """The frames of the recording, each when it is due; one that is late comes at once."""
        recording, begin_ns = self.recording, None
        while begin_ns is None and not stopped():
            begin_ns = self.start.wait(0.05)
        for number in range(recording.num_frames):
            # Read before it is due: only the wait for its time is exact.
            colour, depth = np.asarray(recording.colour[number]), np.asarray(recording.depth[number])
            device_ns = int(recording.time_ns[number])
            due_ns = (begin_ns or 0) + device_ns - int(recording.time_ns[0])
            while (left_ns := due_ns - HOST_CLOCK.now_ns()) > 0 and not stopped():
                time.sleep(min(1e-9 * left_ns, 0.1))
            if stopped():
                return
            yield CameraFrame(colour, depth, HOST_CLOCK.now_ns(), device_ns)

    def close(self) -> None:
        """Nothing to stop."""
