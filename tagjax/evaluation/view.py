"""A recording traced and shown in the Rerun viewer, or written to a file that it opens."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..core.progress import OnProgress, unobserved
from ..report.viewer import log_recording, rerun
from .traced import Traced, TracedConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewConfig(TracedConfig):
    """What is traced, and what is shown of it."""

    live: bool = False  # open the viewer and show frames as they are traced, in place of a file
    depth: bool = False  # points in space; a file is then several times as large


def view_recording(config: ViewConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> Path | None:
    """Trace the recording and log every frame; the path of the file `folder`/<recording>.rrd, or None if it is shown live.

    `on_progress` counts the frames.
    """
    rerun()  # before any work
    traced = Traced.open(config)
    out = None if config.live else folder / f"{traced.recording.name}.rrd"
    log_recording(
        traced.recording,
        traced.traces(on_progress),
        traced.epcs,
        traced.antennas,
        stride=traced.clips.stride,
        depth=config.depth or config.live,
        out=out,
    )
    return out
