"""Readers over LLRP and REST: every read once, as it was; and streams that outlive what happens to connections."""

from __future__ import annotations

import asyncio
import dataclasses
import json
import math
import struct
import time
from collections.abc import Awaitable, Callable
from typing import Any

import numpy as np
import pytest
from capture_scenes import EMULATORS, ORIGIN_NS, QUICK, Taken, connect, keys, reads_table, take

from tagjax.core.errors import RecordingError
from tagjax.recording.capture.emulation import EmulatorSettings
from tagjax.recording.capture.llrp import LlrpReader, captured_read
from tagjax.recording.capture.r700 import LineSplitter, R700Reader, TlsSettings, captured_line
from tagjax.recording.capture.reader import InventorySettings
from tagjax.recording.capture.reads import CapturedRead, ReaderError, ReaderEvent, as_tag_reads

BOTH = pytest.mark.parametrize("kind", ["llrp", "r700"])
NETWORK = EmulatorSettings(drift_ppm=200.0, jitter_s=0.02)


def run(test: Awaitable[Any], limit_s: float = 20.0) -> Any:
    async def limited() -> Any:
        async with asyncio.timeout(limit_s):
            return await test

    return asyncio.run(limited())


@BOTH
def test_reads_through_sockets_are_those_of_the_recording(kind: str) -> None:
    table = reads_table(1.5, 450.0)

    async def test() -> tuple[Taken, np.ndarray]:
        async with EMULATORS[kind](table, ORIGIN_NS, settings=NETWORK) as emulator:
            taken = await take(connect(emulator), lambda one: len(one.reads) >= table.num_reads, start=emulator.start)
            return taken, emulator.host_time_ns(np.arange(table.num_reads))

    taken, true_ns = run(test())
    found = as_tag_reads(taken.reads, taken.infos[0].hop_table_hz)
    assert taken.kinds() == ["connected"]
    assert found.num_reads == table.num_reads
    assert len(set(keys(taken.reads))) == table.num_reads
    np.testing.assert_array_equal(found.epc, table.epc)
    np.testing.assert_array_equal(found.antenna, table.antenna)
    np.testing.assert_array_equal(found.carrier_hz, table.carrier_hz)
    np.testing.assert_allclose(found.phase_rad, table.phase_rad, atol=1e-9)
    np.testing.assert_allclose(found.rssi_dbm, table.rssi_dbm, atol=1e-4)
    if kind == "llrp":  # the REST interface has neither
        np.testing.assert_array_equal(found.channel_index, table.channel_index)
        np.testing.assert_allclose(found.doppler_hz, table.doppler_hz, atol=1e-6)
        assert found.hop_table_hz == table.hop_table_hz
    assert np.all(found.time_ns >= true_ns)
    assert np.all(np.diff(found.time_ns) >= 0)
    # The reader's clock: 200 ppm too fast, an hour behind, in whole microseconds.
    shown = (found.reader_time_ns - true_ns) * 1e-9 + 3600.0
    np.testing.assert_allclose(shown, (true_ns - true_ns[0] + table.time_ns[0] - ORIGIN_NS) * 2e-13, atol=2e-6)


@BOTH
def test_a_begin_that_is_noticed_late_loses_no_read(kind: str) -> None:
    """The loop stands still when the playback begins, as on a busy machine."""
    table = reads_table(0.3, 450.0)

    async def test() -> Taken:
        async with EMULATORS[kind](table, ORIGIN_NS) as emulator:
            taken, begin = Taken(), emulator.start.begin

            def late() -> None:
                begin()
                time.sleep(0.3)

            emulator.start.begin = late
            return await take(
                connect(emulator), lambda one: len(one.reads) >= table.num_reads, start=emulator.start, taken=taken
            )

    assert len(run(test(), 5.0).reads) == table.num_reads


@BOTH
def test_a_tag_that_no_reader_can_report_is_refused(kind: str) -> None:
    table = reads_table(0.1)
    for epc in ("tag-a", "E28", "e280", ""):
        with pytest.raises(RecordingError, match="upper-case hexadecimal"):
            EMULATORS[kind](dataclasses.replace(table, epc=np.full(table.num_reads, epc)), ORIGIN_NS)


