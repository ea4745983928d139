"""What a tag's tracing came to at each frame, and where box IoU was lost."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tracing.status import Status


@dataclasses.dataclass(frozen=True)
class State:
    """A state of a tag at a frame: its name, what it means, its colour's class, and the height of its bar, 0 to 1."""

    name: str
    meaning: str
    style: str
    height: float


IDENTIFIED = State("identified", "detected on the right object", "identified", 1.0)
DETECTED = State("detected", "detected; the truth is not known", "detected", 1.0)
WRONG = State("wrong object", "detected on another object or the background", "wrong", 0.75)
OCCLUDED = State("occluded", "the body that carries the tag is out of view", "occluded", 0.5)
STATIONARY = State("stationary", "the reads are those of a tag that stays in place", "stationary", 0.35)
NOT_READ = State("not read", "few reads of late, or none", "unread", 0.2)
LOST = State("not found", "the reads fit no body in view, or no reason is given", "lost", 0.1)

STATES = (IDENTIFIED, DETECTED, WRONG, OCCLUDED, STATIONARY, NOT_READ, LOST)
"""From the best to the worst; each differs from the others by colour and by height."""

_OF_STATUS = {
    Status.OCCLUDED.word: OCCLUDED,
    Status.STATIONARY.word: STATIONARY,
    Status.NOT_READ.word: NOT_READ,
}


@dataclasses.dataclass(frozen=True)
class TagFrames:
    """A tag's rows of frames.csv of one tracer and recording."""

    epc: str
    label: int  # 0: its object has no label
    frame: Int[np.ndarray, " time"]
    time_s: Float[np.ndarray, " time"]
    detected: Bool[np.ndarray, " time"]
    status: tuple[str, ...]
    identified: Int[np.ndarray, " time"]
    valid: Bool[np.ndarray, " time"]  # the frame counts
    iou: Float[np.ndarray, " time"]  # 0 without a detection
    cle_px: Float[np.ndarray, " time"]  # NaN without a detection
    confidence: Float[np.ndarray, " time"]

    def states(self) -> Int[np.ndarray, " time"]:
        """The number of each frame's state in `STATES`."""
        return np.array([STATES.index(self._state(number)) for number in range(len(self.frame))], dtype=np.int64)

    def _state(self, number: int) -> State:
        if not self.detected[number]:
            return _OF_STATUS.get(self.status[number], LOST)
        if self.label == 0:
            return DETECTED
        return IDENTIFIED if self.identified[number] == self.label else WRONG


@dataclasses.dataclass(frozen=True)
class Case:
    """A tag of a recording at its worst: its score, and the frame in the middle of its longest failure."""

    recording: str
    tag: TagFrames
    score: float  # mean box IoU of the frames that count; without truth the fraction of frames with a detection
    frame: int
    failed: tuple[int, int]  # first and last frame of the longest failure


def lost_iou(tags: Iterable[TagFrames]) -> dict[State, float]:
    """Mean box IoU that is lost in each state, over the frames that count; with the IoU they add up to 1.

    A frame's loss is 1 less its box IoU. Of a frame that is identified it is what the box lacks.
    """
    sums, count = dict.fromkeys(STATES, 0.0), 0
    for tag in tags:
        states = tag.states()
        for number, state in enumerate(STATES):
            sums[state] += float(np.sum((1.0 - tag.iou)[tag.valid & (states == number)]))
        count += int(tag.valid.sum())
    return {state: total / count for state, total in sums.items()} if count else {}


def worst_cases(
    recordings: Sequence[tuple[str, Sequence[TagFrames]]], number: int, *, threshold: float = 0.5
) -> list[Case]:
    """The tags with the lowest scores first. A tag with truth of which no frame counts is left out."""
    cases = []
    for name, tags in recordings:
        for tag in tags:
            counts = tag.valid if tag.label else np.ones(len(tag.frame), bool)
            if not counts.any():
                continue
            right = tag.iou >= threshold if tag.label else tag.detected
            score = float(np.mean(tag.iou[counts] if tag.label else tag.detected))
            first, last = longest_run(counts & ~right)
            if last >= first:
                cases.append(
                    Case(
                        name,
                        tag,
                        score,
                        int(tag.frame[(first + last) // 2]),
                        (int(tag.frame[first]), int(tag.frame[last])),
                    )
                )
    return sorted(cases, key=lambda case: case.score)[:number]


def longest_run(on: Bool[np.ndarray, " time"]) -> tuple[int, int]:
    """First and last place of the longest run of true values, of several the first; (0, -1) where there is none."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], on, [False]])))
    if len(edges) == 0:
        return 0, -1
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    return int(starts[longest]), int(ends[longest]) - 1


def runs(values: Int[np.ndarray, " time"]) -> list[tuple[int, int, int]]:
    """Runs of equal values: first place, length, value."""
    starts = np.flatnonzero(np.diff(values, prepend=values[:1] - 1)).tolist()
    return [
        (start, end - start, int(values[start])) for start, end in zip(starts, [*starts[1:], len(values)], strict=False)
    ]
