"""Limits of the check of a recording. conf/check.yaml is their home; the defaults here repeat it."""

from __future__ import annotations

import dataclasses

import numpy as np

from ...core.settings import ConfigError

Pair = tuple[float, float]


@dataclasses.dataclass(frozen=True)
class Thresholds:
    """For each measured value two limits, (good, bad): good at the first or beyond, bad beyond the second, else it limits.

    Raises `ConfigError` for limits that are equal or not finite, or that call high values good where low ones are (and the
    reverse).
    """

    reads_per_s: Pair = (15.0, 5.0)  # of one tag
    gap_fraction: Pair = (0.05, 0.3)  # of the video's time, in gaps between reads of a tag longer than `gap_s`
    noise_rad: Pair = (0.15, 0.4)  # standard deviation of the phase about smooth motion
    flip_probability: Pair = (0.02, 0.2)  # of a read with an extra pi
    reads_per_dwell: Pair = (3.0, 1.5)  # of one tag, while the reader stays on one channel
    unknown_carriers: Pair = (0.02, 0.2)  # fraction of reads with an unknown carrier
    clock_s: Pair = (0.05, 0.15)  # lag between reads and frames, or its uncertainty
    reads_outside: Pair = (0.05, 0.2)  # fraction of reads outside of the video's time
    depth_fraction: Pair = (0.7, 0.4)  # of pixels with a depth
    frame_rate_hz: Pair = (9.5, 5.0)
    dropped_fraction: Pair = (0.03, 0.15)  # of frames
    ambiguity: Pair = (0.5, 1.0)  # way between two reads / the way at which a phase difference is ambiguous
    rssi_dbm: Pair = (-65.0, -72.0)  # median of a tag
    gap_s: float = 0.5

    def __post_init__(self) -> None:
        default = {field.name: field.default for field in dataclasses.fields(self)}
        for name, limits in vars(self).items():
            if isinstance(limits, tuple):
                good, bad = default[name]  # type: ignore[misc]
                if not np.all(np.isfinite(limits)) or (limits[0] > limits[1]) != (good > bad) or limits[0] == limits[1]:
                    order = "a larger, then a smaller" if good > bad else "a smaller, then a larger"
                    raise ConfigError(f"{name} is {list(limits)}; expected (good, bad): {order} number.")
        if not self.gap_s > 0:
            raise ConfigError(f"gap_s is {self.gap_s}; expected a positive time.")
