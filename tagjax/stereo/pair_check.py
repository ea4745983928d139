"""Whether two pictures are a rectified pair: swapped cameras and pairs that do not belong together are found."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..core.errors import RecordingError
from .matching import MatchSettings, disparity_of_pair

MIN_MATCHED = 0.25
"""A smaller fraction of the pixels with a disparity is no pair of pictures of one scene."""

_SWAPPED = 1.5  # times as many matches after an exchange
_ROWS_PX = (-3, 3)  # by which the right picture is moved, to find pairs whose rows do not agree
_MORE = 1.25


@dataclasses.dataclass(frozen=True)
class PairCheck:
    """Fractions of the pixels for which a disparity was found, over the pairs that were tried."""

    matched: float
    swapped: float  # with left and right exchanged
    moved: tuple[float, float]  # with the right picture moved up and down by three rows

    def raise_if_wrong(self, where: str) -> None:
        """Raise `RecordingError` for swapped cameras, and for pictures that do not match."""
        if self.swapped > _SWAPPED * self.matched:
            raise RecordingError(
                f"{where}: {self.matched:.0%} of the pixels match, and {self.swapped:.0%} with left and right exchanged; the cameras "
                "are swapped. Exchange left and right."
            )
        if self.matched < MIN_MATCHED:
            raise RecordingError(
                f"{where}: only {self.matched:.0%} of the pixels match; expected at least {MIN_MATCHED:.0%}. Are the pictures of "
                "the same times, the camera file of these cameras, and near_m below the nearest object?"
            )

    def warning(self) -> str | None:
        """A line for a report where rows do not agree; None for a sound pair."""
        if max(self.moved) <= _MORE * self.matched:
            return None
        return (
            f"doubtful: {self.matched:.0%} of the pixels match, and {max(self.moved):.0%} with the right picture moved by "
            f"{_ROWS_PX[1]} rows. Calibrate the pair again."
        )


def check_pairs(
    pairs: Sequence[tuple[np.ndarray, np.ndarray]], focal_px: float, baseline_m: float, settings: MatchSettings
) -> PairCheck:
    """Match some rectified pairs as they are, exchanged, and moved by three rows up and down."""
    settings = dataclasses.replace(settings, smoothing=0.0)  # which changes no count

    def matched(one: np.ndarray, other: np.ndarray) -> float:
        return float(np.mean(disparity_of_pair(one, other, focal_px, baseline_m, settings) > 0))

    tried = [
        (
            matched(left, right),
            matched(right, left),
            *(matched(left, np.roll(right, rows, axis=0)) for rows in _ROWS_PX),
        )
        for left, right in pairs
    ]
    as_it_is, swapped, up, down = np.mean(tried, axis=0).tolist()
    return PairCheck(as_it_is, swapped, (up, down))
