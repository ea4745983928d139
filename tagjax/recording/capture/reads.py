"""What a reader's stream consists of: reads, what happened to the stream, and what the reader says of itself."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from typing import Literal

import numpy as np

from ..reads import TagReads

EventKind = Literal["connected", "lost", "reader", "malformed", "duplicate", "overflow", "ended"]


class HostClock:
    """The host's wall clock in nanoseconds, which no correction of the system's time moves while it runs."""

    def __init__(self) -> None:
        self._offset_ns = time.time_ns() - time.monotonic_ns()

    def now_ns(self) -> int:
        """Nanoseconds since 1970, never smaller than at an earlier call."""
        return time.monotonic_ns() + self._offset_ns


HOST_CLOCK = HostClock()
"""The clock of every time of arrival in this process."""


@dataclasses.dataclass(frozen=True)
class CapturedRead:
    """One read as it arrived."""

    epc: str  # upper-case hex
    antenna: int  # counted from 1
    phase_rad: float  # as reported, in [0, 2 pi)
    reader_time_ns: int  # the reader's clock
    arrival_time_ns: int  # the host's clock
    rssi_dbm: float = math.nan
    doppler_hz: float = math.nan
    carrier_hz: float = math.nan
    channel_index: int = 0  # counted from 1 into the hop table; 0 where the reader reports none


@dataclasses.dataclass(frozen=True)
class ReaderEvent:
    """Something that happened to the stream: a connection, its loss, what the reader notified, data that was not usable."""

    kind: EventKind
    text: str
    time_ns: int = dataclasses.field(default_factory=HOST_CLOCK.now_ns)
    count: int = 1


@dataclasses.dataclass(frozen=True)
class ReaderInfo:
    """What the reader says of itself, and how it was set. None where it does not say."""

    protocol: str
    model: str
    firmware: str = ""
    hop_table_hz: tuple[float, ...] = ()  # channel index 1, 2, ...
    antennas: tuple[int, ...] = ()
    power_dbm: float | None = None
    mode: int | None = None
    session: int | None = None


Item = CapturedRead | ReaderEvent | ReaderInfo
"""What a stream yields."""


class ReaderError(ValueError):
    """A reader that cannot be used as it is set: what was found, what was expected, what to do. It is not tried again."""


class ReaderLostError(ConnectionError):
    """A connection to a reader that failed or ended. The stream connects again."""


def as_tag_reads(reads: Sequence[CapturedRead], hop_table_hz: tuple[float, ...] = ()) -> TagReads:
    """Captured reads as a table in order of arrival; `time_ns` is the time of arrival."""
    arrival_ns = np.array([read.arrival_time_ns for read in reads], np.int64)
    return TagReads(
        epc=np.array([read.epc for read in reads], dtype=str),
        time_ns=arrival_ns,
        antenna=np.array([read.antenna for read in reads], np.int16),
        carrier_hz=np.array([read.carrier_hz for read in reads], np.float64),
        phase_rad=np.array([read.phase_rad for read in reads], np.float64),
        rssi_dbm=np.array([read.rssi_dbm for read in reads], np.float32),
        doppler_hz=np.array([read.doppler_hz for read in reads], np.float32),
        reader_time_ns=np.array([read.reader_time_ns for read in reads], np.int64),
        arrival_time_ns=arrival_ns,
        channel_index=np.array([read.channel_index for read in reads], np.int16),
        hop_table_hz=hop_table_hz,
    )
