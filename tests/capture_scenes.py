"""Reads and a small recording for the tests of what captures: values that the readers' formats hold exactly."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from tagjax.recording import Intrinsics, Recording, TagReads
from tagjax.recording.capture.emulation import AbstractEmulator
from tagjax.recording.capture.llrp import LlrpReader
from tagjax.recording.capture.llrp_emulator import LlrpEmulator
from tagjax.recording.capture.r700 import R700Reader
from tagjax.recording.capture.r700_emulator import R700Emulator
from tagjax.recording.capture.reader import AbstractReader, ConnectionSettings, InventorySettings
from tagjax.recording.capture.reads import CapturedRead, ReaderEvent

ORIGIN_NS = 10**9
QUICK = ConnectionSettings(timeout_s=1.0, silence_s=0.4, first_delay_s=0.05, max_delay_s=0.2)
EMULATORS = {"llrp": LlrpEmulator, "r700": R700Emulator}


def reads_table(duration_s: float, rate_hz: float = 450.0, *, seed: int = 0) -> TagReads:
    """Reads of four tags at two antennas, hopping over 50 channels; phases in steps of 1/4096 turn, RSSI of 0.5 dB."""
    random, number = np.random.default_rng(seed), round(duration_s * rate_hz)
    time_s = np.sort(random.uniform(0, duration_s, number))
    hop_table_hz = tuple(902.75e6 + 0.5e6 * random.permutation(50))
    channel = np.floor(time_s / 0.2).astype(int) % 50 + 1
    return TagReads(
        epc=np.array([f"E280110000000000000000{tag:02X}" for tag in random.integers(170, 174, number)]),
        time_ns=ORIGIN_NS + np.rint(time_s * 1e6).astype(np.int64) * 1000,
        antenna=random.integers(1, 3, number).astype(np.int16),
        carrier_hz=np.array(hop_table_hz)[channel - 1],
        phase_rad=random.integers(0, 4096, number) * (2 * np.pi / 4096),
        rssi_dbm=(random.integers(-140, -80, number) / 2).astype(np.float32),
        doppler_hz=(random.integers(-300, 300, number) / 16).astype(np.float32),
        channel_index=channel.astype(np.int16),
        hop_table_hz=hop_table_hz,
    )


def small_recording(duration_s: float, *, rate_hz: float = 450.0, frame_rate_hz: float = 20.0) -> Recording:
    """Frames of 16 x 12 pixels, each another, and reads."""
    number, random = round(duration_s * frame_rate_hz), np.random.default_rng(1)
    return Recording(
        colour=random.integers(0, 256, (number, 12, 16, 3), dtype=np.uint8),
        depth=random.integers(800, 3000, (number, 12, 16)).astype(np.uint16),
        time_ns=ORIGIN_NS + (np.arange(number) * 1e9 / frame_rate_hz).astype(np.int64),
        intrinsics=Intrinsics(fx_px=20.0, fy_px=20.0, cx_px=7.5, cy_px=5.5, width=16, height=12),
        reads=reads_table(duration_s, rate_hz),
        antennas_m=np.array([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]),
        name="small",
    )


def connect(emulator: AbstractEmulator, connection: ConnectionSettings = QUICK) -> AbstractReader:
    """A reader for an emulator that listens."""
    inventory = InventorySettings(antennas=(1, 2))
    if isinstance(emulator, R700Emulator):
        return R700Reader(emulator.address, inventory=inventory, connection=connection)
    return LlrpReader("127.0.0.1", emulator.port, inventory=inventory, connection=connection)


@dataclasses.dataclass
class Taken:
    """What a stream has yielded."""

    reads: list[CapturedRead] = dataclasses.field(default_factory=list)
    events: list[ReaderEvent] = dataclasses.field(default_factory=list)
    infos: list[Any] = dataclasses.field(default_factory=list)

    def kinds(self) -> list[str]:
        return [event.kind for event in self.events]


async def take(
    reader: AbstractReader, until: Callable[[Taken], bool], *, start: Any = None, taken: Taken | None = None
) -> Taken:
    """Items of a stream until a condition holds; a playback begins where the reader is connected."""
    taken = Taken() if taken is None else taken
    async with contextlib.aclosing(reader.stream()) as items:
        async for item in items:
            if isinstance(item, CapturedRead):
                taken.reads.append(item)
            elif isinstance(item, ReaderEvent):
                taken.events.append(item)
                if item.kind == "connected" and start is not None:
                    start.begin()
            else:
                taken.infos.append(item)
            if until(taken):
                return taken
    return taken


def keys(reads: Sequence[CapturedRead]) -> list[tuple[str, int, int]]:
    return [(read.epc, read.antenna, read.reader_time_ns) for read in reads]


def taken_by_a_busy_host(leaves_ns: np.ndarray, seed: int, *, load: int = 2) -> np.ndarray:
    """When a host takes what leaves the network, which runs the program only now and then: times of arrival.

    Its pauses have a heavy tail, up to 1.5 s, and what comes in a pause is taken at once after it. `load` 0: pauses of some
    milliseconds; 1: of some 10 ms, and long ones among them; 2: of 25 ms at least, and moments of a millisecond between them. The
    load changes every few seconds.
    """
    random, now_ns = np.random.default_rng([seed, 77]), float(leaves_ns.min()) - 1e8
    begins, ends, until_ns, kind = [], [], now_ns, 0
    while now_ns < float(leaves_ns.max()) + 2e9:
        if now_ns >= until_ns:
            kind, until_ns = int(random.integers(min(load, 1), load + 1)), now_ns + random.uniform(0.5e9, 4e9)
        runs_ms = random.exponential((20.0, 4.0, 1.0)[kind])
        tail = random.pareto((1.5, 1.1, 1.2)[kind])
        pause_ms = min((tail, 8 * (tail + 0.2), 25 * (tail + 1))[kind], 1500.0)
        begins.append(now_ns)
        ends.append(now_ns + 1e6 * runs_ms)
        now_ns = ends[-1] + 1e6 * pause_ms
    place = np.searchsorted(begins, leaves_ns, side="right") - 1
    taken_ns = np.where(leaves_ns < np.array(ends)[place], leaves_ns, np.array(begins)[place + 1])
    late_ns = 1e5 + random.exponential(1.5e5, len(leaves_ns))
    return np.maximum.accumulate(np.rint(taken_ns + late_ns).astype(np.int64))
