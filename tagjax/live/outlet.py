"""Lines of text handed to something slow by a thread of its own: the queue is bounded, and nobody waits for it."""

from __future__ import annotations

import collections
import dataclasses
import threading
import time
from collections.abc import Callable


@dataclasses.dataclass(frozen=True, kw_only=True)
class OutletSettings:
    """How long and how often a line is tried. Raises `ValueError` for values that are not positive."""

    queue: int = 1000  # lines that may wait; the oldest is dropped where there are more
    attempts: int = 5  # for a line, until it is dropped
    first_delay_s: float = 0.5  # before the second attempt; twice as long before each further one
    max_delay_s: float = 8.0
    timeout_s: float = 5.0  # of an attempt
    close_s: float = 3.0  # at the end, for the lines that wait

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            if not getattr(self, field.name) > 0:
                raise ValueError(f"{field.name} is {getattr(self, field.name)}; expected a positive number.")


class DeliveryError(Exception):
    """A line that could not be delivered. `again` says whether another attempt may succeed."""

    def __init__(self, text: str, *, again: bool):
        super().__init__(text)
        self.again = again


class Outlet:
    """Delivers lines in their order. `put` never waits. Every line is counted once: as delivered, as dropped, or as waiting.

    `deliver` raises `DeliveryError`. `close` waits for what is left, `close_s` at most, and drops the rest.
    """

    def __init__(self, deliver: Callable[[str], None], settings: OutletSettings | None = None):
        self._deliver, self._settings = deliver, settings or OutletSettings()
        self._waiting: collections.deque[str] = collections.deque()
        self._changed, self._closing, self._given_up = threading.Condition(), False, False
        self._busy = False
        self.num_delivered = self.num_dropped = self.num_retries = 0
        self.last_error = ""
        self._thread = threading.Thread(target=self._run, name="outlet", daemon=True)
        self._thread.start()

    def put(self, line: str) -> None:
        """Hand over a line. Where the queue is full, the oldest line that waits is dropped."""
        with self._changed:
            if self._closing:
                self.num_dropped += 1
                return
            if len(self._waiting) >= self._settings.queue:
                self._waiting.popleft()
                self.num_dropped += 1
            self._waiting.append(line)
            self._changed.notify_all()

    def close(self) -> None:
        """Deliver what waits, as far as the time allows, and end."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
            self._changed.wait_for(lambda: not self._waiting and not self._busy, self._settings.close_s)
            if self._given_up:
                return
            self._given_up = True
            self.num_dropped += len(self._waiting) + self._busy
            self._waiting.clear()
            self._changed.notify_all()

    def summary(self) -> dict[str, int | str]:
        """Lines that were delivered and dropped, repeated attempts, and the last error."""
        with self._changed:
            counts: dict[str, int | str] = {
                "delivered": self.num_delivered,
                "dropped": self.num_dropped,
                "retries": self.num_retries,
            }
            return {**counts, "last_error": self.last_error} if self.last_error else counts

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting or self._closing)
                if not self._waiting:
                    return
                line, self._busy = self._waiting.popleft(), True
            delivered = self._try(line)
            with self._changed:
                self._busy = False
                if not self._given_up:  # else `close` has counted it
                    self.num_delivered += delivered
                    self.num_dropped += not delivered
                self._changed.notify_all()

    def _try(self, line: str) -> bool:
        """Whether the line was delivered, after several attempts if need be."""
        delay_s = self._settings.first_delay_s
        for attempt in range(self._settings.attempts):
            if attempt:
                self._sleep(delay_s)
                delay_s = min(2 * delay_s, self._settings.max_delay_s)
            with self._changed:
                if self._given_up:
                    return False
                self.num_retries += attempt > 0
            try:
                self._deliver(line)
                return True
            except DeliveryError as error:
                with self._changed:
                    self.last_error = str(error)
                if not error.again:
                    return False
        return False

    def _sleep(self, seconds: float) -> None:
        """Wait, unless `close` gives up meanwhile."""
        until = time.monotonic() + seconds
        with self._changed:
            self._changed.wait_for(lambda: self._given_up, until - time.monotonic())
