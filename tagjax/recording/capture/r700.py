"""Impinj R700 and its like over the IoT device interface: REST to set it, and events as lines of JSON over HTTP.

Endpoints below /api/v1: `status`, `system`, `profiles/stop`, `profiles/inventory/start`, `data/stream` (Impinj, IoT device
interface 1.4). Every read is an event, because the settings name no `tagReporting`. The stream reports the carrier of each
read and no channel index, and no Doppler frequency. HTTP is aiohttp's (extra `reader`). Tested with the emulator of this
package; untested on hardware.

User and password are taken from the environment variables TAGJAX_READER_USER and TAGJAX_READER_PASSWORD.
"""

from __future__ import annotations

import asyncio
import base64
import contextlib
import dataclasses
import json
import os
import ssl
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Any

from ..importers.formats import FORMATS
from ..importers.rows import RowError
from .reader import AbstractReader, ConnectionSettings, InventorySettings
from .reads import HOST_CLOCK, CapturedRead, Item, ReaderError, ReaderEvent, ReaderInfo, ReaderLostError

if TYPE_CHECKING:
    import aiohttp

USER, PASSWORD = "TAGJAX_READER_USER", "TAGJAX_READER_PASSWORD"
"""Environment variables; no file holds what is in them."""

_API = "/api/v1"
_MAX_LINE_BYTES = 1 << 20
_SEARCH = {"dual_target": "dual-target", "single_target": "single-target"}
_DEFAULT_POWER_DBM, _DEFAULT_MODE = 30.0, 4  # the interface has no "the reader's own": R700's defaults


def import_aiohttp() -> Any:
    """The package aiohttp. Raises `ReaderError` where it is not installed."""
    try:
        import aiohttp
    except ImportError as error:
        raise ReaderError(
            f"A package for HTTP is missing ({error}). pip install 'tagjax[reader]' installs it."
        ) from error
    return aiohttp


@dataclasses.dataclass(frozen=True, kw_only=True)
class TlsSettings:
    """How an https address is trusted. An R700 is shipped with a certificate that it has signed itself."""

    certificate: str | None = None  # PEM file of the certificate that is trusted; None: those of the system
    verify: bool = True  # false: any certificate is trusted

    def context(self) -> ssl.SSLContext:
        """The TLS context. Raises `ReaderError` for a file that holds no certificate."""
        try:
            context = ssl.create_default_context(cafile=self.certificate)
        except (OSError, ssl.SSLError) as error:
            raise ReaderError(
                f"certificate: {self.certificate} cannot be read ({error}); expected a PEM file."
            ) from error
        if not self.verify or self.certificate is not None:
            context.check_hostname = False  # it is issued for the reader's name, not for its address
        if not self.verify:
            context.verify_mode = ssl.CERT_NONE
        return context


