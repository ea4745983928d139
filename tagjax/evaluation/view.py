"""A recording traced and shown in the Rerun viewer, or written to a file that it opens."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from ..core.progress import OnProgress, unobserved
from ..core.settings import changed
from ..recording.loading import VirtualTagSettings, open_recordings
from ..report.viewer import log_recording, rerun
from ..tagattention.tracer_settings import learned_tracer, make_tracer, tracer_clips
from ..tracing.clips import ClipSettings, choose_antennas, clip_loader, selected_tags
from ..tracing.recordings import TraceSettings, trace_recording
from ..tracing.tracer import Trace


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewConfig:
    """The recording, the tracer (settings as under conf/tracer, or learned weights), and what is shown."""

    recording: str
    tracer: Mapping[str, Any]
    weights: str | None = None
    epcs: tuple[str, ...] | None = None
    frames: tuple[int, int] | None = None
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    virtual_tag: VirtualTagSettings = dataclasses.field(default_factory=VirtualTagSettings)
    smooth: bool = False  # offline smoothing
    live: bool = False  # open the viewer and show frames as they are traced, in place of a file
    depth: bool = False  # points in space; a file is then some ten times as large

    def __post_init__(self) -> None:
        changed(ClipSettings(), self.clips, where="clips")


def view_recording(config: ViewConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> Path | None:
    """Trace the recording and log every frame; the path of the file `folder`/<recording>.rrd, or None if it is shown live.

    `on_progress` counts the frames.
    """
    rerun()  # before any work
    if config.weights is not None:
        tracer, clips = learned_tracer(config.weights, config.tracer)
    else:
        tracer, clips = make_tracer(config.tracer), tracer_clips(config.tracer)
    clips = changed(clips, config.clips, where="clips")
    (recording,) = open_recordings((config.recording,), config.virtual_tag)
    epcs = selected_tags(recording, config.epcs)
    antennas = choose_antennas(recording, epcs, clips.antennas)
    first, last = config.frames or (0, recording.num_frames)

    def traced() -> Iterator[tuple[int, Trace]]:
        settings = TraceSettings(smooth=config.smooth)
        load = clip_loader(clips)
        on_progress("trace", 0, last - first, "compiling")
        for number, trace in trace_recording(
            tracer, recording, load, epcs=epcs, settings=settings, frames=(first, last)
        ):
            yield number, trace
            on_progress("trace", number + 1 - first, last - first)

    out = None if config.live else folder / f"{recording.name}.rrd"
    log_recording(recording, traced(), epcs, antennas, stride=clips.stride, depth=config.depth or config.live, out=out)
    return out
