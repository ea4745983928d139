"""A reader's stream that outlives its connections: it connects again with growing delays and reports each loss."""

from __future__ import annotations

import abc
import asyncio
import collections
import contextlib
import dataclasses
import random
from collections.abc import AsyncGenerator
from typing import Literal

from .reads import CapturedRead, Item, ReaderEvent, ReaderLostError

_REMEMBERED = 4096  # reads of which a repetition is recognised


@dataclasses.dataclass(frozen=True, kw_only=True)
class InventorySettings:
    """How the reader is set to read. Raises `ValueError` for values that no reader takes."""

    antennas: tuple[int, ...] = (1,)  # ports, counted from 1
    power_dbm: float | None = None  # None: the reader's own
    mode: int | None = None  # the reader's RF mode; None: its own
    session: int = 1  # of EPC Gen2
    search_mode: Literal["dual_target", "single_target"] = "dual_target"  # dual_target reads a tag again and again
    num_tags: int = 8  # expected in the field

    def __post_init__(self) -> None:
        if not self.antennas or len(set(self.antennas)) < len(self.antennas) or min(self.antennas) < 1:
            raise ValueError(f"antennas is {self.antennas}; expected different ports, counted from 1.")
        if self.session not in range(4):
            raise ValueError(f"session is {self.session}; expected 0 to 3.")
        if self.num_tags < 1:
            raise ValueError(f"num_tags is {self.num_tags}; expected at least 1.")
        if self.power_dbm is not None and not 0 < self.power_dbm <= 36:
            raise ValueError(f"power_dbm is {self.power_dbm}; expected more than 0 and at most 36 dBm.")


@dataclasses.dataclass(frozen=True, kw_only=True)
class ConnectionSettings:
    """How long is waited for what. Raises `ValueError` for times that are not positive."""

    timeout_s: float = 5.0  # for a connection, and for an answer
    silence_s: float = 3.0  # without any data, the reader is asked whether it is there
    first_delay_s: float = 0.25  # before the first new attempt; twice as long before each further one
    max_delay_s: float = 10.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"{field.name} is {getattr(self, field.name)}; expected a positive number of seconds.")


class AbstractReader(abc.ABC):
    """A reader on the network.

    `stream` yields every read once, and events. It does not end by itself and raises nothing but `ReaderError`, for a reader
    that cannot be used as it is set. Close it with `contextlib.aclosing`: this stops the reader.
    """

    name: str

    def __init__(self, connection: ConnectionSettings):
        self.connection = connection

    @abc.abstractmethod
    def session(self) -> AsyncGenerator[Item, None]:
        """The items of one connection. Raises `ReaderLostError` where it fails or ends; stops the reader where it is closed."""

    async def stream(self) -> AsyncGenerator[Item, None]:
        """The items of all connections."""
        repeats, delay_s, reported = _Repeats(), self.connection.first_delay_s, ""
        while True:
            try:
                async with contextlib.aclosing(self.session()) as items:
                    async for item in items:
                        if isinstance(item, CapturedRead) and repeats.seen(item):
                            yield ReaderEvent("duplicate", f"a read of {item.epc} was reported twice")
                            continue
                        if isinstance(item, ReaderEvent) and item.kind == "connected":
                            delay_s, reported = self.connection.first_delay_s, ""
                        yield item
            except ReaderLostError as error:
                if str(error) != reported:  # an attempt that fails as the one before it is not reported again
                    reported = str(error)
                    yield ReaderEvent("lost", f"{self.name}: {error}")
            await asyncio.sleep(delay_s * random.uniform(0.75, 1.0))
            delay_s = min(2 * delay_s, self.connection.max_delay_s)


class _Repeats:
    """Recognises a read that is reported again, as a reader may do with its buffer after a connection was lost.

    No reader reads one tag twice in the same microsecond at the same antenna.
    """

    def __init__(self) -> None:
        self._order: collections.deque[tuple[str, int, int]] = collections.deque()
        self._keys: set[tuple[str, int, int]] = set()

    def seen(self, read: CapturedRead) -> bool:
        key = (read.epc, read.antenna, read.reader_time_ns)
        if key in self._keys:
            return True
        self._keys.add(key)
        self._order.append(key)
        if len(self._order) > _REMEMBERED:
            self._keys.discard(self._order.popleft())
        return False
