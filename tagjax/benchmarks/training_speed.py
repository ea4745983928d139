"""Time and memory of one step of tracer training against the length of its clip, each in a separate process.

Memory is the largest resident memory of the process after its steps, including Python, XLA's compilation, and the clip.
On the CPU backend that is all memory; on a GPU it is the host memory only.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator

import jax
import numpy as np
import optax

from ..core.machine import peak_memory_mib
from ..sim.record import CaptureSettings, simulate_recording
from ..sim.stories import build_scenario
from ..tagattention import TagAttention
from ..tracing.clips import Clip, ClipSettings, load_clip
from ..training.objective import ObjectiveSettings
from ..training.state import TrainState
from ..training.step import make_optimizer, train_step
from .timing import Timing, in_separate_process

LENGTHS = (12, 24, 48, 96)
"""Frames of a clip."""

_WIDTH, _HEIGHT, _STRIDE = 320, 240, 2


def training_timings(repeats: int, seed: int) -> Iterator[Timing]:
    """A training step for each clip length, with the tracer's steps recomputed in the backward pass or stored.

    Each variant is the other's peer; the memory of both is measured.
    """
    for length in LENGTHS:
        recomputed, stored = (step_cost(length, rematerialise, repeats, seed) for rematerialise in (True, False))
        what = f"training step, {length} frames of {_WIDTH // _STRIDE}x{_HEIGHT // _STRIDE}"
        for name, one, peer, other in (
            ("recomputed", recomputed, "stored", stored),
            ("stored", stored, "recomputed", recomputed),
        ):
            yield Timing(f"{what}, {name}", one["step_ms"], peer, other["step_ms"], one["compile_s"], one["memory_mib"])


def step_cost(length: int, rematerialise: bool, repeats: int, seed: int) -> dict[str, float]:
    """`step_ms`, `compile_s` and `memory_mib` of a training step, and `idle_mib` before it, in a fresh process."""
    code = (
        "from tagjax.benchmarks.training_speed import _report_step; "
        f"_report_step({length}, {rematerialise}, {repeats}, {seed})"
    )
    return in_separate_process(code, f"A training step of {length} frames")


def _clip(length: int, seed: int) -> Clip:
    """A clip of this length: three people with a badge each."""
    scenario = build_scenario("walkers", np.random.default_rng(seed), length / 10 + 1)
    capture = CaptureSettings(sensor="xtion", width=_WIDTH, frame_rate_hz=10.0)
    recording = simulate_recording(scenario, capture, seed=seed, name="training step", num_frames=length)
    settings = ClipSettings(stride=_STRIDE, flow="dis_ultrafast")
    return load_clip(recording, 0, length, **settings.arguments())


def _report_step(length: int, rematerialise: bool, repeats: int, seed: int) -> None:
    clip = _clip(length, seed)
    optimizer = make_optimizer(optax.adam(0.01), 1.0)
    state = TrainState.create(TagAttention(), optimizer, seed=seed)
    settings = ObjectiveSettings(rematerialise=rematerialise, skip_frames=min(12, length // 2))
    jax.block_until_ready(clip.frames)
    cost = {"idle_mib": peak_memory_mib()}
    times_s = []
    for _ in range(repeats + 1):
        start = time.perf_counter()
        state, _ = train_step(state, [clip], optimizer, settings)  # its values are on the host when it returns
        times_s.append(time.perf_counter() - start)
    cost |= {
        "memory_mib": peak_memory_mib(),
        "step_ms": 1e3 * float(np.median(times_s[1:])),
        "compile_s": times_s[0] - float(np.median(times_s[1:])),
    }
    print(json.dumps(cost))
