"""Optical flow between neighbouring frames, computed once and kept with the recording."""

from __future__ import annotations

import contextlib
import os
import shutil
import uuid
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from rich.progress import track
from zarr.storage import LocalStore

from ..core.prepared import remove_abandoned
from ..recording import Recording, RecordingError
from ..recording.store import StoredFrames, create_array
from .named import flow_key, make_flow, settled_along
from .opencv import FlowFunction

_FOLDER = "cache/flow"
_VERSION = 3
"""To be raised when the same name gives another flow: older caches are then computed again."""

_WAYS = ("forward", "backward")

TRUTH = "truth"
"""The name of a simulated recording's exact flow: what a tracer would do if no flow were to blame."""


def pair_flow(recording: Recording, first: int, last: int, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Flow between frames t - 1 and t for t = first .. last - 1: (forward on t - 1, backward on t).

    Both float32 (frames, height, width, 2), pixels of the full picture; zero where there is no frame before, and where
    rest explains the pictures as well (`settled`). `method` is a flow that `make_flow` knows, or `truth`: the exact flow
    that a recording was simulated with, zero where it is not known. What is computed is computed for the whole recording
    on the first call and kept in half precision in its folder, under `cache/flow/<key>/` (`flow_key`: other weights of a
    network have another), where that can be written; otherwise only for the frames asked for.
    """
    if first < 0 or last > recording.num_frames or first >= last:
        raise ValueError(f"Frames {first} to {last} asked for; {recording.name} has {recording.num_frames}.")
    if recording.forwards is not None:
        return _backwards(recording.forwards, first, last, method)
    if method == TRUTH:
        return _exact(recording, first, last)
    key = flow_key(method)
    folder = _folder(recording, key)
    if folder is None:
        pairs = list(_pairs(recording, first, last, make_flow(method)))
        return np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])
    held = _read(recording, folder, key, first, last)
    if held is None:
        _clear(folder)
        _fill(recording, folder, key, make_flow(method))
        held = _read(recording, folder, key, first, last)
    if held is None:
        raise RecordingError(
            f"{folder}: the flow was written but cannot be read back. Remove the folder and look to the disk."
        )
    return held


def _backwards(recording: Recording, first: int, last: int, method: str) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` of the recording played backwards: the same pairs, with the two ways exchanged."""
    count = recording.num_frames

    def exchanged(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        there, back = pair_flow(recording, count + 1 - stop, count + 1 - start, method)
        return back[::-1], there[::-1]

    return _after_none(recording, first, last, exchanged)


def _exact(recording: Recording, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` of the truth. Raises `RecordingError` for a recording whose flow nobody knows."""
    truth = recording.truth
    ahead, back = (truth.flow_px, truth.backward_flow_px) if truth is not None else (None, None)
    if ahead is None or back is None:
        raise RecordingError(
            f"{recording.name}: flow=truth, but the recording does not hold its true flow both ways. Simulate it with "
            "`capture: {flow: true}`, as conf/suite/corpus.yaml does, or name a flow that is computed (dis)."
        )
    return _after_none(
        recording,
        first,
        last,
        lambda start, stop: (np.nan_to_num(ahead[start - 1 : stop - 1]), np.nan_to_num(back[start:stop])),
    )


def _after_none(
    recording: Recording, first: int, last: int, ways: Callable[[int, int], tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` by a function that knows it from frame 1 on; zero for frame 0, which has none before it."""
    forward, backward = (np.zeros((last - first, *recording.colour.shape[1:3], 2), np.float32) for _ in _WAYS)
    start = max(first, 1)
    if start < last:
        forward[start - first :], backward[start - first :] = ways(start, last)
    return forward, backward


def _folder(recording: Recording, key: str) -> Path | None:
    """Where the flow of a recording is kept; None for a recording without a folder, or with other pictures in it."""
    root, colour = recording.store, recording.colour
    if not isinstance(root, zarr.Group) or not isinstance(root.store, LocalStore):
        return None
    # Pictures that were replaced after opening have a flow of their own.
    if not isinstance(colour, StoredFrames) or colour.array.store_path != root.store_path / "colour":
        return None
    return Path(root.store.root) / root.path / _FOLDER / key


def _told(recording: Recording, key: str) -> dict[str, Any]:
    """The attributes of a complete cache. They are written last, and a cache with others is none."""
    return {"complete": True, "version": _VERSION, "method": key, "shape": [*recording.colour.shape[:3], 2]}


def _read(recording: Recording, folder: Path, key: str, first: int, last: int):
    """The flow of some frames from the cache; None if there is none, or not all of it."""
    if not folder.is_dir():
        return None
    told = _told(recording, key)
    try:
        group = zarr.open_group(str(folder), mode="r", zarr_format=3)
        if dict(group.attrs) != told:
            return None
        frames = []
        for way in _WAYS:
            stored = StoredFrames(group[way], str(folder), way)  # type: ignore[arg-type]
            if list(stored.shape) != told["shape"]:
                return None
            frames.append(stored[first:last].astype(np.float32))
    except MemoryError:
        raise
    # A cache can be computed again, so any damage to it is as good as its absence.
    except Exception:
        return None
    return frames[0], frames[1]


def _pairs(recording: Recording, first: int, last: int, flow: FlowFunction):
    start = max(first - 1, 0)
    if first == 0:
        zero = np.zeros((*recording.colour.shape[1:3], 2), np.float32)
        yield zero, zero
    yield from settled_along(flow, (np.asarray(recording.colour[t]) for t in range(start, last)))


def _fill(recording: Recording, folder: Path, key: str, flow: FlowFunction) -> None:
    """Write the flow of every frame.

    Each process fills a folder of its own, which takes the cache's name when it is whole: whoever comes second finds
    the name taken and drops its own copy. A process that is killed leaves a partial folder that is never read.
    """
    partial = folder.with_name(f".{key}.{uuid.uuid4().hex}.partial")
    told = _told(recording, key)
    shape = (*recording.colour.shape[:3], 2)
    try:
        group = zarr.open_group(str(partial), mode="w", zarr_format=3)
        targets = [create_array(group, way, shape, np.float16, per_frame=True) for way in _WAYS]
        pairs = _pairs(recording, 0, shape[0], flow)
        for t, pair in enumerate(
            track(pairs, description=f"{recording.name}: {key} flow", total=shape[0], transient=True)
        ):
            for target, field in zip(targets, pair, strict=True):
                target[t] = field.astype(np.float16)
        group.attrs.update(told)
        # The name is taken if another process was faster: its copy is as good.
        with contextlib.suppress(OSError):
            os.rename(partial, folder)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _clear(folder: Path) -> None:
    """Take away a cache that cannot be used, and what killed processes left beside it."""
    if folder.exists():
        aside = folder.with_name(f".{folder.name}.{uuid.uuid4().hex}.partial")
        # Moved first, so that nobody reads it while it goes; another process may have moved it already.
        with contextlib.suppress(FileNotFoundError):
            os.rename(folder, aside)
        shutil.rmtree(aside, ignore_errors=True)
    remove_abandoned(folder.parent.glob(".*.partial"))