async def _faulty(
    kind: str, fault: Callable[[Any], Awaitable[None]], duration_s: float = 30.0
) -> tuple[Taken, Any, int]:
    """A stream in which a fault happens after 50 reads, taken until 50 reads more have come after a new connection."""
    taken = Taken()
    async with EMULATORS[kind](reads_table(duration_s, 200.0), ORIGIN_NS) as emulator:

        def later(one: Taken) -> bool:
            return one.kinds().count("connected") > 1 and len(one.reads) > before + 50

        before = 1 << 30
        reading = asyncio.create_task(take(connect(emulator), later, start=emulator.start, taken=taken))
        while len(taken.reads) < 50:
            await asyncio.sleep(0.01)
        await fault(emulator)
        before = len(taken.reads)
        await reading
    return taken, emulator, before


@BOTH
@pytest.mark.parametrize("half", [False, True])
def test_a_cut_connection_is_reported_and_made_again(kind: str, half: bool) -> None:
    taken, emulator, before = run(_faulty(kind, lambda one: one.cut(half_message=half)))
    assert len(taken.reads) > before + 20
    lost = next(event for event in taken.events if event.kind == "lost")
    assert emulator.num_connections == 2
    assert taken.kinds().count("lost") == 1
    assert lost.text.startswith(("LLRP reader", "R700"))
    assert len(set(keys(taken.reads))) == len(taken.reads)
    # What was sent up to the last read has arrived, but for what was on its way as the connection was cut: reads in a row,
    # of which a busy host loses more.
    sent = sorted({emulator.clock_ns(row) for row in emulator.sent})
    arrived = {read.reader_time_ns for read in taken.reads}
    assert arrived <= set(sent)
    missing = [number for number, time_ns in enumerate(sent) if time_ns not in arrived and time_ns < max(arrived)]
    assert np.all(np.diff(missing) == 1)
    assert sent[0] in arrived


@BOTH
def test_an_unplugged_reader_is_noticed_by_its_silence(kind: str) -> None:
    async def unplug(emulator: Any) -> None:
        emulator.muted = True
        await asyncio.sleep(1.6)
        emulator.muted = False

    taken, emulator, _ = run(_faulty(kind, unplug))
    assert "lost" in taken.kinds()
    assert emulator.num_connections >= 2


@BOTH
def test_a_reader_that_boots_anew_goes_on_with_another_clock(kind: str) -> None:
    taken, _, before = run(_faulty(kind, lambda one: one.reboot(off_s=0.5)))
    assert taken.kinds()[:2] == ["connected", "lost"]
    steps_s = np.diff([read.reader_time_ns for read in taken.reads]) * 1e-9
    assert steps_s.min() == pytest.approx(-1000.0, abs=5.0)
    assert int(np.argmin(steps_s)) + 1 == before


@BOTH
def test_a_flood_arrives_whole(kind: str) -> None:
    table = reads_table(20.0, 200.0)

    async def test() -> Taken:
        async with EMULATORS[kind](table, ORIGIN_NS) as emulator:
            taken = Taken()
            reading = asyncio.create_task(
                take(connect(emulator), lambda one: len(one.reads) >= 1500, start=emulator.start, taken=taken)
            )
            while not taken.reads:
                await asyncio.sleep(0.01)
            await emulator.stop_inventory()
            await emulator.flood(range(1000, 2500))
            return await reading

    taken = run(test())
    flooded = {row.reader_time_ns for row in taken.reads}
    assert len(flooded) == len(taken.reads) >= 1500
    assert set(taken.kinds()) == {"connected"}


@BOTH
def test_a_read_that_is_reported_again_is_counted_and_left_out(kind: str) -> None:
    async def test() -> Taken:
        async with EMULATORS[kind](reads_table(5.0, 100.0), ORIGIN_NS) as emulator:
            emulator.start.begin()
            taken = Taken()
            reading = asyncio.create_task(
                take(connect(emulator), lambda one: one.kinds().count("duplicate") == 5, taken=taken)
            )
            while len(taken.reads) < 5:
                await asyncio.sleep(0.01)
            await emulator.send(emulator.sent[:5])
            return await reading

    taken = run(test())
    assert len(set(keys(taken.reads))) == len(taken.reads)


@BOTH
def test_a_reader_that_is_not_there_yet_is_waited_for(kind: str) -> None:
    async def test() -> Taken:
        emulator = EMULATORS[kind](reads_table(20.0, 100.0), ORIGIN_NS)
        async with emulator:
            pass  # now its port is known, and nobody listens there
        taken = Taken()
        reading = asyncio.create_task(
            take(connect(emulator), lambda one: len(one.reads) > 5, start=emulator.start, taken=taken)
        )
        await asyncio.sleep(0.5)
        async with emulator:
            return await reading

    # Attempts that fail alike are one event.
    assert run(test()).kinds() == ["lost", "connected"]


