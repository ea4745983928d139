"""A recording that is traced frame by frame, to be shown: what a viewer and an animation have in common."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

from ..core.progress import OnProgress, unobserved
from ..core.settings import changed
from ..recording import Recording
from ..recording.loading import VirtualTagSettings, open_recordings
from ..tagattention.tracer_settings import learned_tracer, make_tracer, tracer_clips
from ..tracing.clips import ClipSettings, choose_antennas, clip_loader, selected_tags
from ..tracing.recordings import TraceSettings, trace_recording
from ..tracing.tracer import AbstractTracer, Trace


@dataclasses.dataclass(frozen=True, kw_only=True)
class TracedConfig:
    """The recording, the tracer (settings as under conf/tracer, or learned weights), and which frames and tags are traced."""

    recording: str
    tracer: Mapping[str, Any]
    weights: str | None = None
    epcs: tuple[str, ...] | None = None
    frames: tuple[int, int] | None = None
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
    smooth: bool = False  # offline smoothing

    def __post_init__(self) -> None:
        changed(ClipSettings(), self.clips, where="clips")


@dataclasses.dataclass(frozen=True)
class Traced:
    """An opened recording with all that its tracing depends on. `antennas` are counted from 1."""

    recording: Recording
    tracer: AbstractTracer
    clips: ClipSettings
    epcs: tuple[str, ...]
    antennas: tuple[int, ...]
    frames: tuple[int, int]  # first, last + 1
    smooth: bool

    @classmethod
    def open(cls, config: TracedConfig) -> Traced:
        """Open the recording and make the tracer. Raises the errors of both."""
        if config.weights is not None:
            tracer, clips = learned_tracer(config.weights, config.tracer)
        else:
            tracer, clips = make_tracer(config.tracer), tracer_clips(config.tracer)
        clips = changed(clips, config.clips, where="clips")
        (recording,) = open_recordings((config.recording,), config.virtual_tag)
        epcs = tuple(selected_tags(recording, config.epcs))
        antennas = tuple(choose_antennas(recording, epcs, clips.antennas))
        frames = config.frames or (0, recording.num_frames)
        return cls(recording, tracer, clips, epcs, antennas, frames, config.smooth)

    def traces(self, on_progress: OnProgress = unobserved) -> Iterator[tuple[int, Trace]]:
        """Every frame's number and `Trace`. `on_progress` counts the frames whose trace has been used."""
        first, last = self.frames
        settings = TraceSettings(smooth=self.smooth)
        on_progress("trace", 0, last - first, "compiling")
        for number, trace in trace_recording(
            self.tracer, self.recording, clip_loader(self.clips), epcs=self.epcs, settings=settings, frames=self.frames
        ):
            yield number, trace
            on_progress("trace", number + 1 - first, last - first)
