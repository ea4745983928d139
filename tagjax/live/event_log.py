"""The events of a stream: numbered, written to a file, and handed to standard output and to a webhook where these are set."""

from __future__ import annotations

import dataclasses
import io
import json
import sys
from collections.abc import Mapping
from typing import Any

from ..core.results import to_json_values
from .events import Event, EventRules, Sighting, TagState, next_events
from .outlet import DeliveryError, Outlet, OutletSettings
from .webhook import webhook


@dataclasses.dataclass(frozen=True, kw_only=True)
class EventSettings(EventRules):
    """When results become events, and where these go beside events.jsonl."""

    stdout: bool = False
    webhook: str | None = None  # an address that takes POST
    delivery: OutletSettings = dataclasses.field(default_factory=OutletSettings)


class EventLog:
    """Turns results into events and hands them on. `add` waits for the file alone. Raises `ConfigError` for a wrong webhook.

    Each event has a number, counted from 1, by which a receiver knows a repetition or a gap.
    """

    def __init__(self, settings: EventSettings, file: io.TextIOBase, *, stdout: io.TextIOBase | None = None):
        self._settings, self._file = settings, file
        self._states: dict[str, TagState] = {}
        self.counts: dict[str, int] = {"detected": 0, "lost": 0, "alarm": 0, "left": 0}
        send = None if settings.webhook is None else webhook(settings.webhook, settings.delivery.timeout_s)
        self._outlets: dict[str, Outlet] = {}
        if settings.stdout:
            self._outlets["stdout"] = Outlet(_printer(stdout), settings.delivery)
        if send is not None:
            self._outlets["webhook"] = Outlet(send, settings.delivery)

    def add(self, time_ns: int, sightings: Mapping[str, Sighting]) -> list[Event]:
        """Take the results of a frame; its events."""
        self._states, events = next_events(self._settings, self._states, time_ns, sightings)
        for event in events:
            self.counts[event.kind] += 1
            line = json.dumps({"number": sum(self.counts.values()), **to_json_values(event.as_json())})
            self._file.write(line + "\n")
            for outlet in self._outlets.values():
                outlet.put(line)
        if events:
            self._file.flush()
        return events

    def close(self) -> None:
        """Wait, for a bounded time, until all events have been delivered."""
        for outlet in self._outlets.values():
            outlet.close()

    def problems(self) -> list[str]:
        """What keeps events from being delivered, in a line each."""
        return [
            f"{name}: {outlet.num_dropped} events dropped; {outlet.last_error}".removesuffix("; ")
            for name, outlet in self._outlets.items()
            if outlet.num_dropped or outlet.last_error
        ]

    def summary(self) -> dict[str, Any]:
        """Events of each kind, and what was delivered to where."""
        return {**self.counts, **{name: outlet.summary() for name, outlet in self._outlets.items()}}


def _printer(stream: io.TextIOBase | None) -> Any:
    """A function that prints a line at once; where nobody reads, the line is lost."""

    def write(line: str) -> None:
        try:
            print(line, file=sys.stdout if stream is None else stream, flush=True)
        except (OSError, ValueError) as error:  # a pipe that was closed
            raise DeliveryError(f"standard output: {error}", again=False) from error

    return write
