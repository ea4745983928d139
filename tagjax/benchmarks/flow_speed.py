"""Speed and memory of the flow networks beside OpenCV's DIS, and of a step of the default one's training."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import cv2
import jax
import numpy as np
import optax

from ..core.machine import peak_memory_mib
from ..flow.estimates import NetworkFlow, flow_along
from ..flow.losses import FlowLossSettings
from ..flow.pyramid import PyramidFlow
from ..flow.registry import make_flow
from ..training.flow_step import FlowTrainState, flow_step
from .timing import Timing, first_call_s, in_separate_process, medians_ms

_BATCH, _ROWS, _COLUMNS = 8, 128, 160
"""Pairs of a training step, and their size."""

_AVERAGE_OVER = 500.0
_DIS = {"dis": "DIS medium", "dis_fast": "DIS fast", "dis_ultrafast": "DIS ultrafast"}


def moved_pictures(height: int, width: int, count: int, seed: int) -> list[np.ndarray]:
    """RGB pictures of a texture that moves by a smooth flow of a few pixels from one picture to the next."""
    rng = np.random.default_rng(seed)
    margin = 24
    grain = rng.uniform(0, 255, (height + 2 * margin, width + 2 * margin, 3)).astype(np.float32)
    scene = np.sum([2 * sigma * cv2.GaussianBlur(grain, (0, 0), sigma) for sigma in (1.0, 3.0, 9.0)], axis=0)
    scene = 255 * (scene - scene.min()) / np.ptp(scene)
    flow = cv2.resize(rng.normal(0, 3, (5, 6, 2)).astype(np.float32), (width, height), interpolation=cv2.INTER_CUBIC)
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    pictures = []
    for t in range(count):
        moved = cv2.remap(scene, x + margin - t * flow[..., 0], y + margin - t * flow[..., 1], cv2.INTER_LINEAR)
        pictures.append(np.clip(moved + rng.normal(0, 2, moved.shape), 0, 255).astype(np.uint8))
    return pictures


def _step(seed: int) -> Callable[[], Any]:
    """A function that does a training step of the default network on a batch."""
    optimizer = optax.adam(1e-3)
    states = [FlowTrainState.create(PyramidFlow(seed=seed), optimizer, seed=seed)]
    pairs = [np.stack(moved_pictures(_ROWS, _COLUMNS, 2, seed + n)) for n in range(_BATCH)]
    samples = [{"clean": pair, "augmented": pair} for pair in pairs]

    def step() -> float:
        states[0], numbers = flow_step(states[0], samples, optimizer, FlowLossSettings(), _AVERAGE_OVER)
        return numbers["loss"]

    return step


def flow_timings(height: int, width: int, repeats: int, seed: int) -> list[Timing]:
    """Times of flows in one and both directions against DIS, with and without smoothing, along a video, and of a training step.

    The fast and the fine pyramid have their packaged weights; the others are untrained. All times are of whole calls, from
    uint8 pictures to flow on the host.
    """
    memory = flow_memory(height, width, seed)
    pictures = moved_pictures(height, width, 4, seed)
    first, second = pictures[:2]
    network = NetworkFlow(PyramidFlow(seed=seed))
    compile_s = first_call_s(lambda: network(first, second))
    packaged = {name: make_flow(name) for name in ("pyramid_fast", "pyramid_fine", "pyramid_fine+wls", "dis+wls")}
    packaged_compile_s = {name: first_call_s(lambda flow=flow: flow(first, second)) for name, flow in packaged.items()}
    calls: dict[str, Callable[[], Any]] = {"pyramid": lambda: network(first, second)}
    calls |= {name: lambda flow=flow: flow(first, second) for name, flow in packaged.items()}
    peers = {name: make_flow(name) for name in _DIS}
    calls |= {name: lambda flow=flow: flow(first, second) for name, flow in peers.items()}
    calls["pyramid along"] = lambda: list(flow_along(network, pictures))
    calls["dis along"] = lambda: list(flow_along(peers["dis"], pictures))
    times_ms = medians_ms(calls, repeats)
    size, pairs = f"{width}x{height}", len(pictures) - 1
    fast, dis = f"pyramid_fast, {size}, one way", ("DIS medium", times_ms["dis"])
    timings = [
        Timing(fast, times_ms["pyramid_fast"], label, times_ms[name], packaged_compile_s["pyramid_fast"])
        for name, label in _DIS.items()
    ]
    timings += [
        Timing(f"pyramid, {size}, one way", times_ms["pyramid"], *dis, compile_s, memory["forward"]),
        Timing(f"pyramid_fine, {size}, one way", times_ms["pyramid_fine"], *dis, packaged_compile_s["pyramid_fine"]),
    ]
    # Smoothing needs the flow in both directions.
    timings += [
        Timing(f"{name}, {size}, one way", times_ms[name], *dis, packaged_compile_s[name])
        for name in ("pyramid_fine+wls", "dis+wls")
    ]
    both = times_ms["pyramid along"] / pairs, "DIS medium, both ways", times_ms["dis along"] / pairs
    timings.append(Timing(f"pyramid, {size}, both ways, a frame of a video", *both))
    step = _step(seed)
    step_compile_s = first_call_s(step)
    times_ms = medians_ms({"step": step, "pyramid": calls["pyramid"]}, max(2, repeats // 3))
    what = f"training step, {_BATCH} pairs of {_COLUMNS}x{_ROWS}"
    peer = f"pyramid, {size}, one way"
    timings.append(Timing(what, times_ms["step"], peer, times_ms["pyramid"], step_compile_s, memory["step"]))
    return timings


def flow_memory(height: int, width: int, seed: int) -> dict[str, float]:
    """Largest resident memory, MiB, of a separate process after its first flow, and after a training step.

    It includes Python and XLA's compilation; `idle` is the memory before both.
    """
    code = f"from tagjax.benchmarks.flow_speed import _report_memory; _report_memory({height}, {width}, {seed})"
    return in_separate_process(code, "The process whose memory is measured")


def _report_memory(height: int, width: int, seed: int) -> None:
    first, second = moved_pictures(height, width, 2, seed)
    jax.block_until_ready(jax.numpy.zeros(()))
    memory_mib = {"idle": peak_memory_mib()}
    NetworkFlow(PyramidFlow(seed=seed))(first, second)
    memory_mib["forward"] = peak_memory_mib()
    _step(seed)()
    memory_mib["step"] = peak_memory_mib()
    print(json.dumps(memory_mib))