def test_the_reader_is_stopped_and_kept_alive() -> None:
    async def test() -> Any:
        async with EMULATORS["llrp"](reads_table(30.0, 100.0), ORIGIN_NS) as emulator:
            quick = connect(emulator)
            await take(quick, lambda one: len(one.reads) > 120, start=emulator.start)
            return emulator

    emulator = run(test())
    assert emulator.num_keepalive_acks >= 2  # every 0.4 s for 1.2 s
    assert emulator._state == ""  # the ROSpec was stopped and deleted


def test_a_second_client_is_refused_and_tries_again() -> None:
    async def test() -> Taken:
        async with EMULATORS["llrp"](reads_table(30.0, 100.0), ORIGIN_NS) as emulator:
            first = Taken()
            reading = asyncio.create_task(
                take(connect(emulator), lambda one: len(one.reads) > 60, start=emulator.start, taken=first)
            )
            while not first.reads:
                await asyncio.sleep(0.01)
            second = await take(connect(emulator), lambda one: len(one.reads) > 5)
            await reading
            return second

    second = run(test())
    assert second.kinds()[0] == "lost"
    assert "refused" in second.events[0].text
    assert second.kinds()[-1] == "connected"


def test_what_the_reader_notifies_is_an_event() -> None:
    from llrpkit.protocol import params

    async def test() -> Taken:
        async with EMULATORS["llrp"](reads_table(30.0, 100.0), ORIGIN_NS) as emulator:
            taken = Taken()
            reading = asyncio.create_task(
                take(connect(emulator), lambda one: len(one.events) > 1, start=emulator.start, taken=taken)
            )
            while not taken.reads:
                await asyncio.sleep(0.01)
            await emulator.notify(antenna_event=params.AntennaEvent(event_type=0, antenna_id=2))
            return await reading

    event = run(test()).events[-1]
    assert event.kind == "reader"
    assert "AntennaEvent" in event.text
    assert "antenna_id=2" in event.text


@pytest.mark.parametrize(
    ("settings", "words"),
    [({"antennas": (1, 9)}, "4 antenna ports"), ({"antennas": (1,), "power_dbm": 2.0}, "below the reader minimum")],
)
def test_settings_that_the_reader_does_not_have_end_the_stream(settings: dict[str, Any], words: str) -> None:
    async def test() -> None:
        async with EMULATORS["llrp"](reads_table(1.0), ORIGIN_NS) as emulator:
            reader = LlrpReader("127.0.0.1", emulator.port, inventory=InventorySettings(**settings), connection=QUICK)
            await take(reader, lambda one: False)

    with pytest.raises(ReaderError, match=words):
        run(test())


def test_a_refused_password_ends_the_stream_and_is_sent_where_it_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    from aiohttp import web

    asked = []

    async def refuse(request: web.Request) -> web.Response:
        asked.append(request.headers.get("Authorization"))
        return web.Response(status=401)

    async def test() -> None:
        app = web.Application()
        app.router.add_get("/api/v1/status", refuse)
        runner = web.AppRunner(app)
        await runner.setup()
        try:
            await web.TCPSite(runner, "127.0.0.1", 0).start()
            await take(R700Reader(f"http://127.0.0.1:{runner.addresses[0][1]}", connection=QUICK), lambda one: False)
        finally:
            await runner.cleanup()

    monkeypatch.delenv("TAGJAX_READER_USER", raising=False)
    with pytest.raises(ReaderError, match="TAGJAX_READER_PASSWORD"):
        run(test())
    monkeypatch.setenv("TAGJAX_READER_USER", "root")
    monkeypatch.setenv("TAGJAX_READER_PASSWORD", "secret")
    with pytest.raises(ReaderError, match="HTTP 401"):
        run(test())
    assert asked == [None, "Basic cm9vdDpzZWNyZXQ="]  # root:secret


def test_emulators_listen_on_loopback_only() -> None:
    async def test() -> list[str]:
        hosts = []
        async with EMULATORS["llrp"](reads_table(1.0), ORIGIN_NS) as llrp:
            hosts += [one.getsockname()[0] for one in llrp._server.sockets]
        async with EMULATORS["r700"](reads_table(1.0), ORIGIN_NS) as r700:
            hosts += [one[0] for one in r700._runner.addresses]
        return hosts

    assert set(run(test())) == {"127.0.0.1"}


