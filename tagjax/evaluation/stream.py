"""A recording traced as if its sensors were running: latency, dropped frames, and every frame's result as a line of JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ..core.camera import working_stride
from ..core.machine import peak_memory_mib
from ..core.progress import OnProgress, unobserved
from ..core.results import to_json_values, write_json
from ..core.settings import ConfigError
from ..flow.registry import make_flow
from ..metrics.recordings import box_to_picture
from ..recording.store import open_recording
from ..tagattention.tracer_settings import make_tracer, tracer_clips
from ..tracing.clips import choose_antennas, selected_tags
from ..tracing.live import LiveFrame, LiveMethod, LiveTracer
from ..tracing.replay import Replay, ReplaySettings
from ..tracing.status import Status

_BINS_MS = np.geomspace(0.01, 1e5, 1401)  # 1.2 % wide: percentiles in memory that does not grow


@dataclasses.dataclass(frozen=True, kw_only=True)
class StreamConfig:
    """The recording and how it is played, and the tracer (settings as under conf/tracer, or learned weights)."""

    recording: str
    tracer: Mapping[str, Any]
    weights: str | None = None
    flow: str = "dis_live"
    stride: int | None = None  # None: that of the tracer's settings, or else of the picture's width
    num_places: int = 4  # for tags, before more are made
    replay: ReplaySettings = dataclasses.field(default_factory=ReplaySettings)


class Milliseconds:
    """Percentiles of any number of durations in a histogram of fixed size."""

    def __init__(self) -> None:
        self._counts, self.highest = np.zeros(len(_BINS_MS) + 1, np.int64), 0.0

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self._counts[np.searchsorted(_BINS_MS, 1e3 * seconds)] += 1
        self.highest = max(self.highest, 1e3 * seconds)

    def percentile(self, percent: int) -> float:
        """The upper edge of the bin that this percentile lies in, ms; NaN before any duration."""
        total = int(self._counts.sum())
        if total == 0:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self._counts), percent / 100 * total))
        return float(min(_BINS_MS[min(index, len(_BINS_MS) - 1)], self.highest))

    def summary(self) -> dict[str, float]:
        """Median, 90th, 99th percentile and maximum, ms."""
        named = {f"p{percent}": self.percentile(percent) for percent in (50, 90, 99)}
        return {name: round(value, 2) for name, value in {**named, "max": self.highest}.items()}


def run_stream(config: StreamConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> dict[str, Any]:
    """Trace the recording live; the summary, which is also written to stream.json.

    Writes a line a frame to frames.jsonl as it goes. Ctrl-C ends the stream, and the summary covers what was traced. Raises
    `ConfigError` for a tracer that does not run live.
    """
    tracer = make_tracer(config.tracer, config.weights)
    if not isinstance(tracer, LiveMethod):
        raise ConfigError(
            f"tracer: found {config.tracer.get('_target_')}; expected one that runs live, as TagAttention does."
        )
    recording = open_recording(config.recording)
    own = tracer_clips(config.tracer).stride if config.stride is None else config.stride
    stride = working_stride(recording.intrinsics.width, own)
    live = LiveTracer(
        tracer,
        recording.intrinsics,
        recording.antennas_m,
        flow=make_flow(config.flow),
        stride=stride,
        antennas=choose_antennas(recording, selected_tags(recording, None)),
        depth_kind=recording.depth_kind,
        num_places=config.num_places,
    )
    total = recording.num_frames * config.replay.loops
    on_progress("stream", 0, total, "compiling")
    start_s = live.warm_up()
    computing, latency, num_frames, num_dropped_reads, num_unused_reads = Milliseconds(), Milliseconds(), 0, 0, 0
    statuses = {one.word: 0 for one in Status if one is not Status.UNKNOWN}
    begun, interrupted = time.monotonic(), False
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "frames.jsonl").open("w") as lines, contextlib.closing(Replay(recording, config.replay)) as replay:
        try:
            for frame in replay:
                taken = time.monotonic()
                found = live.process(frame.colour, frame.depth_m, frame.time_ns, frame.reads)
                jax.block_until_ready(found.trace)
                done = time.monotonic()
                computing.add(done - taken)
                latency.add(done - frame.due_s)
                num_frames += 1
                num_dropped_reads += found.num_dropped
                num_unused_reads += found.num_unused
                line = _line(found, stride, recording.image_shape)
                lines.write(json.dumps(line) + "\n")
                for tag in line["tags"].values():
                    statuses[tag["status"]] += 1
                tags = ", ".join(f"{epc} {tag['status']}" for epc, tag in line["tags"].items()) or "no tag"
                on_progress(
                    "stream", num_frames + replay.num_dropped, total, f"{computing.percentile(50):.0f} ms; {tags}"
                )
        except KeyboardInterrupt:
            interrupted = True
        summary = {
            "frames": num_frames,
            "dropped_frames": replay.num_dropped,
            "dropped_reads": num_dropped_reads,
            "unused_reads": num_unused_reads,
            "status": statuses,  # frames of all tags, by status
            "camera_moved": live.camera_moved,
            "frames_per_s": round(num_frames / max(time.monotonic() - begun, 1e-9), 2),
            "start_s": round(start_s, 2),
            "process_ms": computing.summary(),
            "latency_ms": latency.summary(),
            "memory_mib": round(peak_memory_mib()),
            "interrupted": interrupted,
        }
    write_json(folder / "stream.json", to_json_values(summary))
    return summary


def _line(found: LiveFrame, stride: int, shape: tuple[int, int]) -> dict[str, Any]:
    """What a frame says of every tag: boxes in pixels of the whole picture, places in the camera frame."""
    trace = found.trace
    boxes = box_to_picture(np.asarray(trace.box_px), stride, *shape)
    confidence, detected, status, centre_m = (
        np.asarray(x) for x in (trace.tags.confidence, trace.tags.detected, trace.tags.status, trace.tags.centre_m)
    )
    tags = {
        epc: {
            "detected": bool(detected[place]),
            "status": Status(int(status[place])).word,
            "confidence": round(float(confidence[place]), 3),
            "box_px": [round(float(value), 1) for value in boxes[place]] if detected[place] else None,
            "centre_m": [round(float(value), 3) for value in centre_m[place]] if detected[place] else None,
        }
        for epc, place in found.places.items()
    }
    return {"time_ns": found.time_ns, "tags": tags}