class R700Reader(AbstractReader):
    """An R700 at an address such as https://192.168.1.10."""

    def __init__(
        self,
        address: str,
        *,
        inventory: InventorySettings | None = None,
        connection: ConnectionSettings | None = None,
        tls: TlsSettings | None = None,
    ):
        super().__init__(connection or ConnectionSettings())
        if "@" in address:
            raise ReaderError(
                f"address: found a user or password in it; expected them in the environment variables {USER} and {PASSWORD}, because "
                "recordings keep the address."
            )
        if not address.startswith(("http://", "https://")):
            raise ReaderError(f"address is {address!r}; expected https://<host> or http://<host>.")
        self._aiohttp = import_aiohttp()
        self.address, self.inventory = address.rstrip("/"), inventory or InventorySettings()
        self._ssl = (tls or TlsSettings()).context() if address.startswith("https://") else None
        self.name = f"R700 {self.address}"

    async def session(self) -> AsyncGenerator[Item, None]:
        """The items of one connection."""
        aiohttp, connection = self._aiohttp, self.connection
        connector = aiohttp.TCPConnector(ssl=True if self._ssl is None else self._ssl)
        timeout = aiohttp.ClientTimeout(total=None, connect=connection.timeout_s, sock_connect=connection.timeout_s)
        async with aiohttp.ClientSession(connector=connector, timeout=timeout, headers=_headers()) as http:
            runs = False
            try:
                info = await self._start(http)
                runs = True
                yield info
                async with http.get(f"{self.address}{_API}/data/stream") as stream:
                    _refuse(stream, self.name)
                    yield ReaderEvent("connected", f"{self.name}: {info.model}")
                    async with contextlib.aclosing(self._items(http, stream.content)) as items:
                        async for item in items:
                            yield item
            except (aiohttp.ClientError, OSError) as error:
                runs = False
                text = str(error) or type(error).__name__
                raise error if isinstance(error, ReaderLostError) else ReaderLostError(text) from error
            finally:
                if runs:
                    with contextlib.suppress(aiohttp.ClientError, OSError):
                        await self._call(http, "POST", "profiles/stop")

    async def _call(self, http: aiohttp.ClientSession, method: str, path: str, body: Any = None) -> dict[str, Any]:
        """One request; its answer, {} where that is no JSON object. Raises `ReaderError` for one that the reader refuses."""
        limit = self._aiohttp.ClientTimeout(total=self.connection.timeout_s)
        async with http.request(method, f"{self.address}{_API}/{path}", json=body, timeout=limit) as answer:
            _refuse(answer, self.name, await answer.text() if answer.status >= 400 else "")
            with contextlib.suppress(ValueError):
                found = json.loads(await answer.read() or b"{}")
                return found if isinstance(found, dict) else {}
            return {}

    async def _start(self, http: aiohttp.ClientSession) -> ReaderInfo:
        """Stop what runs, and start the inventory."""
        status, system = await self._call(http, "GET", "status"), await self._call(http, "GET", "system")
        if status.get("status") != "idle":
            await self._call(http, "POST", "profiles/stop")
        wanted = self.inventory
        await self._call(http, "POST", "profiles/inventory/start", inventory_body(wanted))
        return ReaderInfo(
            protocol="r700",
            model=str(system.get("productModel", "R700")),
            firmware=str(system.get("firmwareVersion", "")),
            antennas=wanted.antennas,
            power_dbm=_DEFAULT_POWER_DBM if wanted.power_dbm is None else wanted.power_dbm,
            mode=_DEFAULT_MODE if wanted.mode is None else wanted.mode,
            session=wanted.session,
        )

    async def _items(self, http: aiohttp.ClientSession, content: Any) -> AsyncGenerator[Item, None]:
        """Reads and events of the stream."""
        lines = LineSplitter()
        while True:
            try:
                data = await _within(content.readany(), self.connection.silence_s)
            except TimeoutError:
                if (await self._call(http, "GET", "status")).get("status") == "idle":
                    raise ReaderLostError("the reader is idle: its inventory was stopped") from None
                continue
            arrival_ns = HOST_CLOCK.now_ns()
            if not data:
                if lines.pending:
                    yield ReaderEvent("malformed", f"the stream ended within a line, after {lines.pending} bytes")
                raise ReaderLostError("the reader ended the stream")
            for line in lines.split(data):
                if (item := captured_line(line, arrival_ns)) is not None:
                    yield item
            if lines.num_dropped:
                yield ReaderEvent("malformed", f"{lines.num_dropped} bytes without an end of line")
                lines.num_dropped = 0


async def _within(awaitable: Any, seconds: float) -> Any:
    async with asyncio.timeout(seconds):
        return await awaitable


class LineSplitter:
    """Lines out of pieces of a stream; a line longer than 1 MiB is dropped and counted in `num_dropped` bytes."""

    def __init__(self) -> None:
        self._rest, self._skipping, self.num_dropped = b"", False, 0

    @property
    def pending(self) -> int:
        """Bytes of the line that has not ended yet."""
        return len(self._rest)

    def split(self, data: bytes) -> list[bytes]:
        """The lines that end in this piece, without their ends."""
        *lines, self._rest = (self._rest + data).split(b"\n")
        if self._skipping and lines:
            self.num_dropped += len(lines.pop(0))
            self._skipping = False
        if len(self._rest) > _MAX_LINE_BYTES or self._skipping:
            self.num_dropped += len(self._rest)
            self._rest, self._skipping = b"", True
        return lines


