"""The scores of one recording as sums, from which any mean over recordings, and its interval, can be computed."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from ...metrics.recordings import RecordingResult


@dataclasses.dataclass(frozen=True)
class RecordingScores:
    """The scores of one recording: for each measure the sum over its frames (or tags), and their number."""

    name: str
    num_tags: int
    num_frames: int
    sums: Mapping[str, tuple[float, int]]

    @classmethod
    def of(cls, result: RecordingResult) -> RecordingScores:
        """The scores of a traced recording."""
        scores = result.scores()
        num_locked = int(np.sum(np.isfinite(scores.lock_s)))
        sums = {name: (mean.total, mean.count) for name, mean in scores.means.items()}
        sums["locked"] = (float(num_locked), len(scores.lock_s))
        return cls(result.recording.name, len(scores.lock_s), sums.get("iou", (0.0, 0))[1], sums)
