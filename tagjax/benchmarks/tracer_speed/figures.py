"""The figures of the tracer, each beside its aim."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ...recording import Recording
from ...recording.store import open_recording
from ..timing import Figure, Timing
from .live import frame_times_ms, start_times_s, stream_memory_mib
from .stages import (
    flow_times_ms,
    machine_limits,
    part_times_ms,
    prepared_frames,
    radio_times_ms,
    step_cost,
    step_times_ms,
    twin_times_ms,
)
from .swing import Swing, stored_scene

_FEW, _MANY = 4, 64
"""Tags."""

_EARLY = 300
"""Frames before which a recording counts as short."""


@dataclasses.dataclass(frozen=True)
class TracerSpeedSettings:
    """What the tracer is timed on. Times are of two CPU cores; other load on the machine raises them.

    The recording is played forth and back. None: four objects in the hands of two people and a third who walks are
    simulated, `simulated_frames` long (half a minute for 90 of 512x424).
    """

    recording: str | None = None  # a stored recording (.zarr) of at least one tag
    width: int = 512  # of the simulated pictures
    simulated_frames: int = 90
    stride: int = 2  # every n-th pixel
    flow: str = "dis_live"
    frames: int = 600  # of the longest run; those after the first 300 say whether time grows with the recording
    part_frames: int = 120  # of the other runs
    scaling: bool = True  # also measure a step for other numbers of tags and pixels, and the machine's limits
    processes: bool = True  # also measure fresh processes: first mask, memory

    def __post_init__(self) -> None:
        least = {"width": 64, "simulated_frames": 2, "stride": 1, "frames": 2, "part_frames": 8}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {value}.")


def tracer_figures(settings: TracerSpeedSettings, seed: int) -> Iterator[Timing | Figure]:
    """Measure one figure after the other. Times are until device work has finished, medians unless they say otherwise."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "benchmark.zarr" if settings.recording is None else Path(settings.recording)
        if settings.recording is None:
            stored_scene(path, width=settings.width, num_frames=settings.simulated_frames, seed=seed)
        recording = open_recording(path)
        yield from _whole(settings, recording)
        yield from _parts(settings, recording, seed)
        if settings.scaling:
            yield from _scaling(settings, recording)
        if settings.processes:
            yield from _processes(settings, path)


