"""Durations in a histogram of fixed size, and how often each tag is read."""

from __future__ import annotations

import collections

import numpy as np

_BINS_MS = np.geomspace(0.01, 1e5, 1401)  # 1.2 % wide: percentiles in memory that does not grow
_WINDOW_NS = 3_000_000_000


class Milliseconds:
    """Percentiles of any number of durations in a histogram of fixed size."""

    def __init__(self) -> None:
        self._counts, self.highest = np.zeros(len(_BINS_MS) + 1, np.int64), 0.0

    def add(self, seconds: float) -> None:
        """Count a duration."""
        self._counts[np.searchsorted(_BINS_MS, 1e3 * seconds)] += 1
        self.highest = max(self.highest, 1e3 * seconds)

    def percentile(self, percent: int) -> float:
        """The upper edge of the bin that this percentile lies in, ms; NaN before any duration."""
        total = int(self._counts.sum())
        if total == 0:
            return float("nan")
        index = int(np.searchsorted(np.cumsum(self._counts), percent / 100 * total))
        return float(min(_BINS_MS[min(index, len(_BINS_MS) - 1)], self.highest))

    def summary(self) -> dict[str, float]:
        """Median, 90th, 99th percentile and maximum, ms."""
        named = {f"p{percent}": self.percentile(percent) for percent in (50, 90, 99)}
        return {name: round(value, 2) for name, value in {**named, "max": self.highest}.items()}


class ReadRates:
    """Reads per second of each tag, over the last three seconds."""

    def __init__(self) -> None:
        self._frames: collections.deque[tuple[int, dict[str, int]]] = collections.deque()
        self._totals: collections.Counter[str] = collections.Counter()
        self._first_ns: int | None = None

    def add(self, time_ns: int, epcs: np.ndarray) -> None:
        """Count the reads of a frame; times grow from frame to frame."""
        self._first_ns = time_ns if self._first_ns is None else self._first_ns
        counts = dict(collections.Counter(epcs.tolist()))
        self._totals.update(counts)
        self._frames.append((time_ns, counts))
        while self._frames and time_ns - self._frames[0][0] >= _WINDOW_NS:
            self._totals.subtract(self._frames.popleft()[1])

    def rates_hz(self) -> dict[str, float]:
        """The rate of each tag that was read of late."""
        if not self._frames or self._first_ns is None:
            return {}
        passed_s = 1e-9 * min(max(self._frames[-1][0] - self._first_ns, 1), _WINDOW_NS)
        return {epc: count / passed_s for epc, count in self._totals.items() if count > 0}
