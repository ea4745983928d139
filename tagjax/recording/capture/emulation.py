"""The common part of the emulated readers: reads of a recording, made when they are due, with a clock and a network of their own.

The network is held up at random moments, up to `jitter_s` long, and what was held up leaves in its order: so does a stream
over TCP on a busy or wireless network. Delays drawn anew for each read would never leave a quick read behind a slow one, and
the smallest delay, which the relation of two clocks is known from, would hardly occur.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import dataclasses
import threading
from collections.abc import Sequence

import numpy as np

from ...core.errors import RecordingError
from ..reads import TagReads
from .reads import HOST_CLOCK

LOOPBACK = "127.0.0.1"
CODES_PER_TURN = 4096
"""Impinj readers report the phase in so many steps."""

_LEAD_NS = 100_000_000


@dataclasses.dataclass(frozen=True, kw_only=True)
class EmulatorSettings:
    """An emulated reader's clock and network. Raises `ValueError` for a negative jitter or a drift beyond 1 %."""

    drift_ppm: float = 0.0  # how much faster than the host's clock the reader's runs
    jitter_s: float = 0.0  # the network is held up for so long at most
    clock_offset_s: float = -3600.0  # of the reader's clock from the host's, at the first read
    seed: int = 0  # of the network

    def __post_init__(self) -> None:
        if not (0 <= self.jitter_s <= 10 and abs(self.drift_ppm) <= 1e4):
            raise ValueError(
                f"jitter_s is {self.jitter_s} and drift_ppm is {self.drift_ppm}; expected 0 to 10 s, and up to 10000 ppm."
            )


class PlaybackStart:
    """The moment at which a recording begins to be played, for its camera and its reader alike."""

    def __init__(self) -> None:
        self.time_ns: int | None = None  # host's clock, of the recording's first frame
        self._begun = threading.Event()

    def begin(self) -> None:
        """Begin in a tenth of a second; nothing happens where it has begun."""
        if self.time_ns is None:
            self.time_ns = HOST_CLOCK.now_ns() + _LEAD_NS
            self._begun.set()

    def wait(self, seconds: float) -> int | None:
        """The moment, once it is known; None where it is not known in so many seconds."""
        return self.time_ns if self._begun.wait(seconds) else None


class EmulatedReads:
    """When each read of a table is made, what the reader's clock shows then, and when it leaves the network."""

    def __init__(self, reads: TagReads, origin_ns: int, settings: EmulatorSettings):
        if not reads.num_reads:
            raise RecordingError("The recording has no read to emulate; expected at least one. Choose another one.")
        self.reads, self.settings = reads, settings
        self.since_ns = reads.time_ns - origin_ns  # of the first frame
        carriers = sorted(set(reads.carrier_hz[np.isfinite(reads.carrier_hz)].tolist()))
        self.hop_table_hz = reads.hop_table_hz or tuple(carriers)
        self.channel = _channels(reads, self.hop_table_hz)
        turns = reads.phase_rad / (2 * np.pi) * CODES_PER_TURN
        self.phase_code = np.round(turns).astype(np.int64) % CODES_PER_TURN
        self.leaves_ns = _held_up(self.since_ns, settings)

    def reader_time_ns(self, since_ns: np.ndarray, start_ns: int) -> np.ndarray:
        """What the reader's clock shows, in whole microseconds, so long after the first frame."""
        drift_ns = np.rint(since_ns * (self.settings.drift_ppm * 1e-6)).astype(np.int64)
        return (start_ns + since_ns + drift_ns + round(self.settings.clock_offset_s * 1e9)) // 1000 * 1000


def _check_epcs(reads: TagReads) -> None:
    """Raise `RecordingError` for a tag that no reader can report: its EPC is sent as bytes."""
    for epc in reads.epcs:
        if len(epc) % 4 or not epc or set(epc) - set("0123456789ABCDEF"):
            raise RecordingError(
                f"The recording has the tag {epc!r}, which no reader can report; expected an EPC of upper-case hexadecimal digits "
                "in words of four. Choose reader=playback, or another recording."
            )


def _channels(reads: TagReads, hop_table_hz: tuple[float, ...]) -> np.ndarray:
    if reads.channel_index is not None:
        return reads.channel_index.astype(np.int64)
    places = {carrier: place for place, carrier in enumerate(hop_table_hz, start=1)}
    return np.array([places.get(carrier, 0) for carrier in reads.carrier_hz.tolist()], np.int64)


