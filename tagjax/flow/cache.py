"""Optical flow between consecutive frames, computed once and stored in the recording's folder."""

from __future__ import annotations

import contextlib
import errno
import shutil
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.storage import LocalStore

from ..core.array_cache import compute_once
from ..core.files import WriteError
from ..core.progress import tracked
from ..recording import Recording, RecordingError
from ..recording.stored_frames import StoredFrames, create_array
from .opencv import FlowFunction
from .registry import flow_key, make_flow, zero_stationary_along

_FOLDER = "cache/flow"
_VERSION = 3
"""To be raised when the same name gives another flow: older caches are then computed again."""

_DIRECTIONS = ("forward", "backward")

_ABANDONED_S = 3600.0
"""A partial cache of another flow without a change for so long belongs to a process that was killed."""

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""Computing the flow of a whole recording again and again is no substitute for space."""

TRUTH = "truth"
"""The name of a simulated recording's exact flow, as an upper limit for what a tracer can do with better flow."""


def pair_flow(recording: Recording, first: int, last: int, method: str) -> tuple[np.ndarray, np.ndarray]:
    """Flow between frames t - 1 and t for t = first .. last - 1: (forward on t - 1, backward on t).

    Both float32 (frames, height, width, 2), pixels of the full image; zero for frame 0, which has no frame before it,
    and where the images agree as well without motion (`zero_stationary`). `method` is a name that `make_flow` takes, or
    `truth`: the exact flow that a recording was simulated with, zero where it is not known. The first call computes the
    flow of the whole recording and stores it as float16 in the recording's folder, under `cache/flow/<key>/`
    (`flow_key`: other weights of a network have another key), if the folder is writable; otherwise only the requested
    frames are computed. Raises `ValueError` for frames outside the recording and unknown names, `RecordingError` for
    `truth` of a recording without true flow.
    """
    if first < 0 or last > recording.num_frames or first >= last:
        raise ValueError(
            f"Found frames {first} to {last} of {recording.name}; expected a part of its {recording.num_frames} frames."
        )
    if recording.reversed_from is not None:
        return _time_reversed_flow(recording.reversed_from, first, last, method)
    if method == TRUTH:
        return _true_flow(recording, first, last)
    key = flow_key(method)
    folder = _folder(recording, key)
    if folder is None:
        return _computed(recording, first, last, method)
    stored = _read(recording, folder, key, first, last)
    if stored is None:
        _remove_abandoned(folder.parent)
        try:
            compute_once(
                folder,
                lambda path: _compute(recording, path, key, make_flow(method)),
                is_complete=lambda path: _read(recording, path, key, first, last) is not None,
            )
        except WriteError as error:
            if error.errno in _FULL:
                raise
            return _computed(recording, first, last, method)
        stored = _read(recording, folder, key, first, last)
    if stored is None:
        raise RecordingError(
            f"{folder}: the flow was written but cannot be read back. Remove the folder and check the disk."
        )
    return stored


def _computed(recording: Recording, first: int, last: int, method: str) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` without the stored flow."""
    pairs = list(_pairs(recording, first, last, make_flow(method)))
    return np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])


def _time_reversed_flow(recording: Recording, first: int, last: int, method: str) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` of a time-reversed recording, from the original: the same pairs, forward and backward exchanged."""
    count = recording.num_frames

    def exchanged(start: int, stop: int) -> tuple[np.ndarray, np.ndarray]:
        forward, backward = pair_flow(recording, count + 1 - stop, count + 1 - start, method)
        return backward[::-1], forward[::-1]

    return _with_first_frame(recording, first, last, exchanged)


def _true_flow(recording: Recording, first: int, last: int) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` of the truth. Raises `RecordingError` for a recording without true flow."""
    truth = recording.truth
    forward, backward = (truth.flow_px, truth.backward_flow_px) if truth is not None else (None, None)
    if forward is None or backward is None:
        raise RecordingError(
            f"{recording.name}: flow=truth, but the recording has no true flow forward and backward. Simulate it with "
            "`capture: {flow: true}`, as conf/suite/corpus.yaml does, or name a flow that is computed (dis)."
        )
    return _with_first_frame(
        recording,
        first,
        last,
        lambda start, stop: (np.nan_to_num(forward[start - 1 : stop - 1]), np.nan_to_num(backward[start:stop])),
    )


