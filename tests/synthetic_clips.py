"""A tiny scene in closed form, a clip of it, a small tracer and a clip source: for the training and evaluation tests.

Two square objects before a wall move towards and away from the camera without moving in the picture, so that the
flow is zero and every distance is known exactly. A tag sits on each.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.radio.reads import PhaseReads, RadioWindow
from tagjax.recording import Intrinsics, Recording, TagReads, Truth
from tagjax.recording.store import save_recording
from tagjax.tracing.tracer import AbstractTracer, Camera, Frame, Trace

HEIGHT, WIDTH, WINDOW, MAX_READS = 24, 32, 5, 8
BOXES = {1: (4, 5, 11, 16), 2: (18, 6, 27, 18)}  # inclusive x0 y0 x1 y1
EPCS = {"tag-a": 1, "tag-b": 2}
CARRIER_HZ = 915e6


class SyntheticClip(eqx.Module):
    camera: Camera
    frames: Frame


def offset_m(label: int, time_s: np.ndarray, seed: int = 0) -> np.ndarray:
    """How far an object is from its mean depth."""
    phase = 1.3 * seed + label
    return 0.25 * np.sin((1.1 + 0.8 * label) * time_s + phase)


def recording(num_frames: int = 40, *, seed: int = 0, rate_hz: float = 10.0, name: str = "synthetic") -> Recording:
    """The scene with 60 reads a second and tag, without noise."""
    time_s = np.arange(num_frames) / rate_hz
    depth = np.full((num_frames, HEIGHT, WIDTH), 4.0, np.float32)
    labels = np.zeros((num_frames, HEIGHT, WIDTH), np.uint8)
    for label, (x0, y0, x1, y1) in BOXES.items():
        depth[:, y0 : y1 + 1, x0 : x1 + 1] = (2.0 + offset_m(label, time_s, seed))[:, None, None]
        labels[:, y0 : y1 + 1, x0 : x1 + 1] = label
    read_s = np.arange(0, time_s[-1], 1 / 60)
    rows = []
    for number, (epc, label) in enumerate(EPCS.items()):
        range_m = 2.0 + offset_m(label, read_s, seed)
        phase = (4 * np.pi * CARRIER_HZ / SPEED_OF_LIGHT_M_S * range_m + number) % (2 * np.pi)
        rows += [(epc, int((t + 1e-3 * number) * 1e9), p) for t, p in zip(read_s, phase, strict=True)]
    rows.sort(key=lambda row: row[1])
    count = len(rows)
    reads = TagReads(
        epc=np.array([row[0] for row in rows]),
        time_ns=np.array([row[1] for row in rows], np.int64),
        antenna=np.ones(count, np.int16),
        carrier_hz=np.full(count, CARRIER_HZ),
        phase_rad=np.array([row[2] for row in rows]),
        rssi_dbm=np.full(count, -55, np.float32),
        doppler_hz=np.full(count, np.nan, np.float32),
    )
    truth = Truth(
        labels=labels,
        tag_to_label=EPCS,
        tag_range_m={epc: 2.0 + offset_m(label, time_s, seed) for epc, label in EPCS.items()},
    )
    return Recording(
        colour=np.full((num_frames, HEIGHT, WIDTH, 3), 90, np.uint8),
        depth=depth,
        time_ns=(time_s * 1e9).astype(np.int64),
        intrinsics=Intrinsics(1e4, 1e4, 15.5, 11.5, WIDTH, HEIGHT),  # so long a lens that range is depth
        reads=reads,
        truth=truth,
        name=name,
    )


def enlarged(recording: Recording, scale: int) -> Recording:
    """The same scene with each pixel repeated, for stages that need a picture of some size."""
    truth = recording.truth
    assert truth is not None
    grow = lambda images: np.repeat(np.repeat(np.asarray(images), scale, axis=1), scale, axis=2)  # noqa: E731
    lens = recording.intrinsics
    return dataclasses.replace(
        recording,
        colour=grow(recording.colour[:]),
        depth=grow(recording.depth[:]),
        intrinsics=Intrinsics(
            1e4, 1e4, lens.cx_px * scale, lens.cy_px * scale, lens.width * scale, lens.height * scale
        ),
        truth=dataclasses.replace(truth, labels=grow(truth.labels[:] if truth.labels is not None else 0)),
    )


def load(recording: Recording, start: int, stop: int, *, epcs: Sequence[str] | None = None) -> SyntheticClip:
    """A clip at full resolution; the radio window is the true one."""
    names = recording.resolve_epcs(epcs)
    time_s = recording.frame_time_s()
    frames = np.arange(start, stop)
    truth = recording.truth
    assert truth is not None
    ranges = np.stack([truth.tag_range_m[epc] for epc in names], axis=1)
    window = np.clip(frames[:, None] + np.arange(-WINDOW + 1, 1), 0, None)
    relative = ranges[window] - ranges[window[:, :1]]
    shape = (len(frames), len(names), 1, MAX_READS)
    read_time, phase, valid = np.zeros(shape), np.zeros(shape), np.zeros(shape, bool)
    for tag, epc in enumerate(names):
        own = recording.reads.select(epc)
        own_s = (own.time_ns - recording.time_ns[0]) * 1e-9
        for row, frame in enumerate(frames):
            inside = np.flatnonzero((own_s <= time_s[frame]) & (own_s >= time_s[window[row, 0]]))[-MAX_READS:]
            read_time[row, tag, 0, : len(inside)] = own_s[inside]
            phase[row, tag, 0, : len(inside)] = own.phase_rad[inside]
            valid[row, tag, 0, : len(inside)] = True
    x, y = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    lens = recording.intrinsics
    rays = np.stack([(x - lens.cx_px) / lens.fx_px, (y - lens.cy_px) / lens.fy_px, np.ones_like(x)], axis=-1)
    single = lambda a: jnp.asarray(a, jnp.float32)  # noqa: E731
    return SyntheticClip(
        Camera(single(rays), jnp.zeros((1, 3))),
        Frame(
            time_s=single(time_s[frames]),
            depth_m=single(recording.depth_metres(slice(start, stop))),
            backward_px=jnp.zeros((len(frames), HEIGHT, WIDTH, 2)),
            forward_px=jnp.zeros((len(frames), HEIGHT, WIDTH, 2)),
            radio=RadioWindow(
                single(np.moveaxis(relative, 1, 2)[:, :, None]), jnp.full((len(frames), len(names), 1, WINDOW), 0.005)
            ),
            reads=PhaseReads(
                single(read_time),
                single(phase),
                jnp.full(shape, CARRIER_HZ, jnp.float32),
                jnp.full(shape, 0.1),
                jnp.zeros(shape, jnp.int32),
                jnp.asarray(valid),
            ),
        ),
    )


class SmallState(eqx.Module):
    distance_m: Float[Array, "height width window"]
    misfit: Float[Array, "tag height width"]


class SmallTracer(AbstractTracer):
    """Forgetting sum of squared misfits between a still pixel's distance and the tag's, cut softly."""

    log_scale: Float[Array, ""]
    level: Float[Array, ""]

    def __init__(self, scale: float = 300.0, level: float = 3.0):
        self.log_scale = jnp.log(jnp.asarray(scale, jnp.float32))
        self.level = jnp.asarray(level, jnp.float32)

    def init(self, camera: Camera, frame: Frame) -> SmallState:
        num_tags, _, window = frame.radio.relative_m.shape
        height, width = frame.depth_m.shape
        return SmallState(
            jnp.broadcast_to(frame.depth_m[..., None], (height, width, window)), jnp.zeros((num_tags, height, width))
        )

    def step(self, camera: Camera, state: SmallState, frame: Frame) -> tuple[SmallState, Trace]:
        distance = jnp.concatenate([state.distance_m[..., 1:], frame.depth_m[..., None]], axis=-1)
        rho = distance - distance[..., :1]
        gap = jnp.sum(jnp.square(rho[None] - frame.radio.relative_m[:, 0, None, None]), axis=-1)
        misfit = 0.9 * state.misfit + gap
        mask = jax.nn.sigmoid(self.level - jnp.exp(self.log_scale) * misfit)
        total = jnp.sum(mask, axis=(1, 2))
        change = distance[..., -1] - distance[..., -2]
        x = jnp.arange(mask.shape[2], dtype=jnp.float32)
        y = jnp.arange(mask.shape[1], dtype=jnp.float32)
        column, row = jnp.max(mask, axis=1) > 0.5, jnp.max(mask, axis=2) > 0.5
        edge = lambda on, at, low: (  # noqa: E731
            jnp.min(jnp.where(on, at[None], 1e3), axis=1) if low else jnp.max(jnp.where(on, at[None], -1e3), axis=1)
        )
        box = jnp.stack(
            [edge(column, x, True), edge(row, y, True), edge(column, x, False), edge(row, y, False)], axis=-1
        )
        num_tags = mask.shape[0]
        return SmallState(distance, misfit), Trace(
            mask=mask,
            box_px=box,
            centre_px=0.5 * (box[:, :2] + box[:, 2:]),
            centre_m=jnp.zeros((num_tags, 3)),
            step_m=(jnp.sum(mask * change[None], axis=(1, 2)) / (total + 1e-6))[:, None],
            confidence=jnp.max(mask, axis=(1, 2)),
            detected=jnp.any(mask > 0.5, axis=(1, 2)),
        )

    def finish(self, state: SmallState) -> SmallState:
        return state


class ClipCycle:
    """Clips of some recordings, one after the other, with a place that can be kept."""

    def __init__(self, recordings: Sequence[Recording], length: int = 16):
        self._recordings, self._length, self._place = list(recordings), length, 0

    def __iter__(self) -> ClipCycle:
        return self

    def __next__(self) -> SyntheticClip:
        chosen = self._recordings[self._place % len(self._recordings)]
        start = (7 * self._place) % (chosen.num_frames - self._length + 1)
        self._place += 1
        return load(chosen, start, start + self._length)

    def get_state(self) -> Any:
        return {"place": self._place}

    def set_state(self, state: Any) -> None:
        self._place = int(state["place"])


def stored(folder: Path, num_frames: int) -> list[str]:
    """Paths of two enlarged recordings, written into a folder."""
    paths = [str(folder / f"scene{seed}.zarr") for seed in range(2)]
    for seed, path in enumerate(paths):
        save_recording(enlarged(recording(num_frames, seed=seed, name=f"scene{seed}"), 4), path)
    return paths
