"""Memory of a process that traces for a long time: a short recording forth and back, its times going on."""

from __future__ import annotations

import dataclasses
import json
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

from ...core.machine import resident_memory_mib
from ...recording.store import open_recording
from ...tagattention.segments import TagAttention
from ...tagattention.segments.labels import Segmenter
from ...tagattention.segments.step import SegmentTracker
from ..timing import Figure, in_separate_process
from .live import live_tracer, masks
from .swing import Swing, stored_scene


@dataclasses.dataclass(frozen=True)
class MemorySettings:
    """What is traced. None: the scene of the other figures is simulated for a second, at this width in pixels."""

    recording: str | None = None  # a stored recording (.zarr) of at least one tag
    width: int = 128
    stride: int = 2  # every n-th pixel
    flow: str = "dis_live"
    num_tags: int = 4
    num_segments: int = 256  # fewer than the default: their number sets the time of a frame, not what is left of it
    frames: int = 20_000
    every: int = 1_000  # frames between two measurements

    def __post_init__(self) -> None:
        least = {"width": 64, "stride": 1, "num_tags": 1, "num_segments": 64, "every": 1, "frames": 4 * self.every}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {value}.")


def memory_figures(settings: MemorySettings, seed: int) -> Iterator[Figure]:
    """Resident memory after every so many frames, and how much it grows from the first quarter to the last."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "benchmark.zarr" if settings.recording is None else Path(settings.recording)
        if settings.recording is None:
            stored_scene(path, width=settings.width, num_frames=30, seed=seed)
        code = f"from {__name__} import _traced; _traced({str(path)!r}, {dataclasses.asdict(settings)!r})"
        resident_mib = in_separate_process(code, "The process whose memory is measured")["resident_mib"]
    yield from growth_figures(np.asarray(resident_mib), settings.every)


def growth_figures(resident_mib: np.ndarray, every: int) -> Iterator[Figure]:
    """Figures of the resident memory, (measurement,) MiB, measured every so many frames.

    Growth is the difference of the medians of the last and the first quarter, a thousand frames: single measurements swing
    by what the allocator has just returned.
    """
    for number, value in enumerate(resident_mib, start=1):
        yield Figure(f"resident memory after {number * every} frames", float(value), "MiB")
    quarter = max(1, len(resident_mib) // 4)
    grown_mib = float(np.median(resident_mib[-quarter:]) - np.median(resident_mib[:quarter]))
    frames_between = (len(resident_mib) - quarter) * every
    yield Figure("growth in 1000 frames", 1000 * grown_mib / frames_between, "MiB", 0.1)


def _traced(path: str, settings: dict[str, str | int]) -> None:
    of = MemorySettings(**settings)  # pyright: ignore[reportArgumentType]
    swing = Swing.of(open_recording(path), num_tags=of.num_tags)
    segments = SegmentTracker(segmenter=Segmenter(num_segments=of.num_segments))
    tracer = live_tracer(swing, stride=of.stride, flow=of.flow, tracer=TagAttention(segments=segments))
    resident_mib = []
    for number, shot in enumerate(swing.shots(of.frames), start=1):
        trace = tracer.process(shot.colour, shot.depth_m, shot.time_ns, shot.reads).trace
        jax.block_until_ready(masks(trace.labels, trace.tags.membership))
        if number % of.every == 0:
            resident_mib.append(resident_memory_mib())
            print(f"{number} frames: {resident_mib[-1]:.1f} MiB", file=sys.stderr, flush=True)
    print(json.dumps({"resident_mib": resident_mib}))