def _with_first_frame(
    recording: Recording, first: int, last: int, flow_of: Callable[[int, int], tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """`pair_flow` by a function that is defined from frame 1 on; zero for frame 0, which has no frame before it."""
    forward, backward = (np.zeros((last - first, *recording.colour.shape[1:3], 2), np.float32) for _ in _DIRECTIONS)
    start = max(first, 1)
    if start < last:
        forward[start - first :], backward[start - first :] = flow_of(start, last)
    return forward, backward


def _folder(recording: Recording, key: str) -> Path | None:
    """The folder of a recording's stored flow; None for a recording that has no folder or other images than its folder.

    None also where a link leads out of the recording's folder: a recording from elsewhere could otherwise write anywhere.
    """
    root, colour = recording.store, recording.colour
    if not isinstance(root, zarr.Group) or not isinstance(root.store, LocalStore):
        return None
    # Images that were replaced after opening have another flow than those of the folder.
    if not isinstance(colour, StoredFrames) or colour.array.store_path != root.store_path / "colour":
        return None
    home = Path(root.store.root) / root.path
    folder = home / _FOLDER / key
    try:
        return folder if folder.resolve().is_relative_to(home.resolve()) else None
    except (OSError, RuntimeError):  # links in a circle
        return None


def _attributes(recording: Recording, key: str) -> dict[str, Any]:
    """The attributes of a complete cache. They are written last; a cache with other attributes is not used."""
    return {"complete": True, "version": _VERSION, "method": key, "shape": [*recording.colour.shape[:3], 2]}


def _read(recording: Recording, folder: Path, key: str, first: int, last: int) -> tuple[np.ndarray, np.ndarray] | None:
    """The stored flow of some frames; None if it is missing, damaged or of another version."""
    if not folder.is_dir():
        return None
    attributes = _attributes(recording, key)
    try:
        group = zarr.open_group(str(folder), mode="r", zarr_format=3)
        if dict(group.attrs) != attributes:
            return None
        frames = []
        for direction in _DIRECTIONS:
            stored = StoredFrames(group[direction], str(folder), direction)  # type: ignore[arg-type]
            if list(stored.shape) != attributes["shape"]:
                return None
            frames.append(stored[first:last].astype(np.float32))
    except MemoryError:
        raise
    # The flow can be computed again, so any damage counts as absence.
    except Exception:
        return None
    return frames[0], frames[1]


def _pairs(recording: Recording, first: int, last: int, flow: FlowFunction) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    start = max(first - 1, 0)
    if first == 0:
        zero = np.zeros((*recording.colour.shape[1:3], 2), np.float32)
        yield zero, zero
    yield from zero_stationary_along(flow, (np.asarray(recording.colour[t]) for t in range(start, last)))


def _compute(recording: Recording, path: Path, key: str, flow: FlowFunction) -> None:
    """Write the flow of every frame, and the attributes last."""
    shape = (*recording.colour.shape[:3], 2)
    group = zarr.open_group(str(path), mode="w", zarr_format=3)
    targets = [create_array(group, direction, shape, np.float16, per_frame=True) for direction in _DIRECTIONS]
    pairs = _pairs(recording, 0, shape[0], flow)
    for t, pair in enumerate(tracked(pairs, f"{recording.name}: {key} flow", shape[0])):
        for target, flow_px in zip(targets, pair, strict=True):
            target[t] = flow_px.astype(np.float16)
    group.attrs.update(_attributes(recording, key))


def _remove_abandoned(folder: Path) -> None:
    """Remove partial caches, of whatever flow, that have not changed for an hour."""
    for partial in folder.glob(".*.partial"):
        with contextlib.suppress(OSError):  # it is complete by now, and has been renamed
            newest = max(path.stat().st_mtime for path in (partial, *partial.glob("**/c")))
            if time.time() - newest > _ABANDONED_S:
                shutil.rmtree(partial, ignore_errors=True)
