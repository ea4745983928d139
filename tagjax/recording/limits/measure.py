"""The check of a recording: every line with its verdict."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from ..recording import Recording
from .camera import CameraLimits, measure_camera
from .clock import Lag, find_lag
from .line import Line, Verdict
from .lines_camera import camera_lines, clock_line
from .lines_radio import radio_lines
from .tags import TagLimits, measure_tag
from .thresholds import Thresholds


@dataclasses.dataclass(frozen=True)
class Limits:
    """What limits a recording: the lines, and what they were made from."""

    name: str
    duration_s: float
    num_frames: int
    num_reads: int
    lines: tuple[Line, ...]
    tags: tuple[TagLimits, ...]
    camera: CameraLimits
    lag: Lag | None
    frame_s: np.ndarray  # (frames,)

    def line(self, name: str) -> Line:
        """The line of a name. Raises `KeyError` where there is none."""
        return {line.name: line for line in self.lines}[name]

    def verdicts(self) -> dict[str, Verdict]:
        """The verdict of every line, by its name."""
        return {line.name: line.verdict for line in self.lines}

    @property
    def limiting(self) -> tuple[Line, ...]:
        """The lines whose verdict is bad, then those that limit."""
        return tuple(line for verdict in ("bad", "limits") for line in self.lines if line.verdict == verdict)


def find_limits(
    recording: Recording,
    thresholds: Thresholds | None = None,
    *,
    epcs: Sequence[str] | None = None,
    on_frame: Callable[[int, int], None] = lambda done, total: None,
) -> Limits:
    """Measure reads, clock and camera of a recording and judge each value.

    `epcs` are the tags that count; None: all that were read, also stray ones. Values of tags are those of the antenna that
    read each most, and the worst tag's verdict is the line's. Raises `RecordingError` for an EPC that was never read.
    """
    thresholds = thresholds or Thresholds()
    flip_limit = thresholds.flip_probability[0]
    tags = [
        measure_tag(recording, epc, gap_s=thresholds.gap_s, flip_limit=flip_limit)
        for epc in recording.resolve_epcs(epcs)
    ]
    camera = measure_camera(recording, on_frame)
    frame_s = recording.frame_time_s()
    lag = find_lag(tags, frame_s, camera.motion)
    lines = (
        *radio_lines(recording, tags, thresholds),
        clock_line(recording, lag, thresholds),
        *camera_lines(camera, thresholds),
    )
    return Limits(
        name=recording.name,
        duration_s=float(frame_s[-1]),
        num_frames=recording.num_frames,
        num_reads=recording.reads.num_reads,
        lines=lines,
        tags=tuple(tags),
        camera=camera,
        lag=lag,
        frame_s=frame_s,
    )
