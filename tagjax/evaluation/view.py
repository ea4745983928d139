"""A recording traced and shown in the Rerun viewer, or written to a file that it opens."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from ..core.progress import OnProgress, unobserved
from ..core.settings import ConfigError
from ..report.motion_error import MotionError
from ..report.viewer import log_recording, rerun
from ..tagattention import TagAttention
from .traced import Traced, TracedConfig


@dataclasses.dataclass(frozen=True, kw_only=True)
class ViewConfig(TracedConfig):
    """What is traced, and what is shown of it."""

    live: bool = False  # open the viewer and show frames as they are traced, in place of a file
    depth: bool = False  # points in space; a file is then several times as large
    full_size: bool = False  # pictures as large as the recording's, log odds at every pixel of the tracer's
    quality: int = 70  # of JPEG pictures, 1 to 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.quality <= 100:
            raise ConfigError(f"quality is {self.quality}; expected a value from 1 to 100.")


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
        full_size=config.full_size,
        quality=config.quality,
        band=motion_error(traced),
    )
    return out


def motion_error(traced: Traced) -> MotionError | None:
    """The error of motions as the tracer assumes it; None for a tracer without that model of reads and depth."""
    tracer = traced.tracer
    if not isinstance(tracer, TagAttention) or tracer.dwell is None or tracer.unknown_depth is not None:
        return None
    return MotionError(float(tracer.reader.drift_m.value), float(tracer.dwell.memory_s.value))
