"""Speed and memory of the flow networks beside OpenCV's DIS, and of a step of the default one's training."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import cv2
import jax
import numpy as np
import optax

from ..flow.estimates import NetworkFlow, flow_along
from ..flow.losses import FlowLossSettings
from ..flow.named import make_flow
from ..flow.pyramid import PyramidFlow
from ..training.flow_step import FlowTrainState, flow_step
from .timing import Timing, first_call_s, in_own_process, medians_ms, peak_memory_mib

_BATCH, _ROWS, _COLUMNS = 8, 128, 160
"""Pairs of a training step, and their size."""

_AVERAGE_OVER = 500.0
_DIS = {"dis": "DIS medium", "dis_fast": "DIS fast", "dis_ultrafast": "DIS ultrafast"}


def moved_pictures(height: int, width: int, count: int, seed: int) -> list[np.ndarray]:
    """RGB pictures of a texture that a smooth flow of some pixels moves on from one to the next."""
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
    """A training step of the default network on a batch, as a call."""
    optimizer = optax.adam(1e-3)
    held = [FlowTrainState.create(PyramidFlow(seed=seed), optimizer, seed=seed)]
    pairs = [np.stack(moved_pictures(_ROWS, _COLUMNS, 2, seed + n)) for n in range(_BATCH)]
    samples = [{"clean": pair, "seen": pair} for pair in pairs]

    def step() -> float:
        held[0], numbers = flow_step(held[0], samples, optimizer, FlowLossSettings(), _AVERAGE_OVER)
        return numbers["loss"]

    return step


def flow_timings(height: int, width: int, repeats: int, seed: int) -> list[Timing]:
    """One way and both ways beside DIS, the fast and the fine pyramid, smoothed ones, along a video, and a step of training.

    The fast and the fine pyramid come as packaged; the weights of the others are untrained.

    All times are of whole calls, from pictures of bytes to flow on the host.
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
    taken = medians_ms(calls, repeats)
    size, pairs = f"{width}x{height}", len(pictures) - 1
    fast, dis = f"pyramid_fast, {size}, one way", ("DIS medium", taken["dis"])
    timings = [
        Timing(fast, taken["pyramid_fast"], shown, taken[name], packaged_compile_s["pyramid_fast"])
        for name, shown in _DIS.items()
    ]
    timings += [
        Timing(f"pyramid, {size}, one way", taken["pyramid"], *dis, compile_s, memory["forward"]),
        Timing(f"pyramid_fine, {size}, one way", taken["pyramid_fine"], *dis, packaged_compile_s["pyramid_fine"]),
    ]
    # Smoothing asks a flow for both of its ways.
    timings += [
        Timing(f"{name}, {size}, one way", taken[name], *dis, packaged_compile_s[name])
        for name in ("pyramid_fine+wls", "dis+wls")
    ]
    both = taken["pyramid along"] / pairs, "DIS medium, both ways", taken["dis along"] / pairs
    timings.append(Timing(f"pyramid, {size}, both ways, a frame of a video", *both))
    step = _step(seed)
    step_compile_s = first_call_s(step)
    taken = medians_ms({"step": step, "pyramid": calls["pyramid"]}, max(2, repeats // 3))
    what = f"training step, {_BATCH} pairs of {_COLUMNS}x{_ROWS}"
    peer = f"pyramid, {size}, one way"
    timings.append(Timing(what, taken["step"], peer, taken["pyramid"], step_compile_s, memory["step"]))
    return timings


def flow_memory(height: int, width: int, seed: int) -> dict[str, float]:
    """Largest resident memory, MiB, of a process of its own by the end of its first flow, and of a training step.

    It contains Python and XLA, which compiles; `idle` is the process before either.
    """
    code = f"from tagjax.benchmarks.flow_speed import _report_memory; _report_memory({height}, {width}, {seed})"
    return in_own_process(code, "The process whose memory is measured")


def _report_memory(height: int, width: int, seed: int) -> None:
    first, second = moved_pictures(height, width, 2, seed)
    jax.block_until_ready(jax.numpy.zeros(()))
    found = {"idle": peak_memory_mib()}
    NetworkFlow(PyramidFlow(seed=seed))(first, second)
    found["forward"] = peak_memory_mib()
    _step(seed)()
    found["step"] = peak_memory_mib()
    print(json.dumps(found))
