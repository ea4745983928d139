"""The scores of one recording as sums, from which any mean over recordings, and its interval, can be computed."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ...metrics.recordings import RecordingResult

TOLERANCE = 1e-3
"""Two means are the same if they differ by no more, absolutely or relatively: what another machine's rounding makes."""


@dataclasses.dataclass(frozen=True)
class RecordingScores:
    """The scores of one recording: for each measure the sum over its frames (or tags), and their number."""

    name: str
    num_tags: int
    num_frames: int
    sums: Mapping[str, tuple[float, int]]
    revision: str | None = None  # Git's commit when it was traced, if known
    settings: str | None = None  # a hash of the settings and parameters with which it was traced, if known

    @classmethod
    def of(cls, result: RecordingResult, revision: str | None = None) -> RecordingScores:
        """The scores of a traced recording."""
        scores = result.scores()
        num_locked = int(np.sum(np.isfinite(scores.lock_s)))
        sums = {name: (mean.total, mean.count) for name, mean in scores.means.items()}
        sums["locked"] = (float(num_locked), len(scores.lock_s))
        return cls(result.recording.name, len(scores.lock_s), sums.get("iou", (0.0, 0))[1], sums, revision)

    @classmethod
    def from_json(cls, content: Mapping[str, Any], revision: str | None = None) -> RecordingScores:
        """Scores from `dataclasses.asdict` as JSON; `revision` is that of scores which hold none.

        Raises `KeyError`, `TypeError` or `ValueError` for anything else.
        """
        sums = {name: (float(total), int(count)) for name, (total, count) in content["sums"].items()}
        num_tags, num_frames = int(content["num_tags"]), int(content["num_frames"])
        known = content.get("revision") or revision
        return cls(content["name"], num_tags, num_frames, sums, known, content.get("settings"))

    def same_as(self, other: RecordingScores, measures: Iterable[str]) -> bool:
        """Whether both are of one recording, with the same counts and the same means (`TOLERANCE`) of these measures."""
        if (self.name, self.num_tags, self.num_frames) != (other.name, other.num_tags, other.num_frames):
            return False
        sums = [(self.sums.get(name, (0.0, 0)), other.sums.get(name, (0.0, 0))) for name in measures]
        return all(
            count == count_too and math.isclose(total, total_too, rel_tol=TOLERANCE, abs_tol=TOLERANCE * max(count, 1))
            for (total, count), (total_too, count_too) in sums
        )
