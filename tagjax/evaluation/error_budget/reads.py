"""Reads without error: the phases of the true direct path, in place of a recording's reads."""

from __future__ import annotations

import dataclasses

import numpy as np

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...recording import Recording, RecordingError, TagReads
from ...recording.reads import join_reads
from ..true_distance import at_times, true_distance_m

CARRIERS_HZ = (915.25e6, 915.75e6)
"""Two channels of FCC's band; their offsets are equal, which the tracer does not use."""

RSSI_DBM = -40.0
"""A strong reply: thermal noise at the reader's floor."""


@dataclasses.dataclass(frozen=True)
class TrueReads:
    """How often each tag is read, and how long the reader stays on a channel."""

    reads_per_s: float = 60.0
    dwell_s: float | None = 0.2  # one channel throughout if None

    def __post_init__(self) -> None:
        for name, value in (("reads_per_s", self.reads_per_s), ("dwell_s", self.dwell_s)):
            if value is not None and not value > 0:
                raise ValueError(f"{name} is {value}; expected a positive number.")


def with_true_reads(recording: Recording, settings: TrueReads) -> Recording:
    """The recording with regular reads of each tag at antenna 1: phi = 4 pi f d / c, no noise, reflections, flips or gaps.

    d is the true distance; tags without one keep no read. Raises `RecordingError` where no tag has one.
    """
    frame_s = recording.frame_time_s()
    parts = []
    for number, epc in enumerate(recording.reads.epcs):
        distance_m = true_distance_m(recording, epc, 1)
        if distance_m is None:
            continue
        # Tags are read one after the other.
        shift_s = number / (len(recording.reads.epcs) * settings.reads_per_s)
        time_s = np.arange(shift_s, frame_s[-1], 1.0 / settings.reads_per_s)
        range_m = at_times(frame_s, distance_m, time_s)
        time_s, range_m = time_s[np.isfinite(range_m)], range_m[np.isfinite(range_m)]
        dwell = np.zeros(len(time_s), int) if settings.dwell_s is None else (time_s / settings.dwell_s).astype(int)
        carrier_hz = np.array(CARRIERS_HZ)[dwell % len(CARRIERS_HZ)]
        parts.append(
            TagReads(
                epc=np.full(len(time_s), epc),
                time_ns=recording.time_ns[0] + np.rint(time_s * 1e9).astype(np.int64),
                antenna=np.ones(len(time_s), np.int16),
                carrier_hz=carrier_hz,
                phase_rad=np.mod(4 * np.pi * carrier_hz * range_m / SPEED_OF_LIGHT_M_S, 2 * np.pi),
                rssi_dbm=np.full(len(time_s), RSSI_DBM, np.float32),
                doppler_hz=np.full(len(time_s), np.nan, np.float32),
                pi_flips=False,
            )
        )
    if not parts:
        raise RecordingError(
            f"{recording.name}: found no true distance of a tag to antenna 1; the true reads need it. Choose a simulated recording."
        )
    return recording.with_reads(join_reads(parts))
