"""Optical flow between neighbouring frames, computed once and kept with the recording."""

from __future__ import annotations

import contextlib

import numpy as np
from rich.progress import track

from ..flow.opencv import make_flow, to_gray
from ..recording import Recording
from .store import write_frames

_FOLDER = "cache/flow"


def pair_flow(recording: Recording, first: int, last: int, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Flow between frames t - 1 and t for t = first .. last - 1: (forward on t - 1, backward on t).

    Both float32 (frames, height, width, 2), pixels of the full picture; zero where there is no frame before. The flow
    of the whole recording is computed on the first call and kept: in its Zarr group where that can be written, under
    `cache/flow/<method>/`, in half precision; otherwise only the frames asked for are computed.
    """
    if first < 0 or last > recording.num_frames or first >= last:
        raise ValueError(f"Frames {first} to {last} asked for; {recording.name} has {recording.num_frames}.")
    if recording.store is not None:
        forward, backward = (f"{_FOLDER}/{method}/{way}" for way in ("forward", "backward"))
        if backward not in recording.store:
            _fill(recording, method, forward, backward)
        return tuple(np.asarray(recording.store[name][first:last], np.float32) for name in (forward, backward))  # type: ignore[return-value]
    flow = make_flow(method)
    pairs = [_pair(recording, t, flow) for t in range(first, last)]
    return np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])


def _pair(recording: Recording, t: int, flow) -> tuple[np.ndarray, np.ndarray]:
    if t == 0:
        zero = np.zeros((*recording.image_shape, 2), np.float32)
        return zero, zero
    before, now = (to_gray(np.asarray(recording.colour[frame])) for frame in (t - 1, t))
    return flow(before, now), flow(now, before)


def _fill(recording: Recording, method: str, forward: str, backward: str) -> None:
    flow = make_flow(method)
    shape = (recording.num_frames, *recording.image_shape, 2)
    held: list[np.ndarray] = []

    def pairs():
        for t in track(range(recording.num_frames), description=f"{recording.name}: {method} flow", transient=True):
            ahead, back = _pair(recording, t, flow)
            held.append(back.astype(np.float16))
            yield ahead.astype(np.float16)

    # `backward` is written last: while it is missing the cache counts as empty.
    try:
        write_frames(recording.store, forward, pairs(), shape, np.float16)
        write_frames(recording.store, backward, iter(held), shape, np.float16)
    except BaseException:
        with contextlib.suppress(KeyError):
            del recording.store[backward]
        raise
