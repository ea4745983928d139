"""A recording traced as if its sensors were running, or running sensors: latency, dropped frames, events, and every frame's result as a line of JSON."""

from __future__ import annotations

import contextlib
import dataclasses
import io
import json
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax

from ..core.camera import working_stride
from ..core.machine import peak_memory_mib
from ..core.progress import OnProgress, unobserved
from ..core.results import to_json_values, write_json
from ..core.settings import ConfigError
from ..flow.registry import make_flow
from ..tagattention.tracer_settings import make_tracer, tracer_clips
from ..tracing.live import LiveTracer
from ..tracing.live_step import LiveMethod
from ..tracing.replay import Replay
from .ahead import FramesAhead, PreparedFrame
from .config import Source, StreamConfig, open_source
from .event_log import EventLog
from .feed import Feed
from .page import LivePage
from .results import Totals, sightings
from .sensors import SensorStream

_STAGE = "stream"


def run_stream(
    config: StreamConfig,
    folder: Path,
    *,
    on_progress: OnProgress = unobserved,
    on_page: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Trace a recording or running sensors; the summary, which is also written to stream.json.

    Writes a line a frame to frames.jsonl and a line an event to events.jsonl as it goes. Ctrl-C ends the stream, and the
    summary covers what was traced. `on_page` is called with the address of the web page once it is served. Raises
    `ConfigError` for a tracer that does not run live, and the errors of `open_source` and of running sensors.
    """
    tracer = make_tracer(config.tracer, config.weights)
    if not isinstance(tracer, LiveMethod):
        raise ConfigError(
            f"tracer: found {config.tracer.get('_target_')}; expected one that runs live, as TagAttention does."
        )
    folder.mkdir(parents=True, exist_ok=True)
    totals = Totals()
    with contextlib.ExitStack() as stack:
        source = open_source(config, stack)
        own = tracer_clips(config.tracer).stride if config.stride is None else config.stride
        stride = working_stride(source.intrinsics.width, own)
        live = _live_tracer(config, tracer, source, stride)
        page = _page(config, stack, source.name, on_page)
        on_progress(_STAGE, 0, source.num_frames, "compiling")
        start_s = live.warm_up()
        lines = stack.enter_context((folder / "frames.jsonl").open("w"))
        events = EventLog(config.events, stack.enter_context((folder / "events.jsonl").open("w")))
        stack.callback(events.close)
        frames, begun, used_s = source.start(), time.monotonic(), time.process_time()
        feed = None if page is None else _feed(config, page, live, stride, frames, events)
        shape = source.intrinsics.height, source.intrinsics.width
        following = _Following(live, stride, shape, totals, lines, events, feed)
        ahead = stack.enter_context(contextlib.closing(FramesAhead(frames, live)))

        def traced(text: str) -> None:
            on_progress(_STAGE, totals.num_frames + frames.num_dropped, source.num_frames, text)

        interrupted = _followed(following, ahead, traced)
        lasted_s, used_s = time.monotonic() - begun, time.process_time() - used_s
    summary = {
        **totals.summary(),
        "dropped_frames": frames.num_dropped,
        "camera_moved": live.camera_moved,
        "frames_per_s": round(totals.num_frames / max(lasted_s, 1e-9), 2),
        "cpu_ms": round(1e3 * used_s / max(totals.num_frames, 1), 2),  # of all threads of the process, a frame
        "start_s": round(start_s, 2),
        "events": events.summary(),
        **({} if isinstance(frames, Replay) else {"sensors": frames.summary()}),
        "memory_mib": round(peak_memory_mib()),
        "interrupted": interrupted,
    }
    write_json(folder / "stream.json", to_json_values(summary))
    return summary


def _live_tracer(config: StreamConfig, tracer: LiveMethod, source: Source, stride: int) -> LiveTracer:
    return LiveTracer(
        tracer,
        source.intrinsics,
        source.antennas_m,
        flow=make_flow(config.flow),
        stride=stride,
        antennas=source.antennas,
        depth_kind=source.depth_kind,
        num_places=config.num_places,
    )


def _page(
    config: StreamConfig, stack: contextlib.ExitStack, name: str, on_page: Callable[[str], None] | None
) -> LivePage | None:
    """The web page, served until the stack unwinds; None without one."""
    if config.page.port is None:
        return None
    page = stack.enter_context(contextlib.closing(LivePage(config.page, f"tagjax: {name}")))
    if on_page is not None:
        on_page(page.address)
    return page


def _feed(
    config: StreamConfig,
    page: LivePage,
    live: LiveTracer,
    stride: int,
    frames: Replay | SensorStream,
    events: EventLog,
) -> Feed:
    """What the page gets of each frame."""

    def notes() -> list[str]:
        moved = ["the camera has moved, which misleads the tracer"] if live.camera_moved else []
        return [*moved, *([] if isinstance(frames, Replay) else frames.notes()), *events.problems()]

    return Feed(page, stride, config.page.width, num_dropped=lambda: frames.num_dropped, notes=notes)


@dataclasses.dataclass(frozen=True)
class _Following:
    """What happens with each frame."""

    live: LiveTracer
    stride: int
    shape: tuple[int, int]
    totals: Totals
    lines: io.TextIOBase
    events: EventLog
    feed: Feed | None

    def __call__(self, prepared: PreparedFrame) -> str:
        """Trace a frame and hand its result on; a line for people."""
        frame, taken = prepared.frame, time.monotonic()
        found = self.live.follow(prepared.pictures, frame.time_ns, frame.reads)
        jax.block_until_ready(found.trace)
        done = time.monotonic()
        tags = sightings(found, self.stride, self.shape)
        self.totals.add(
            found, tags, prepared_s=prepared.prepared_s, followed_s=done - taken, latency_s=done - frame.due_s
        )
        line = {"time_ns": found.time_ns, "tags": {epc: dataclasses.asdict(tag) for epc, tag in tags.items()}}
        self.lines.write(json.dumps(line) + "\n")
        events = self.events.add(found.time_ns, tags)
        if self.feed is not None:
            self.feed.add(frame, found, tags, events, self.totals)
        states = ", ".join(f"{epc} {tag.status}" for epc, tag in tags.items()) or "no tag"
        return f"{self.totals.computing.percentile(50):.0f} ms; {states}"


def _followed(following: _Following, frames: FramesAhead, on_frame: Callable[[str], None]) -> bool:
    """Follow all frames; whether Ctrl-C ended it."""
    try:
        for frame in frames:
            on_frame(following(frame))
    except KeyboardInterrupt:
        return True
    return False
