"""Speed of the stages, each against a peer that does the same work in the same run.

Times are medians over repetitions after a warm-up, until device work has finished; the ratio is ours over the peer's.
"""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.progress import OnProgress, unobserved
from ..flow.registry import make_flow
from ..image.warp import gather, splat
from ..radio.coherence import coherence
from ..sim.flow_pairs import FlowPairSettings, flow_pairs
from ..sim.record import CaptureSettings, simulate_recording
from ..sim.stories import build_scenario
from ..tagattention import TagAttention
from ..tagattention.segmentation import segment
from ..tracing.clips import load_clip
from ..tracing.range_windows import phase_reads, radio_windows
from ..tracing.tracer import trace
from .flow_speed import flow_timings
from .timing import Figure, Timing, first_call_s, median_ms
from .tracer_speed import MemorySettings, TracerSpeedSettings, memory_figures, tracer_figures
from .training_speed import training_timings


@dataclasses.dataclass(frozen=True)
class BenchmarkSettings:
    """The measured cases, and the size of their inputs."""

    cases: tuple[str, ...] = ("gather", "splat", "segment", "coherence", "radio", "step", "simulate", "pairs", "flow")
    height: int = 424
    width: int = 512
    repeats: int = 7
    seed: int = 0
    tracer: TracerSpeedSettings = dataclasses.field(default_factory=TracerSpeedSettings)
    memory: MemorySettings = dataclasses.field(default_factory=MemorySettings)

    def __post_init__(self):
        unknown = sorted(set(self.cases) - set(CASES))
        if unknown or not self.cases:
            raise ValueError(f"cases: found {', '.join(unknown) or 'none'}; expected some of {', '.join(CASES)}.")
        if self.height < 32 or self.width < 32 or self.repeats < 1:
            raise ValueError(
                f"found pictures of {self.width}x{self.height} pixels and repeats={self.repeats}; expected at least 32x32 pixels "
                "and 1 repetition."
            )


def _warps(settings: BenchmarkSettings) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(settings.seed)
    image = rng.uniform(size=(settings.height, settings.width, 5)).astype(np.float32)
    coarse = rng.normal(0, 4, (6, 8, 2)).astype(np.float32)
    return image, cv2.resize(coarse, (settings.width, settings.height), interpolation=cv2.INTER_CUBIC)


def _gather(settings: BenchmarkSettings) -> Timing:
    image, flow = _warps(settings)
    x, y = np.meshgrid(np.arange(settings.width, dtype=np.float32), np.arange(settings.height, dtype=np.float32))
    run = jax.jit(gather)
    arguments = jnp.asarray(image), jnp.asarray(flow)
    compile_s = first_call_s(lambda: run(*arguments))
    halves = image[..., :4].copy(), image[..., 4:].copy()  # cv2.remap takes at most four channels

    def peer():
        for part in halves:
            cv2.remap(part, x + flow[..., 0], y + flow[..., 1], cv2.INTER_LINEAR)

    what = f"warp.gather, 5 channels, {settings.width}x{settings.height}"
    ours = median_ms(lambda: run(*arguments), settings.repeats)
    return Timing(what, ours, "cv2.remap", median_ms(peer, settings.repeats), compile_s)


def _splat(settings: BenchmarkSettings) -> Timing:
    image, flow = _warps(settings)
    height, width = settings.height, settings.width
    run = jax.jit(splat)
    arguments = jnp.asarray(image), jnp.asarray(flow)
    compile_s = first_call_s(lambda: run(*arguments))

    def peer():
        x, y = np.meshgrid(np.arange(width), np.arange(height))
        u, v = x + flow[..., 0], y + flow[..., 1]
        left, top = np.floor(u).astype(int), np.floor(v).astype(int)
        total = np.zeros((height * width, 6))
        for dy in (0, 1):
            for dx in (0, 1):
                column, row = left + dx, top + dy
                inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
                weight = (1 - np.abs(u - column)) * (1 - np.abs(v - row)) * inside
                index = np.where(inside, row * width + column, 0).ravel()
                for channel in range(5):
                    value = (weight * image[..., channel]).ravel()
                    total[:, channel] += np.bincount(index, value, height * width)
                total[:, 5] += np.bincount(index, weight.ravel(), height * width)
        return total

    what = f"warp.splat, 5 channels, {width}x{height}"
    ours = median_ms(lambda: run(*arguments), settings.repeats)
    return Timing(what, ours, "np.bincount", median_ms(peer, settings.repeats), compile_s)


