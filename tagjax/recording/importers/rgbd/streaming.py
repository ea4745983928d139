"""An RGB-D source written to the store frame by frame: memory does not grow with the recording."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import zarr

from ....core.errors import RecordingError
from ....core.files import atomic_path
from ....core.progress import tracked
from ...reads import TagReads
from ...recording import Recording
from ...store import write_all_but_frames
from ...stored_frames import StoredFrames, create_array
from .pairing import Tally, pairs
from .source import RgbdSource
from .views import Views

_GROW = 256  # frames by which an array grows


class _Growing:
    """A stored array of frames whose number is not known yet."""

    def __init__(self, root: zarr.Group, name: str, frame: np.ndarray):
        self.array = create_array(root, name, (0, *frame.shape), frame.dtype, per_frame=True)
        self.frame_shape, self.num_frames = frame.shape, 0

    def append(self, frame: np.ndarray) -> None:
        if self.num_frames == self.array.shape[0]:
            self.array.resize((self.num_frames + _GROW, *self.frame_shape))
        self.array[self.num_frames] = frame
        self.num_frames += 1

    def end(self) -> None:
        self.array.resize((self.num_frames, *self.frame_shape))


def stream_recording(
    source: RgbdSource,
    out: Path,
    complete: Callable[[Recording], Recording],
    *,
    start_ns: int | None = None,
    max_gap_s: float | None = None,
    progress: bool = False,
) -> Recording:
    """Write a source as a recording at `out`, which appears whole or not at all.

    `complete` adds to the video what else belongs to the recording (reads, antennas) and checks it, after the last frame.
    With `start_ns` (or the source's) all times are moved so that the first frame is there. Returns what `complete` returned. Raises
    `RecordingError` for a path that exists, for sources that cannot be used, and whatever `complete` raises.
    """
    if out.exists():
        raise RecordingError(f"{out} exists. Remove it or choose another name.")
    with atomic_path(out) as partial:
        root = zarr.open_group(str(partial), mode="w", zarr_format=3)
        video = _write_frames(source, root, source.max_gap_s if max_gap_s is None else max_gap_s, progress)
        start_ns = source.start_ns if start_ns is None else start_ns
        if start_ns is not None:
            video = dataclasses.replace(video, time_ns=video.time_ns - video.time_ns[0] + start_ns)
        recording = complete(video)
        write_all_but_frames(recording, root)
    return recording


def _write_frames(source: RgbdSource, root: zarr.Group, max_gap_s: float, progress: bool) -> Recording:
    """Colour and depth of all pairs; the recording with them, which has no reads yet."""
    views, tally, times = Views(source.rig), Tally(), []
    arrays: tuple[_Growing, _Growing] | None = None
    for colour, depth in tracked(pairs(source.pictures(), max_gap_s, tally), source.name, shown=progress):
        frames = (views.colour(colour), views.depth(depth))
        if arrays is None:
            arrays = (_Growing(root, "colour", frames[0]), _Growing(root, "depth", frames[1]))
        if frames[1].dtype != arrays[1].array.dtype:
            raise RecordingError(
                f"{depth.where}: depth is stored in another type than in the first picture; expected one type."
            )
        for array, frame in zip(arrays, frames, strict=True):
            array.append(frame)
        times.append(colour.time_ns)
    tally.check(source.name, max_gap_s)
    assert arrays is not None
    for array in arrays:
        array.end()
    return Recording(
        colour=StoredFrames(arrays[0].array, source.name, "colour"),
        depth=StoredFrames(arrays[1].array, source.name, "depth"),
        time_ns=np.array(times, np.int64),
        intrinsics=views.intrinsics,
        reads=TagReads.empty(),
        depth_kind=views.depth_kind,
        name=source.name,
        source=f"{source.description}; {tally.line()}",
    )