def captured_line(line: bytes, arrival_ns: int) -> CapturedRead | ReaderEvent | None:
    """A read or an event of one line; None for an empty one, which keeps the connection alive."""
    if not line.strip():
        return None
    try:
        event = json.loads(line)
    except (ValueError, RecursionError):
        return ReaderEvent("malformed", f"a line that is not JSON: {line[:60]!r}")
    if not isinstance(event, dict) or "tagInventoryEvent" not in event:
        kind = event.get("eventType") if isinstance(event, dict) else None
        return ReaderEvent("reader", f"{kind or 'event'}: {json.dumps(event)[:200]}")
    try:
        read = FORMATS["r700"].read({"line": line.decode()})
    except (RowError, KeyError, ValueError) as error:
        return ReaderEvent("malformed", f"a read that cannot be used: {error}")
    if read.reader_ns is None or read.phase_rad is None:
        return ReaderEvent("malformed", f"a read of {read.epc} without time or phase")
    rssi_dbm, carrier_hz = read.rssi_dbm, read.carrier_hz
    return CapturedRead(
        epc=read.epc,
        antenna=read.antenna,
        phase_rad=read.phase_rad,
        reader_time_ns=read.reader_ns,
        arrival_time_ns=arrival_ns,
        rssi_dbm=float("nan") if rssi_dbm is None else rssi_dbm,
        carrier_hz=float("nan") if carrier_hz is None else carrier_hz,
    )


def inventory_body(wanted: InventorySettings) -> dict[str, Any]:
    """The body of profiles/inventory/start: every read is an event, with phase, carrier and time."""
    power_dbm = _DEFAULT_POWER_DBM if wanted.power_dbm is None else wanted.power_dbm
    fields = ("epcHex", "antennaPort", "peakRssiCdbm", "frequency", "phaseAngle", "lastSeenTime", "transmitPowerCdbm")
    return {
        "eventConfig": {
            "common": {"hostname": "disabled"},
            "tagInventory": {"epc": "disabled", **dict.fromkeys(fields, "enabled")},
        },
        "antennaConfigs": [
            {
                "antennaPort": port,
                "transmitPowerCdbm": round(100 * power_dbm),
                "rfMode": _DEFAULT_MODE if wanted.mode is None else wanted.mode,
                "inventorySession": wanted.session,
                "inventorySearchMode": _SEARCH[wanted.search_mode],
                "estimatedTagPopulation": wanted.num_tags,
            }
            for port in wanted.antennas
        ],
    }


def _headers() -> dict[str, str]:
    """Basic authentication by user and password of the environment; none where they are not there."""
    user, password = os.environ.get(USER), os.environ.get(PASSWORD)
    if user is None or password is None:
        return {}
    return {"Authorization": f"Basic {base64.b64encode(f'{user}:{password}'.encode()).decode()}"}


def _refuse(answer: Any, name: str, text: str = "") -> None:
    """Raise `ReaderError` for an answer 4xx, `ReaderLostError` for 5xx."""
    if answer.status in (401, 403):
        raise ReaderError(
            f"{name} refuses access (HTTP {answer.status}); expected its user and password in the environment variables "
            f"{USER} and {PASSWORD}. Set them."
        )
    if 400 <= answer.status < 500:
        raise ReaderError(
            f"{name} refuses {answer.url.path} (HTTP {answer.status}: {text[:200]}); expected settings that it takes. "
            "Change inventory.antennas, power_dbm or mode, or set its interface to the IoT device interface."
        )
    if answer.status >= 500:
        raise ReaderLostError(f"HTTP {answer.status} for {answer.url.path}")
