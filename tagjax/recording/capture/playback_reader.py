"""A reader that plays the reads of a recording within this process, without a network."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator

import numpy as np

from ..reads import TagReads
from .emulation import EmulatedReads, EmulatorSettings, PlaybackStart
from .reader import AbstractReader, ConnectionSettings
from .reads import HOST_CLOCK, CapturedRead, Item, ReaderEvent, ReaderInfo


class PlaybackReader(AbstractReader):
    """Yields each read when it leaves the emulated network. The phase is the recording's own, in no steps."""

    def __init__(self, reads: TagReads, origin_ns: int, start: PlaybackStart, settings: EmulatorSettings | None = None):
        super().__init__(ConnectionSettings())
        self.table, self.start, self.name = (
            EmulatedReads(reads, origin_ns, settings or EmulatorSettings()),
            start,
            "playback",
        )

    async def session(self) -> AsyncGenerator[Item, None]:
        """All reads; then nothing more comes."""
        reads, table = self.table.reads, self.table
        antennas = tuple(int(port) for port in np.unique(reads.antenna))
        yield ReaderInfo("playback", "reads of a recording", hop_table_hz=table.hop_table_hz, antennas=antennas)
        yield ReaderEvent("connected", f"{reads.num_reads} reads are played")
        while self.start.time_ns is None:
            await asyncio.sleep(0.002)
        stamps = table.reader_time_ns(table.since_ns, self.start.time_ns)
        for row, leaves_ns in enumerate((table.leaves_ns + self.start.time_ns).tolist()):
            while (left_ns := leaves_ns - HOST_CLOCK.now_ns()) > 0:
                await asyncio.sleep(1e-9 * left_ns)
            yield CapturedRead(
                epc=str(reads.epc[row]),
                antenna=int(reads.antenna[row]),
                phase_rad=float(reads.phase_rad[row]),
                reader_time_ns=int(stamps[row]),
                arrival_time_ns=HOST_CLOCK.now_ns(),
                rssi_dbm=float(reads.rssi_dbm[row]),
                doppler_hz=float(reads.doppler_hz[row]),
                carrier_hz=float(reads.carrier_hz[row]),
                channel_index=int(table.channel[row]),
            )
        await asyncio.Event().wait()