def _whole(settings: TracerSpeedSettings, recording: Recording) -> Iterator[Figure]:
    swing = Swing.of(recording, num_tags=_FEW)
    size = f"{swing.intrinsics.width}x{swing.intrinsics.height}"
    (times,) = frame_times_ms([swing], settings.frames, stride=settings.stride, flow=settings.flow, with_masks=True)
    what = f"frame of {size} with {settings.flow}, {_FEW} tags and their dense masks"
    yield Figure(f"{what}, median", float(np.median(times)), "ms", 25.0)
    yield Figure(f"{what}, 99 %", float(np.percentile(times, 99)), "ms", 40.0)
    early = min(_EARLY, len(times) // 2)
    growth = float(np.median(times[early:]) / np.median(times[:early]))
    yield Figure(f"the same, after the first {early} frames over these", growth, "", 1.1)
    (ahead,) = frame_times_ms(
        [swing], settings.part_frames, stride=settings.stride, flow=settings.flow, with_masks=True, ahead=True
    )
    yield Figure("the same, its result awaited during the next frame's flow", float(np.mean(ahead)), "ms")
    one, many = frame_times_ms(
        [Swing.of(recording, num_tags=number) for number in (1, _MANY)], settings.part_frames,
        stride=settings.stride, flow=settings.flow, with_masks=False,
    )  # fmt: skip
    yield Figure("frame, 1 tag, box only", float(np.median(one)), "ms")
    yield Figure(f"frame, {_MANY} tags, boxes only", float(np.median(many)), "ms")
    yield Figure(f"frame, {_MANY} tags over 1", float(np.median(many) / np.median(one)), "", 2.5)


def _parts(settings: TracerSpeedSettings, recording: Recording, seed: int) -> Iterator[Timing | Figure]:
    for num_tags, aim in ((_FEW, 1.0), (_MANY, 0.5)):
        swing = Swing.of(recording, num_tags=num_tags)
        camera, frames = prepared_frames(swing, settings.part_frames, stride=settings.stride, flow=settings.flow)
        if num_tags == _FEW:
            flows = dict.fromkeys((settings.flow, "dis"))
            for name, value in flow_times_ms(swing, settings.part_frames, flows=tuple(flows)).items():
                yield Figure(f"part: flow ({name})", value, "ms")
        for name, value in part_times_ms(camera, frames).items():
            if num_tags == _FEW or name == "per-tag side":
                yield Figure(f"part: {name}, {num_tags} tags", value, "ms")
        ours, twin = twin_times_ms(camera, frames, with_masks=num_tags == _FEW)
        masks = ", masks" if num_tags == _FEW else ""
        timing = Timing(f"step without flow, {num_tags} tags{masks}", ours, "NumPy twin", twin)
        yield timing
        yield Figure(f"step, {num_tags} tags, over the twin's", timing.ratio, "", aim)
    ours, twin = radio_times_ms(_MANY, settings.part_frames, seed)
    yield Timing(f"reads of a frame, one of each of {_MANY} tags", ours, "NumPy twin", twin)
    yield Figure(f"radio side of a frame, {_MANY} tags", ours, "ms", 1.0)


def _scaling(settings: TracerSpeedSettings, recording: Recording) -> Iterator[Figure]:
    by_tags = [(num_tags, settings.stride) for num_tags in (1, _FEW, 16, _MANY)]
    by_pixels = [(_FEW, stride) for stride in (2 * settings.stride, max(1, settings.stride // 2))]
    cost: dict[str, float] = {}
    for num_tags, stride in dict.fromkeys([*by_tags, *by_pixels]):
        swing = Swing.of(recording, num_tags=num_tags)
        camera, frames = prepared_frames(swing, settings.part_frames, stride=stride, flow=settings.flow)
        height, width, _ = camera.rays.shape
        times = step_times_ms(camera, frames)
        yield Figure(f"step without flow, boxes only, {num_tags} tags, {width}x{height}", float(np.median(times)), "ms")
        if (num_tags, stride) == (_FEW, settings.stride):
            cost = step_cost(camera, frames[0])
    limits = machine_limits()
    yield Figure("this machine copies", 1e-9 * limits["bytes_per_s"], "GB/s")
    yield Figure("this machine multiplies matrices", 1e-9 * limits["flops_per_s"], "GFLOP/s")
    for name, what in (("given_bytes", "inputs and outputs"), ("accessed_bytes", "all operations")):
        yield Figure(f"step, {_FEW} tags: bytes of {what}", 1e-6 * cost[name], "MB")
        yield Figure(f"... at the speed of a copy: {what}", 1e3 * cost[name] / limits["bytes_per_s"], "ms")
    yield Figure(f"step, {_FEW} tags: floating point operations", 1e-6 * cost["flops"], "MFLOP")
    yield Figure("... at the speed of a product of matrices", 1e3 * cost["flops"] / limits["flops_per_s"], "ms")


def _processes(settings: TracerSpeedSettings, path: Path) -> Iterator[Figure]:
    cold_s, cached_s = start_times_s(path, num_tags=_FEW, stride=settings.stride, flow=settings.flow)
    yield Figure("first mask of a process, nothing compiled", cold_s, "s", 12.0)
    yield Figure("first mask of a process, compilation cache", cached_s, "s", 4.0)
    frames = settings.part_frames
    mib = stream_memory_mib(path, frames, num_tags=_FEW, stride=settings.stride, flow=settings.flow)
    yield Figure(f"largest memory of a process, {frames} frames", mib, "MiB", 1024.0)
