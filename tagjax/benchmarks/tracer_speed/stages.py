"""Times of the tracer's parts, and of the whole step beside its NumPy twin's, on the same frames in the same run."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ...core.geometry import pixel_rays
from ...flow.registry import make_flow
from ...radio.arrivals import Arrivals
from ...radio.reader_model import ReaderModel
from ...tagattention.segments import DwellEvidence, TagAttention
from ...tagattention.segments.cells import NOT_NEW
from ...tagattention.segments.dwell import DwellState
from ...tagattention.segments.outline import filled_labels, joined_boxes, segment_boxes
from ...tracing.arrivals import frame_arrivals
from ...tracing.clips import MAX_ARRIVALS, choose_antennas, subsampled_depth
from ...tracing.tracer import Camera, Frame
from ..segments_numpy import NumpyTracer
from ..segments_numpy.reads import Dwells
from ..timing import median_ms
from .live import masks
from .swing import Shot, Swing

_WARM_UP = 5
_FRAME_S = 1 / 30


@eqx.filter_jit(donate="all-except-first")
def _pixels(inputs: tuple[TagAttention, Camera, Frame, Any], state: Any) -> Any:
    tracer, camera, frame, dt_s = inputs
    return tracer.segments.step(camera, state, frame.depth_m, frame.backward_px, dt_s)


@eqx.filter_jit(donate="all-except-first")
def _tags(inputs: tuple[TagAttention, Camera, Any, Frame], state: Any) -> Any:
    tracer, camera, found, frame = inputs
    return tracer.associate(camera, state, found, frame)


@eqx.filter_jit
def _boxes(labels: Any, depth_m: Any, membership: Any) -> Any:
    filled = filled_labels(labels, depth_m)
    return filled, joined_boxes(segment_boxes(filled, membership.shape[1]), membership > 0.5)


@eqx.filter_jit(donate="all-except-first")
def _follow(inputs: tuple[TagAttention, Camera, Frame], state: Any) -> Any:
    tracer, camera, frame = inputs
    return tracer.follow(camera, state, frame)


@eqx.filter_jit(donate="all-except-first")
def _dwell(inputs: tuple[DwellEvidence, ReaderModel, Arrivals, Any, Any, Any, Any, Any], state: DwellState) -> Any:
    dwell, reader, arrivals, increment_m, depth_m, source, now_s, exists = inputs
    return dwell.step(reader, state, arrivals, increment_m, depth_m, source, now_s - _FRAME_S, now_s, exists)


def flow_times_ms(swing: Swing, num_frames: int, *, flows: Sequence[str]) -> dict[str, float]:
    """Median times of flows along the first pictures, which alternate, ms."""
    estimates = {name: make_flow(name) for name in flows}
    times: dict[str, list[float]] = {name: [] for name in flows}
    pictures = [shot.colour for shot in swing.shots(num_frames)]
    for last, picture in itertools.pairwise(pictures):
        for name, estimate in estimates.items():
            begun = time.perf_counter()
            estimate(picture, last)
            times[name].append(1e3 * (time.perf_counter() - begun))
    return {name: float(np.median(own)) for name, own in times.items()}


def prepared_frames(swing: Swing, num_frames: int, *, stride: int, flow: str) -> tuple[Camera, list[Frame]]:
    """The camera, and the first frames with their flow."""
    estimate, frames = make_flow(flow), []
    recording, epcs = swing.recording, swing.epcs
    antennas = choose_antennas(recording, recording.reads.epcs)
    rays = jnp.asarray(pixel_rays(swing.intrinsics.scaled(stride)))
    camera = Camera(rays, jnp.asarray(np.asarray(recording.antennas_m, np.float32)[np.array(antennas) - 1]))
    no_flow, present = jnp.zeros((*rays.shape[:2], 2)), jnp.ones(len(epcs), bool)
    last: Shot | None = None
    for shot in swing.shots(num_frames):
        backward_px = no_flow
        if last is not None:
            backward_px = np.asarray(estimate(shot.colour, last.colour))[::stride, ::stride] / np.float32(stride)
        since_ns = None if last is None else last.time_ns
        stamp = np.array([shot.time_ns])
        arrivals, _ = frame_arrivals(shot.reads, epcs, antennas, stamp, 0, MAX_ARRIVALS, since_ns=since_ns)
        frames.append(
            Frame.of_arrivals(
                jnp.asarray(shot.time_ns * 1e-9, jnp.float32),
                jnp.asarray(subsampled_depth(shot.depth_m[None], stride)[0]),
                jnp.asarray(backward_px),
                jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), arrivals),
                present,
                len(antennas),
            )
        )
        last = shot
    return camera, frames


def part_times_ms(camera: Camera, frames: list[Frame]) -> dict[str, float]:
    """Median times of the parts of a step, each until it is done, ms."""
    tracer, times = TagAttention(), {"pixel side": [], "per-tag side": [], "boxes": [], "dense masks": []}
    start = eqx.filter_jit(tracer.init)(camera, frames[0])
    pixels, tags, last_s = start.segments, start.tags, frames[0].time_s

    def timed(name: str, call: Callable[[], Any]) -> Any:
        begun = time.perf_counter()
        out = jax.block_until_ready(call())
        times[name].append(1e3 * (time.perf_counter() - begun))
        return out

    for frame in frames:
        inputs = tracer, camera, frame, frame.time_s - last_s
        pixels, found = timed("pixel side", lambda inputs=inputs, state=pixels: _pixels(inputs, state))
        given = tracer, camera, found, frame
        tags, out = timed("per-tag side", lambda given=given, state=tags: _tags(given, state))
        given = found.labels, frame.depth_m, out.membership
        labels, _ = timed("boxes", lambda given=given: _boxes(*given))
        timed("dense masks", lambda labels=labels, out=out: masks(labels, out.membership))
        last_s = frame.time_s
    return {name: float(np.median(own[_WARM_UP:])) for name, own in times.items()}


def step_times_ms(camera: Camera, frames: list[Frame]) -> np.ndarray:
    """Times of a step without the flow, (frame,) ms."""
    tracer, times = TagAttention(), []
    state = eqx.filter_jit(tracer.init)(camera, frames[0])
    for frame in frames:
        begun = time.perf_counter()
        state, trace = _follow((tracer, camera, frame), state)
        jax.block_until_ready(trace)
        times.append(1e3 * (time.perf_counter() - begun))
    return np.array(times[_WARM_UP:])


def step_cost(camera: Camera, frame: Frame) -> dict[str, float]:
    """What XLA counts of a step: bytes of all inputs and outputs, bytes that its operations read and write, and their FLOPs.

    None of them depends on the frame's values.
    """
    tracer = TagAttention()
    state = eqx.filter_jit(tracer.init)(camera, frame)
    step = jax.jit(lambda camera, frame, state: tracer.follow(camera, state, frame), donate_argnums=2)
    compiled = step.lower(camera, frame, state).compile()
    memory, counted = compiled.memory_analysis(), compiled.cost_analysis()
    assert memory is not None
    assert counted is not None
    return {
        "given_bytes": float(memory.argument_size_in_bytes + memory.output_size_in_bytes),
        "accessed_bytes": counted["bytes accessed"],
        "flops": counted["flops"],
    }


def machine_limits() -> dict[str, float]:
    """What this machine reaches: bytes/s read and written by a copy, and FLOP/s of a product of matrices."""
    source = np.ones(2**25, np.float32)
    target, matrix = np.empty_like(source), jnp.ones((2048, 2048))
    product = jax.jit(lambda one: one @ one)
    return {
        "bytes_per_s": 2e3 * source.nbytes / median_ms(lambda: np.copyto(target, source), 7),
        "flops_per_s": 2e3 * 2048**3 / median_ms(lambda: product(matrix), 7),
    }


def twin_times_ms(camera: Camera, frames: list[Frame], *, with_masks: bool) -> tuple[float, float]:
    """Median times of a step (without the flow) of the tracer and of its NumPy twin, whose frames alternate, ms."""
    tracer = TagAttention()
    state = eqx.filter_jit(tracer.init)(camera, frames[0])
    num_tags = len(state.tags.recent.number)
    twin, ours, theirs = NumpyTracer(tracer, camera, num_tags), [], []
    for frame in frames:
        begun = time.perf_counter()
        state, trace = _follow((tracer, camera, frame), state)
        jax.block_until_ready((trace, masks(trace.labels, trace.tags.membership) if with_masks else ()))
        between = time.perf_counter()
        found = twin.follow(frame)
        if with_masks:
            twin.masks(found)
        ours.append(1e3 * (between - begun))
        theirs.append(1e3 * (time.perf_counter() - between))
    return float(np.median(ours[_WARM_UP:])), float(np.median(theirs[_WARM_UP:]))


def radio_times_ms(num_tags: int, num_frames: int, seed: int) -> tuple[float, float]:
    """Median times of the evidence of a frame in which every tag is read once, ms: the tracer's and the twin's.

    An eighth of the slots has a segment.
    """
    dwell, reader, rng = DwellEvidence(), ReaderModel(), np.random.default_rng(seed)
    num = TagAttention().segments.segmenter.num_segments
    state, depth_m = DwellState.nothing(num_tags, 1, num), jnp.full(num, 2.0)
    twin = Dwells(dwell, reader, num_tags, 1, num)
    increment_m = jnp.asarray(rng.normal(0, 0.005, (1, num)), jnp.float32)
    source, exists = jnp.full(num, NOT_NEW, jnp.int32), jnp.arange(num) % 8 == 0
    ours, theirs = [], []
    for number in range(1, num_frames + _WARM_UP + 1):
        now_s = jnp.asarray(number * _FRAME_S, jnp.float32)
        arrivals = Arrivals(
            tag=jnp.arange(num_tags, dtype=jnp.int32),
            antenna=jnp.zeros(num_tags, jnp.int32),
            time_s=jnp.asarray(np.sort(rng.uniform(number - 1, number, num_tags)) * _FRAME_S, jnp.float32),
            phase_rad=jnp.asarray(rng.uniform(0, 2 * np.pi, num_tags), jnp.float32),
            carrier_hz=jnp.full(num_tags, 915e6),
            channel=jnp.full(num_tags, 915000, jnp.int32),
            rssi_dbm=jnp.full(num_tags, -55.0),
            valid=jnp.ones(num_tags, bool),
        )
        begun = time.perf_counter()
        inputs = dwell, reader, arrivals, increment_m, depth_m, source, now_s, exists
        state, _ = jax.block_until_ready(_dwell(inputs, state))
        between = time.perf_counter()
        reads = {name: np.asarray(values) for name, values in vars(arrivals).items()}
        since_s = np.float32(now_s) - np.float32(_FRAME_S)
        twin.step(
            reads, np.asarray(increment_m), np.asarray(depth_m), np.asarray(source), since_s, np.float32(now_s),
            np.asarray(exists),
        )  # fmt: skip
        ours.append(1e3 * (between - begun))
        theirs.append(1e3 * (time.perf_counter() - between))
    return float(np.median(ours[_WARM_UP:])), float(np.median(theirs[_WARM_UP:]))
