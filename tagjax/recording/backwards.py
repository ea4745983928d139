"""A recording played backwards, for a pass that begins at the end.

A tag's phase is the same whichever way time runs, so the reads keep theirs; a Doppler shift turns round.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..core.types import LazyArray
from .reads import TagReads
from .recording import Recording, Truth


class _Backwards:
    """Frames in the opposite order, read when indexed."""

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
                raise IndexError(f"Frames {index} of a recording played backwards; expected neighbouring ones.")
            stop = max(first, stop)
            return np.asarray(self._frames[last + 1 - stop : last + 1 - first])[::-1]
        frame = int(index)
        if not -len(self) <= frame <= last:
            raise IndexError(f"Frame {frame} of {len(self)}.")
        return np.asarray(self._frames[last - frame % len(self)])


def _turned_reads(reads: TagReads, first_ns: int, last_ns: int) -> TagReads:
    back = reads[::-1]
    return dataclasses.replace(
        back,
        time_ns=first_ns + last_ns - back.time_ns,
        doppler_hz=-back.doppler_hz,
        reader_time_ns=None if back.reader_time_ns is None else -back.reader_time_ns,
    )


def played_backwards(recording: Recording) -> Recording:
    """The recording with its last frame first, between the same two times. Of its truth the tags' ranges come along."""
    first_ns, last_ns = int(recording.time_ns[0]), int(recording.time_ns[-1])
    truth = recording.truth
    ranges = {} if truth is None else {epc: np.asarray(known)[::-1] for epc, known in truth.tag_range_m.items()}
    return dataclasses.replace(
        recording,
        colour=_Backwards(recording.colour),
        depth=_Backwards(recording.depth),
        time_ns=first_ns + last_ns - recording.time_ns[::-1],
        reads=_turned_reads(recording.reads, first_ns, last_ns),
        truth=Truth(tag_range_m=ranges) if ranges else None,
        clock=None,
        store=None,
        forwards=recording,
    )
