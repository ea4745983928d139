"""Time-reversed recordings, for the backward pass of offline smoothing.

A tag's phase depends on its distance only, so reads keep their phase; a Doppler shift changes its sign.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..core.types import LazyArray
from .reads import TagReads
from .recording import Recording, Truth


class _ReversedFrames:
    """Frames in reverse order, read when indexed."""

    def __init__(self, frames: LazyArray):
        self._frames = frames
        self.shape: tuple[int, ...] = tuple(frames.shape)
        self.dtype = np.dtype(frames.dtype)

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        return np.asarray(self[:], dtype)

    def __getitem__(self, index: Any, /) -> np.ndarray:
        last = len(self) - 1
        if isinstance(index, slice):
            first, stop, step = index.indices(len(self))
            if step != 1:
                raise IndexError(f"Frames {index} of a time-reversed recording; expected a slice of step 1.")
            stop = max(first, stop)
            return np.asarray(self._frames[last + 1 - stop : last + 1 - first])[::-1]
        frame = int(index)
        if not -len(self) <= frame <= last:
            raise IndexError(f"Frame {frame} of {len(self)}.")
        return np.asarray(self._frames[last - frame % len(self)])


def _reversed_reads(reads: TagReads, first_ns: int, last_ns: int) -> TagReads:
    reverse = reads[::-1]
    return dataclasses.replace(
        reverse,
        time_ns=first_ns + last_ns - reverse.time_ns,
        doppler_hz=-reverse.doppler_hz,
        reader_time_ns=None if reverse.reader_time_ns is None else -reverse.reader_time_ns,
    )


def time_reversed(recording: Recording) -> Recording:
    """The recording with its last frame first, between the same two times. Of the truth only the tags' ranges are kept."""
    first_ns, last_ns = int(recording.time_ns[0]), int(recording.time_ns[-1])
    truth = recording.truth
    ranges = {} if truth is None else {epc: np.asarray(known)[::-1] for epc, known in truth.tag_range_m.items()}
    return dataclasses.replace(
        recording,
        colour=_ReversedFrames(recording.colour),
        depth=_ReversedFrames(recording.depth),
        time_ns=first_ns + last_ns - recording.time_ns[::-1],
        reads=_reversed_reads(recording.reads, first_ns, last_ns),
        truth=Truth(tag_range_m=ranges) if ranges else None,
        clock=None,
        store=None,
        second=None,
        reversed_from=recording,
    )
