"""A line of the check of a recording: what was found, the verdict, and what to change."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

Verdict = Literal["good", "limits", "bad", "not measured"]

VERDICTS: tuple[Verdict, ...] = ("good", "limits", "bad", "not measured")
"""Good: leaves nothing to gain. Limits: tracing works, less well. Bad: expect tracing to fail."""


@dataclasses.dataclass(frozen=True)
class Line:
    """One measured property of a recording.

    `found` is the value with its unit; `threshold` gives the values of good and bad, `source` where they come from;
    `change` is what to do where the verdict is not good.
    """

    name: str
    title: str
    verdict: Verdict
    found: str
    threshold: str
    source: str
    change: str


def judged(value: float, limits: tuple[float, float]) -> Verdict:
    """The verdict of a value between `limits` = (good, bad): good at the first or beyond it, bad beyond the second.

    Where the first limit is the larger one, high values are good. NaN is not measured.
    """
    good, bad = limits
    if not np.isfinite(value):
        return "not measured"
    sign = 1.0 if good > bad else -1.0
    if sign * value >= sign * good:
        return "good"
    return "bad" if sign * value < sign * bad else "limits"


def worst_verdict(verdicts: list[Verdict]) -> Verdict:
    """The worst of several verdicts; what was not measured counts only where nothing was."""
    found: tuple[Verdict, ...] = ("bad", "limits", "good")
    for one in found:
        if one in verdicts:
            return one
    return "not measured"


def worst(values: np.ndarray, limits: tuple[float, float]) -> int:
    """The place of the value farthest on the bad side; of NaN only where all are."""
    ordered = values if limits[0] > limits[1] else -values
    return int(np.argmin(np.where(np.isfinite(values), ordered, np.inf)))


def limits_text(limits: tuple[float, float], unit: str, scale: float = 1.0) -> str:
    """Both limits as text: good at least ..., bad below ... (or at most, and above)."""
    good, bad = (f"{limit * scale:g}{unit}" for limit in limits)
    high = limits[0] > limits[1]
    return f"good: {'at least' if high else 'at most'} {good}; bad: {'below' if high else 'above'} {bad}"
