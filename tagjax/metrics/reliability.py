"""Whether a confidence is the probability that it looks like: reliability curve and Brier score."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

NUM_BINS = 10


@dataclasses.dataclass(frozen=True)
class Reliability:
    """Sums over frames in ten bins of confidence, [0, 0.1) to [0.9, 1]: state -> merge -> result."""

    num: Float[np.ndarray, " bin"] = dataclasses.field(default_factory=lambda: np.zeros(NUM_BINS))
    confidence: Float[np.ndarray, " bin"] = dataclasses.field(default_factory=lambda: np.zeros(NUM_BINS))
    right: Float[np.ndarray, " bin"] = dataclasses.field(default_factory=lambda: np.zeros(NUM_BINS))
    squared: float = 0.0

    @classmethod
    def of(cls, confidence: Float[np.ndarray, " frame"], right: Bool[np.ndarray, " frame"]) -> Reliability:
        """The state of these frames. Raises `ValueError` for a confidence that is not from 0 to 1."""
        if len(confidence) and not (np.min(confidence) >= 0 and np.max(confidence) <= 1):
            raise ValueError("A confidence is not from 0 to 1.")
        index = np.minimum((confidence * NUM_BINS).astype(int), NUM_BINS - 1)
        counted = [np.bincount(index, weights, NUM_BINS) for weights in (None, confidence, right.astype(np.float64))]
        num, sums, hits = (np.asarray(one, np.float64) for one in counted)
        return cls(num, sums, hits, float(np.sum((confidence - right) ** 2)))

    def merge(self, other: Reliability) -> Reliability:
        return Reliability(
            self.num + other.num,
            self.confidence + other.confidence,
            self.right + other.right,
            self.squared + other.squared,
        )

    def result(self) -> dict[str, float | list[list[float]] | None]:
        """brier: mean squared error of the confidence, 0 is best; reliability: [mean confidence, fraction right, frames] a bin."""
        total = float(self.num.sum())
        filled = np.flatnonzero(self.num)
        return {
            "brier": self.squared / total if total else None,
            "reliability": [
                [float(self.confidence[i] / self.num[i]), float(self.right[i] / self.num[i]), float(self.num[i])]
                for i in filled
            ],
        }
