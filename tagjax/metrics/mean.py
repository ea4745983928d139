"""The mean over valid elements as a state that can be merged."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Shaped


@dataclasses.dataclass(frozen=True)
class MaskedMean:
    """Mean over valid elements as a mergeable state; its result is NaN without any."""

    total: float = 0.0
    count: int = 0

    @classmethod
    def of(cls, values: Shaped[np.ndarray, "*shape"], valid: Bool[np.ndarray, "*shape"]) -> MaskedMean:
        """The state of these values; NaN values count as invalid."""
        values = np.asarray(values, np.float64)
        kept = values[valid & np.isfinite(values)]
        return cls(float(kept.sum()), len(kept))

    def merge(self, other: MaskedMean) -> MaskedMean:
        return MaskedMean(self.total + other.total, self.count + other.count)

    def result(self) -> float:
        return self.total / self.count if self.count else float("nan")
