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
    """When each tag is read: when the recording has a read of it, and on that channel, or so often and regularly."""

    reads_per_s: float | None = None  # None: as the recording is
    dwell_s: float | None = 0.2  # of regular reads: time on a channel; one channel throughout if None

    def __post_init__(self) -> None:
        for name, value in (("reads_per_s", self.reads_per_s), ("dwell_s", self.dwell_s)):
            if value is not None and not value > 0:
                raise ValueError(f"{name} is {value}; expected a positive number.")


def with_true_reads(recording: Recording, settings: TrueReads) -> Recording:
    """The recording with true reads of each tag at antenna 1: phi = 4 pi f d / c, no noise, reflections or flips.

    d is the true distance; tags without one keep no read. Raises `RecordingError` where no tag has one.
    """
    frame_s = recording.frame_time_s()
    parts = []
    for number, epc in enumerate(recording.reads.epcs):
        distance_m = true_distance_m(recording, epc, 1)
        if distance_m is None:
            continue
        # Tags are read one after the other.
        reads = _schedule(recording, epc, number / len(recording.reads.epcs), settings)
        range_m = at_times(frame_s, distance_m, (reads.time_ns - recording.time_ns[0]) * 1e-9)
        known = np.isfinite(range_m) & np.isfinite(reads.carrier_hz)
        phase_rad = np.mod(4 * np.pi * reads.carrier_hz * range_m / SPEED_OF_LIGHT_M_S, 2 * np.pi)
        parts.append(dataclasses.replace(reads, phase_rad=phase_rad)[known])
    if not parts:
        raise RecordingError(
            f"{recording.name}: found no true distance of a tag to antenna 1; the true reads need it. Choose a simulated recording."
        )
    return recording.with_reads(join_reads(parts))


def _schedule(recording: Recording, epc: str, shift: float, settings: TrueReads) -> TagReads:
    """A tag's reads at antenna 1, without phases; regular ones begin after the fraction `shift` of the time between two."""
    if settings.reads_per_s is None:
        reads = recording.reads.select(epc)
        reads = reads[reads.antenna == 1]
        time_ns, carrier_hz = reads.time_ns, reads.carrier_hz
    else:
        time_s = np.arange(shift / settings.reads_per_s, recording.frame_time_s()[-1], 1.0 / settings.reads_per_s)
        dwell = np.zeros(len(time_s), int) if settings.dwell_s is None else (time_s / settings.dwell_s).astype(int)
        time_ns = recording.time_ns[0] + np.rint(time_s * 1e9).astype(np.int64)
        carrier_hz = np.array(CARRIERS_HZ)[dwell % len(CARRIERS_HZ)]
    number = len(time_ns)
    return TagReads(
        epc=np.full(number, epc),
        time_ns=time_ns,
        antenna=np.ones(number, np.int16),
        carrier_hz=carrier_hz,
        phase_rad=np.full(number, np.nan),
        rssi_dbm=np.full(number, RSSI_DBM, np.float32),
        doppler_hz=np.full(number, np.nan, np.float32),
        pi_flips=False,
    )
