"""A live tracer on a swinging recording: times of whole frames, and what a fresh process needs until its first mask."""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from ...core.machine import peak_memory_mib
from ...flow.registry import make_flow
from ...recording.store import open_recording
from ...tagattention.segments import TagAttention
from ...tagattention.segments.outline import dense_masks
from ...tracing.clips import choose_antennas
from ...tracing.live import LiveTracer
from ..timing import in_separate_process
from .swing import Swing

_WARM_UP = 5

masks = jax.jit(dense_masks)


def live_tracer(swing: Swing, *, stride: int, flow: str, tracer: TagAttention | None = None) -> LiveTracer:
    """A live tracer, the default one if None, with a place for each tag."""
    recording = swing.recording
    return LiveTracer(
        TagAttention() if tracer is None else tracer,
        swing.intrinsics,
        recording.antennas_m,
        flow=make_flow(flow),
        stride=stride,
        antennas=choose_antennas(recording, recording.reads.epcs),
        depth_kind=recording.depth_kind,
        num_places=len(swing.epcs),
    )


def frame_times_ms(
    swings: Sequence[Swing], num_frames: int, *, stride: int, flow: str, with_masks: bool, ahead: bool = False
) -> list[np.ndarray]:
    """Times of `process` for each of some recordings, (frame,) ms; their frames alternate, so that other load hits all alike.

    They include the wait for the result; with `ahead` that for the result of the frame before, so that a flow is computed
    while the device is busy with the last frame: the time between frames at full speed.
    """
    tracers = [live_tracer(swing, stride=stride, flow=flow) for swing in swings]
    times: list[list[float]] = [[] for _ in swings]
    waiting: list[Any] = [()] * len(swings)
    for number, shots in enumerate(zip(*(swing.shots(num_frames + _WARM_UP) for swing in swings), strict=True)):
        for place, (tracer, shot) in enumerate(zip(tracers, shots, strict=True)):
            begun = time.perf_counter()
            trace = tracer.process(shot.colour, shot.depth_m, shot.time_ns, shot.reads).trace
            found = trace, masks(trace.labels, trace.tags.membership) if with_masks else ()
            jax.block_until_ready(waiting[place] if ahead else found)
            waiting[place] = found
            if number >= _WARM_UP:
                times[place].append(1e3 * (time.perf_counter() - begun))
    return [np.array(own) for own in times]


def start_times_s(path: Path, *, num_tags: int, stride: int, flow: str) -> tuple[float, float]:
    """Seconds from the start of a process to its first mask, compiling everything, and with JAX's compilation cache filled.

    The first process fills the cache, which takes it some hundredths of a second.
    """
    code = f"from {__name__} import _first_mask; _first_mask({str(path)!r}, {num_tags}, {stride}, {flow!r})"
    found = []
    with tempfile.TemporaryDirectory() as cache:
        environment = {
            "JAX_COMPILATION_CACHE_DIR": cache,
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
            "JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES": "-1",
        }
        for _ in range(2):
            begun = time.time()
            masked = in_separate_process(
                code, "The process that makes a first mask", environment={**os.environ, **environment}
            )
            found.append(masked["at_s"] - begun)
    return found[0], found[1]


def stream_memory_mib(path: Path, num_frames: int, *, num_tags: int, stride: int, flow: str) -> float:
    """The largest resident memory of a process that traces so many frames, with Python and compilation, MiB."""
    code = f"from {__name__} import _stream; _stream({str(path)!r}, {num_frames}, {num_tags}, {stride}, {flow!r})"
    return in_separate_process(code, "The process whose memory is measured")["peak_mib"]


def _first_mask(path: str, num_tags: int, stride: int, flow: str) -> None:
    swing = Swing.of(open_recording(path), num_tags=num_tags)
    tracer = live_tracer(swing, stride=stride, flow=flow)
    for shot in swing.shots(2):  # the second has flow
        trace = tracer.process(shot.colour, shot.depth_m, shot.time_ns, shot.reads).trace
        jax.block_until_ready(masks(trace.labels, trace.tags.membership))
    print(json.dumps({"at_s": time.time()}))
    sys.stdout.flush()


def _stream(path: str, num_frames: int, num_tags: int, stride: int, flow: str) -> None:
    swing = Swing.of(open_recording(path), num_tags=num_tags)
    frame_times_ms([swing], num_frames, stride=stride, flow=flow, with_masks=True)
    print(json.dumps({"peak_mib": peak_memory_mib()}))