def _segment(settings: BenchmarkSettings) -> Timing:
    height, width = 120, 160
    rng = np.random.default_rng(settings.seed)
    depth = cv2.resize(rng.uniform(1, 5, (6, 8)).astype(np.float32), (width, height))
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, width), np.linspace(-0.4, 0.4, height))
    points = np.stack([x * depth, y * depth, depth], axis=-1).astype(np.float32)
    run = jax.jit(lambda p: segment(p, jnp.ones(p.shape[:2], bool), jnp.asarray(0.06), cell=8))
    points_device = jnp.asarray(points)
    compile_s = first_call_s(lambda: run(points_device))
    clusters = (height // 8) * (width // 8)
    stop = (cv2.TERM_CRITERIA_MAX_ITER, 3, 0.0)
    samples = points.reshape(-1, 3)

    def peer():
        cv2.setRNGSeed(0)
        return cv2.kmeans(samples, clusters, None, stop, 1, cv2.KMEANS_RANDOM_CENTERS)[0]  # pyright: ignore[reportCallIssue, reportArgumentType]

    what = f"segment, {clusters} segments, {width}x{height}, 3 iterations"
    ours = median_ms(lambda: run(points_device), settings.repeats)
    return Timing(what, ours, "cv2.kmeans", median_ms(peer, max(1, settings.repeats // 3)), compile_s)


def _coherence(settings: BenchmarkSettings) -> Timing:
    rng = np.random.default_rng(settings.seed)
    residual = rng.uniform(0, 2 * np.pi, (300, 64)).astype(np.float32)
    weight = np.ones((1, 64), np.float32)
    channel = rng.integers(0, 16, (1, 64)).astype(np.int32)
    run = jax.jit(lambda r, w, c: coherence(r, w, c, num_channels=16))
    arguments = jnp.asarray(residual), jnp.asarray(weight), jnp.asarray(channel)
    compile_s = first_call_s(lambda: run(*arguments))
    member = channel[0][:, None] == np.arange(16)

    def peer():
        return np.abs(np.exp(1j * residual) @ member).sum(axis=1) / 64

    ours = median_ms(lambda: run(*arguments), settings.repeats)
    return Timing("coherence, 300 motions, 64 reads", ours, "NumPy", median_ms(peer, settings.repeats), compile_s)


def _small_recording(settings: BenchmarkSettings):
    scenario = build_scenario("walkers", np.random.default_rng(settings.seed), 3.0)
    capture = CaptureSettings(sensor="xtion", width=320, frame_rate_hz=10.0)
    return simulate_recording(scenario, capture, seed=settings.seed, name="benchmark", num_frames=24)


def _radio(settings: BenchmarkSettings) -> Timing:
    recording = _small_recording(settings)
    reads = phase_reads(recording.reads, recording.reads.epcs[0], int(recording.time_ns[0]))
    time_s = jnp.asarray(recording.frame_time_s(), jnp.float32)
    compile_s = first_call_s(lambda: radio_windows(reads, time_s, 5, "robust"))
    ours = median_ms(lambda: radio_windows(reads, time_s, 5, "robust"), settings.repeats)
    peer = median_ms(lambda: radio_windows(reads, time_s, 5, "literal"), settings.repeats)
    return Timing(f"robust radio, {recording.num_frames} frames, one tag", ours, "paper's radio", peer, compile_s)


def _step(settings: BenchmarkSettings) -> Timing:
    recording = _small_recording(settings)
    clip = load_clip(recording, 0, recording.num_frames, stride=2)
    tracer = TagAttention()
    run = eqx.filter_jit(trace)
    compile_s = first_call_s(lambda: run(tracer, clip.camera, clip.frames).box_px)
    whole = median_ms(lambda: run(tracer, clip.camera, clip.frames).box_px, settings.repeats)
    rng = np.random.default_rng(settings.seed)
    picture = cv2.GaussianBlur((rng.uniform(size=(settings.height, settings.width)) * 255).astype(np.uint8), (0, 0), 3)
    other = np.roll(picture, 2, axis=1)
    flow = make_flow("dis")
    peer = median_ms(lambda: flow(picture, other), settings.repeats)
    what = f"TagAttention, a frame of 160x120, {len(clip.epcs)} tags"
    name = f"DIS flow, {settings.width}x{settings.height}, one way"
    return Timing(what, whole / recording.num_frames, name, peer, compile_s)


def _simulate(settings: BenchmarkSettings) -> Timing:
    """A frame of the office with one walker, as in `single_dynamic`: shadows, sensor noise, labels, flow in both directions.

    The first frame, which renders the static background, is left out, and so are reads.
    """
    scenario = build_scenario(
        "handheld", np.random.default_rng(settings.seed), 2.0, {"room": "office", "num_walkers": 1}
    )
    scenario = dataclasses.replace(scenario, world=dataclasses.replace(scenario.world, tags=()))
    stamps: list[float] = []
    capture = CaptureSettings(width=settings.width, flow=True, frame_rate_hz=15.0)
    simulate_recording(
        scenario, capture, seed=settings.seed, name="benchmark", on_frame=lambda: stamps.append(time.perf_counter())
    )
    ours = float(np.median(np.diff(stamps))) * 1e3
    height = capture.intrinsics().height
    return Timing(f"simulated frame, {settings.width}x{height}, truth and flow on", ours, "4 frames/s", 250.0)


def _pairs(settings: BenchmarkSettings) -> Timing:
    batch = 16
    draw = lambda seed: flow_pairs(FlowPairSettings(), batch, key=jax.random.key(seed)).first  # noqa: E731
    compile_s = first_call_s(lambda: draw(0))
    ours = median_ms(lambda: draw(1), settings.repeats) / batch
    return Timing("flow pair, exact flow both ways", ours, "50 pairs/s", 20.0, compile_s)


def _flow(settings: BenchmarkSettings) -> list[Timing]:
    return flow_timings(settings.height, settings.width, settings.repeats, settings.seed)


def _training(settings: BenchmarkSettings) -> Iterator[Timing]:
    return training_timings(max(2, settings.repeats // 3), settings.seed)


def _tracer(settings: BenchmarkSettings) -> Iterator[Timing | Figure]:
    return tracer_figures(settings.tracer, settings.seed)


def _memory(settings: BenchmarkSettings) -> Iterator[Figure]:
    return memory_figures(settings.memory, settings.seed)


CASES: Mapping[str, Callable[[BenchmarkSettings], Timing | Iterable[Timing | Figure]]] = {
    "gather": _gather,
    "splat": _splat,
    "segment": _segment,
    "coherence": _coherence,
    "radio": _radio,
    "step": _step,
    "simulate": _simulate,
    "pairs": _pairs,
    "flow": _flow,
    "training": _training,
    "tracer": _tracer,
    "memory": _memory,
}
"""The cases that can be measured, by name."""


def run_benchmark(settings: BenchmarkSettings, *, on_progress: OnProgress = unobserved) -> Iterator[Timing | Figure]:
    """Measure the cases one after the other and yield each timing; `on_progress` counts the cases."""
    for number, name in enumerate(settings.cases):
        on_progress("measure", number, len(settings.cases), name)
        timings = CASES[name](settings)
        yield from (timings,) if isinstance(timings, Timing) else timings
    on_progress("measure", len(settings.cases), len(settings.cases))
