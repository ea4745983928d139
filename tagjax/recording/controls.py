"""Controls: recordings whose reads cannot agree with what is seen. A tracer that claims a tag in them claims it by chance."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import numpy as np

from ..core.errors import RecordingError
from .reads import TagReads
from .recording import Recording

Control = Literal["foreign", "shifted"]


def with_control(recordings: Sequence[Recording], control: Control | None) -> list[Recording]:
    """The recordings with reads that do not belong to what is seen; unchanged where `control` is None.

    - `foreign`: each recording has the reads of the next one in the list (the last one those of the first), from the start on.
      Reads of antennas that it lacks, and reads after its end, are left out.
    - `shifted`: each read is half a recording later; those that then lie behind the end are carried on from the start.

    No tag has a true object then: every detection counts as a false one. Raises `RecordingError` for `foreign` reads with
    fewer than two recordings.
    """
    if control is None:
        return list(recordings)
    if control == "shifted":
        return [_with_strange_reads(one, shifted_reads(one)) for one in recordings]
    if len(recordings) < 2:
        raise RecordingError(
            f"control=foreign: found {len(recordings)} recording; expected at least 2, whose reads change places."
        )
    others = [*recordings[1:], recordings[0]]
    return [_with_strange_reads(one, foreign_reads(one, other)) for one, other in zip(recordings, others, strict=True)]


def shifted_reads(recording: Recording) -> TagReads:
    """The reads in a circle of the recording's length, turned by half of it."""
    first, length = int(recording.time_ns[0]), int(recording.time_ns[-1] - recording.time_ns[0]) + 1
    inside = _inside(recording.reads, first, length)
    return _ordered(dataclasses.replace(inside, time_ns=first + (inside.time_ns - first + length // 2) % length))


def foreign_reads(recording: Recording, other: Recording) -> TagReads:
    """The reads of `other` at the recording's times, by antennas that it has."""
    first, length = int(recording.time_ns[0]), int(recording.time_ns[-1] - recording.time_ns[0]) + 1
    reads = other.reads[other.reads.antenna <= len(recording.antennas_m)]
    moved = dataclasses.replace(reads, time_ns=reads.time_ns - int(other.time_ns[0]) + first)
    return _ordered(_inside(moved, first, length))


def _inside(reads: TagReads, first_ns: int, length_ns: int) -> TagReads:
    return reads[(reads.time_ns >= first_ns) & (reads.time_ns < first_ns + length_ns)]


def _ordered(reads: TagReads) -> TagReads:
    """In order of time; without clocks of reader and host, which no longer mean anything."""
    reads = reads[np.argsort(reads.time_ns, kind="stable")]
    return dataclasses.replace(reads, reader_time_ns=None, arrival_time_ns=None)


def _with_strange_reads(recording: Recording, reads: TagReads) -> Recording:
    truth = recording.truth
    if truth is not None:
        nobody = {
            name: {} for name in ("tag_to_label", "tag_range_m", "tag_position_m", "line_of_sight", "carrier_box_px")
        }
        truth = dataclasses.replace(truth, **nobody)
    return dataclasses.replace(recording, reads=reads, truth=truth, clock=None)