def _held_up(since_ns: np.ndarray, settings: EmulatorSettings) -> np.ndarray:
    """When each read leaves a network that is held up, on average, every second half of the time."""
    leaves = since_ns.astype(np.float64)
    if settings.jitter_s == 0:
        return np.maximum.accumulate(since_ns)
    random, limit_ns = np.random.default_rng(settings.seed), settings.jitter_s * 1e9
    moment = float(since_ns.min())
    while moment < since_ns.max():
        moment += random.exponential(limit_ns / 2)
        end = moment + random.uniform(0, limit_ns)
        held = (leaves >= moment) & (leaves < end)
        leaves[held] = end
        moment = end
    return np.maximum.accumulate(np.rint(leaves).astype(np.int64))


class AbstractEmulator(abc.ABC):
    """A reader on loopback that reads the tags of a recording, as an asynchronous context manager.

    Faults for tests: `cut` ends the connection, after half a message if asked to; `mute` stops all answers, as an unplugged
    cable does; `reboot` takes the reader away for a while, and its clock starts anew; `flood` sends reads at once.
    """

    def __init__(
        self,
        reads: TagReads,
        origin_ns: int,
        *,
        start: PlaybackStart | None = None,
        settings: EmulatorSettings | None = None,
        port: int = 0,
    ):
        _check_epcs(reads)
        self.table = EmulatedReads(reads, origin_ns, settings or EmulatorSettings())
        self.start = start or PlaybackStart()
        self.port = port  # 0: any; the true one once it listens
        self.muted = False
        self.num_connections = 0
        self.sent: list[int] = []  # rows, in the order in which they left
        self._boot_ns = 0  # added to the clock by reboots
        self._next = 0
        self._inventory: asyncio.Task[None] | None = None

    async def __aenter__(self) -> AbstractEmulator:
        await self.listen()
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.stop_inventory()
        await self.close()

    @abc.abstractmethod
    async def listen(self) -> None:
        """Accept connections at `port`."""

    @abc.abstractmethod
    async def close(self) -> None:
        """End all connections, and accept no more."""

    @abc.abstractmethod
    async def send(self, rows: Sequence[int]) -> None:
        """Send these rows as reads."""

    @abc.abstractmethod
    async def cut(self, *, half_message: bool = False) -> None:
        """End the connection at once, after the first half of a message if asked to."""

    def host_time_ns(self, rows: np.ndarray) -> np.ndarray:
        """When these rows were read, on the host's clock."""
        assert self.start.time_ns is not None
        return self.start.time_ns + self.table.since_ns[rows]

    def clock_ns(self, row: int) -> int:
        """What the reader's clock shows at a row."""
        assert self.start.time_ns is not None
        (shown_ns,) = self.table.reader_time_ns(self.table.since_ns[row : row + 1], self.start.time_ns)
        return int(shown_ns) + self._boot_ns

    async def reboot(self, off_s: float = 0.5, clock_jump_s: float = -1000.0) -> None:
        """Go away for a while; afterwards the clock is another, by `clock_jump_s`."""
        await self.stop_inventory()
        await self.close()
        await asyncio.sleep(off_s)
        self._boot_ns += round(clock_jump_s * 1e9)
        await self.listen()

    async def flood(self, rows: Sequence[int]) -> None:
        """Send rows now, all at once."""
        await self.send(rows)

    def start_inventory(self) -> None:
        """Read the tags from now on, until `stop_inventory`."""
        if self._inventory is None or self._inventory.done():
            self._inventory = asyncio.get_running_loop().create_task(self._read())

    async def stop_inventory(self) -> None:
        """Read no more."""
        task, self._inventory = self._inventory, None
        if task is not None:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task

    @property
    def done(self) -> bool:
        """Whether the whole table has been played."""
        return self._next >= len(self.table.leaves_ns)

    async def _read(self) -> None:
        """Send each row when it leaves the network.

        Rows whose time had passed when the inventory began were never read. One that waits for the playback's begin has read
        them all: on a busy machine it may notice the begin late.
        """
        waited = self.start.time_ns is None
        while self.start.time_ns is None:
            await asyncio.sleep(0.002)
        leaves = self.table.leaves_ns + self.start.time_ns
        if not waited:
            self._next = max(self._next, int(np.searchsorted(leaves, HOST_CLOCK.now_ns())))
        while self._next < len(leaves):
            now = HOST_CLOCK.now_ns()
            due = int(np.searchsorted(leaves, now, side="right"))
            if due > self._next:
                rows, self._next = range(self._next, due), due
                await self.send(rows)
            else:
                await asyncio.sleep(max(1e-9 * (leaves[self._next] - now), 0.0))
