"""An emulated R700 that speaks the IoT device interface on loopback, over HTTP; the server is aiohttp's (extra `reader`)."""

from __future__ import annotations

import asyncio
import contextlib
import datetime as dt
import json
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .emulation import CODES_PER_TURN, LOOPBACK, AbstractEmulator
from .r700 import import_aiohttp

if TYPE_CHECKING:
    from aiohttp import web


class R700Emulator(AbstractEmulator):
    """An R700 at http://127.0.0.1:port."""

    _runner: Any = None
    _stream: Any = None  # the answer that events are written to
    settings: dict[str, Any] | None = None  # of the inventory that runs; None: idle

    @property
    def address(self) -> str:
        """Where it listens."""
        return f"http://{LOOPBACK}:{self.port}"

    async def listen(self) -> None:
        """Accept connections at `port`."""
        import_aiohttp()
        from aiohttp import web

        app = web.Application()
        app.router.add_get("/api/v1/status", self._status)
        app.router.add_get("/api/v1/system", self._system)
        app.router.add_post("/api/v1/profiles/inventory/start", self._start)
        app.router.add_post("/api/v1/profiles/stop", self._stop)
        app.router.add_get("/api/v1/data/stream", self._events)
        self._runner = web.AppRunner(app, access_log=None, shutdown_timeout=0.1)
        await self._runner.setup()
        site = web.TCPSite(self._runner, LOOPBACK, self.port)
        await site.start()
        self.port = self._runner.addresses[0][1]

    async def close(self) -> None:
        """End all connections, and accept no more."""
        runner, self._runner, self.settings = self._runner, None, None
        if runner is not None:
            await self.cut()
            await runner.cleanup()

    async def send(self, rows: Sequence[int]) -> None:
        """Send these rows, a line each."""
        if self._stream is None or self.muted:
            return
        self.sent += rows
        with contextlib.suppress(ConnectionError):
            await self._stream.write(b"".join(self.line(row) for row in rows))

    async def cut(self, *, half_message: bool = False) -> None:
        """End the connection of the stream at once, after the first half of a line if asked to."""
        stream, self._stream = self._stream, None
        if stream is None:
            return
        if half_message:
            line = self.line(0)
            with contextlib.suppress(ConnectionError):
                await stream.write(line[: len(line) // 2])
        if (transport := stream._req.transport) is not None:
            transport.close()

    def line(self, row: int) -> bytes:
        """The event of one row."""
        reads, stamp = self.table.reads, _stamp(self.clock_ns(row))
        rssi_dbm, carrier_hz = float(reads.rssi_dbm[row]), float(reads.carrier_hz[row])
        tag = {
            "epcHex": str(reads.epc[row]),
            "antennaPort": int(reads.antenna[row]),
            "phaseAngle": int(self.table.phase_code[row]) * 360.0 / CODES_PER_TURN,
            "lastSeenTime": stamp,
        }
        tag |= {"peakRssiCdbm": round(100 * rssi_dbm)} if math.isfinite(rssi_dbm) else {}
        tag |= {"frequency": round(1e-3 * carrier_hz)} if math.isfinite(carrier_hz) else {}
        event = {"timestamp": stamp, "eventType": "tagInventory", "tagInventoryEvent": tag}
        return json.dumps(event).encode() + b"\r\n"

    async def _answer(self, body: dict[str, Any], status: int = 200) -> web.Response:
        from aiohttp import web

        while self.muted:
            await asyncio.sleep(0.02)
        return web.json_response(body, status=status)

    async def _status(self, request: web.Request) -> web.Response:
        del request
        return await self._answer({"status": "idle" if self.settings is None else "running"})

    async def _system(self, request: web.Request) -> web.Response:
        del request
        return await self._answer({"productModel": "R700 (emulated)", "serialNumber": "0"})

    async def _start(self, request: web.Request) -> web.Response:
        body = await request.json()
        wanted = body.get("eventConfig", {}).get("tagInventory", {})
        if not body.get("antennaConfigs") or wanted.get("phaseAngle") != "enabled":
            return await self._answer({"message": "antennaConfigs or phaseAngle is missing"}, 400)
        self.settings = body
        return await self._answer({})

    async def _stop(self, request: web.Request) -> web.Response:
        del request
        await self.stop_inventory()
        self.settings = None
        return await self._answer({})

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """The stream of events, until its client leaves or it is cut."""
        from aiohttp import web

        while self.muted:
            await asyncio.sleep(0.02)
        stream = web.StreamResponse(headers={"Content-Type": "application/x-ndjson"})
        await stream.prepare(request)
        self._stream = stream
        self.num_connections += 1
        if self.settings is not None:
            self.start_inventory()
        try:
            while self._stream is stream and request.transport is not None and not request.transport.is_closing():
                await asyncio.sleep(0.02)
        finally:
            if self._stream is stream:
                self._stream = None
                await self.stop_inventory()
        return stream


def _stamp(time_ns: int) -> str:
    """ISO 8601 with nanoseconds, UTC."""
    seconds, rest = divmod(time_ns, 10**9)
    moment = dt.datetime(1970, 1, 1, tzinfo=dt.UTC) + dt.timedelta(seconds=seconds)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{rest:09d}Z"
