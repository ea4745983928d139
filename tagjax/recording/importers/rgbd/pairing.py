"""Colour pictures paired with the depth pictures nearest in time, from one pass over both streams."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Iterable, Iterator

from ....core.errors import RecordingError
from .source import Picture

MAX_WAITING = 64
"""Colour pictures that wait for later depth, and depth pictures that wait for colour: bounds the memory."""

MAX_BACKWARDS = 0.1
"""A stream in which a larger fraction of the pictures is not later than the one before is refused."""


@dataclasses.dataclass
class Tally:
    """What was counted while pairing."""

    num_colour: int = 0
    num_depth: int = 0
    num_pairs: int = 0
    backwards: dict[str, int] = dataclasses.field(default_factory=lambda: {"colour": 0, "depth": 0})
    first_ns: dict[str, int] = dataclasses.field(default_factory=dict)
    last_ns: dict[str, int] = dataclasses.field(default_factory=dict)
    example: dict[str, str] = dataclasses.field(default_factory=dict)

    def line(self) -> str:
        """The counts as a sentence without a full stop."""
        text = f"{self.num_pairs} of {self.num_colour} colour pictures have depth, of {self.num_depth} depth pictures"
        for stream, count in self.backwards.items():
            if count:
                text += f"; {count} {stream} pictures that are not later than the one before are left out"
        return text

    def check(self, where: str, max_gap_s: float) -> None:
        """Raise `RecordingError` if there is no pair, or if times go backwards too often."""
        for stream, count in (("colour", self.num_colour), ("depth", self.num_depth)):
            if count == 0:
                raise RecordingError(f"{where}: no {stream} picture; expected colour and depth.")
            if (back := self.backwards[stream]) > MAX_BACKWARDS * count:
                raise RecordingError(
                    f"{where}: the times of {back} of {count} {stream} pictures are not later than the ones before (first: "
                    f"{self.example[stream]}); expected at most {MAX_BACKWARDS:.0%}. A clock was set back, or the times have a "
                    "wrong unit: correct them, or cut the recording there."
                )
        if self.num_pairs == 0:
            spans = ", ".join(
                f"{stream} from {self.first_ns[stream] * 1e-9:.3f} to {self.last_ns[stream] * 1e-9:.3f} s"
                for stream in ("colour", "depth")
            )
            raise RecordingError(
                f"{where}: no colour picture has depth within {max_gap_s:g} s ({spans}); expected both on one clock. Give "
                "max_gap_s=<seconds>, or correct the times."
            )


def pairs(pictures: Iterable[Picture], max_gap_s: float, tally: Tally) -> Iterator[tuple[Picture, Picture]]:
    """(colour, depth) for each colour picture with depth within `max_gap_s`, in order of time.

    Pictures that are not later than the one before of their stream are left out. A depth picture may belong to two colour
    pictures. `tally` is counted up. At most `MAX_WAITING` pictures of each stream are held.
    """
    waiting: deque[Picture] = deque()
    depths: deque[Picture] = deque()
    for picture in pictures:
        if not _count(picture, tally):
            continue
        (waiting if picture.stream == "colour" else depths).append(picture)
        while waiting and (
            (depths and depths[-1].time_ns >= waiting[0].time_ns)
            or len(waiting) > MAX_WAITING
            or len(depths) > MAX_WAITING
        ):
            yield from _pair(waiting.popleft(), depths, max_gap_s, tally)
        if len(depths) > MAX_WAITING:
            depths.popleft()
    while waiting:
        yield from _pair(waiting.popleft(), depths, max_gap_s, tally)


def _count(picture: Picture, tally: Tally) -> bool:
    """Count a picture; whether it is later than the one before of its stream."""
    stream = picture.stream
    if stream == "colour":
        tally.num_colour += 1
    else:
        tally.num_depth += 1
    tally.first_ns.setdefault(stream, picture.time_ns)
    if picture.time_ns <= tally.last_ns.get(stream, picture.time_ns - 1):
        tally.backwards[stream] += 1
        tally.example.setdefault(stream, picture.where)
        return False
    tally.last_ns[stream] = picture.time_ns
    return True


def _pair(colour: Picture, depths: deque[Picture], max_gap_s: float, tally: Tally) -> Iterator[tuple[Picture, Picture]]:
    """The pair of a colour picture, if there is one; depth pictures before its depth are not needed again."""
    while len(depths) > 1 and abs(depths[1].time_ns - colour.time_ns) <= abs(depths[0].time_ns - colour.time_ns):
        depths.popleft()
    if depths and abs(depths[0].time_ns - colour.time_ns) <= round(max_gap_s * 1e9):
        tally.num_pairs += 1
        yield colour, depths[0]