def _custom(subtype: int, value: bytes) -> bytes:
    return struct.pack(">HHII", 1023, 12 + len(value), 25882, subtype) + value


def test_a_report_made_by_hand_from_the_standard_is_decoded() -> None:
    """LLRP 1.0.1, 16.2.7.3 (TagReportData and its TV parameters), and Impinj's custom parameters 56, 57 and 68."""
    from llrpkit.protocol import decode_message

    epc = bytes.fromhex("E28011000000000000000ABC")
    inner = bytes([0x80 | 13]) + epc + struct.pack(">BH", 0x80 | 1, 2) + struct.pack(">Bb", 0x80 | 6, -61)
    inner += struct.pack(">BH", 0x80 | 7, 3) + struct.pack(">BQ", 0x80 | 3, 1_234_567_890)  # uptime, us
    inner += (
        _custom(56, struct.pack(">H", 1024))
        + _custom(57, struct.pack(">h", -6150))
        + _custom(68, struct.pack(">h", -40))
    )
    data = struct.pack(">HH", 240, 4 + len(inner)) + inner
    message = struct.pack(">HII", (1 << 10) | 61, 10 + len(data), 7) + data
    decoded: Any = decode_message(message)
    (report,) = decoded.tag_report_datas
    read = captured_read(report, (910e6, 911e6, 912e6), 5)
    assert read == CapturedRead(
        epc="E28011000000000000000ABC",
        antenna=2,
        phase_rad=math.pi / 2,
        reader_time_ns=1_234_567_890_000,
        arrival_time_ns=5,
        rssi_dbm=-61.5,
        doppler_hz=-2.5,
        carrier_hz=912e6,
        channel_index=3,
    )
    report.custom = []
    without = captured_read(report, (), 5)
    assert isinstance(without, ReaderEvent)
    assert without.kind == "malformed"


def _event(**tag: Any) -> bytes:
    values = {"epcHex": "E280AB", "antennaPort": 2, "peakRssiCdbm": -6150, "frequency": 912250, "phaseAngle": 90.0}
    body = {"timestamp": "2026-01-02T03:04:05.123456789Z", "eventType": "tagInventory"}
    return json.dumps(body | {"tagInventoryEvent": {k: v for k, v in (values | tag).items() if v is not None}}).encode()


def test_lines_of_the_rest_stream() -> None:
    read = captured_line(_event(), 5)
    assert isinstance(read, CapturedRead)
    assert (read.epc, read.antenna, read.rssi_dbm, read.carrier_hz) == ("E280AB", 2, -61.5, 912.25e6)
    assert read.phase_rad == pytest.approx(math.pi / 2)
    assert read.reader_time_ns % 10**9 == 123456000  # in microseconds
    assert captured_line(b"\r", 5) is None
    for line in (b"{", b"\xff\xfe", _event(phaseAngle=None), _event(phaseAngle=400.0), _event(antennaPort="x")):
        event = captured_line(line, 5)
        assert isinstance(event, ReaderEvent)
        assert event.kind == "malformed"
    status = captured_line(b'{"eventType": "inventoryStatus", "inventoryStatusEvent": {}}', 5)
    assert isinstance(status, ReaderEvent)
    assert status.kind == "reader"


def test_lines_come_out_of_pieces_whole_and_endless_ones_are_dropped() -> None:
    lines = LineSplitter()
    assert lines.split(b"ab") == []
    assert lines.split(b"c\nde\n\nf") == [b"abc", b"de", b""]
    assert lines.pending == 1
    assert lines.split(b"x" * (1 << 21)) == []
    assert lines.split(b"y" * 10) == []
    assert lines.split(b"z\ngood\n") == [b"good"]
    assert lines.num_dropped == 1 + (1 << 21) + 10 + 1


def test_addresses_and_certificates_are_checked() -> None:
    with pytest.raises(ReaderError, match="https://<host>"):
        R700Reader("192.168.1.10")
    with pytest.raises(ReaderError, match=r"found a user or password in it; .* TAGJAX_READER_USER"):
        R700Reader("https://root:secret@192.168.1.10")
    with pytest.raises(ReaderError, match="PEM"):
        TlsSettings(certificate="/nowhere.pem").context()
    assert TlsSettings().context().check_hostname
    assert not TlsSettings(verify=False).context().verify_mode
    for wrong in ({"antennas": ()}, {"antennas": (0,)}, {"session": 4}, {"power_dbm": 60.0}, {"num_tags": 0}):
        with pytest.raises(ValueError, match="expected"):
            InventorySettings(**wrong)
