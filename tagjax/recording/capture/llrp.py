"""Impinj readers over LLRP 1.0.1 (EPCglobal, 2007): every read with phase angle, peak RSSI and Doppler frequency.

Octane LLRP of Impinj defines the phase angle in 1/4096 turn, the peak RSSI in 1/100 dBm, the Doppler frequency in 1/16 Hz. The
channel index counts from 1 into the hop table of the reader's capabilities. Messages are coded and decoded by llrpkit (extra
`reader`). Tested with the emulator of this package; untested on hardware.
"""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
import math
from collections.abc import AsyncGenerator, Iterator
from typing import TYPE_CHECKING, Any

from .reader import AbstractReader, ConnectionSettings, InventorySettings
from .reads import HOST_CLOCK, CapturedRead, Item, ReaderError, ReaderEvent, ReaderInfo, ReaderLostError

if TYPE_CHECKING:
    import llrpkit

LLRP_PORT = 5084
_TICK_S = 0.25  # events of the reader are looked at so often at least
_ROSPEC = 1
_IMPINJ_SEARCH = {"dual_target": 2, "single_target": 1}


def import_llrpkit() -> Any:
    """The package llrpkit. Raises `ReaderError` where it is not installed."""
    try:
        import llrpkit
    except ImportError as error:
        raise ReaderError(
            f"A package for LLRP is missing ({error}). pip install 'tagjax[reader]' installs it."
        ) from error
    return llrpkit


class LlrpReader(AbstractReader):
    """An Impinj reader (Speedway, R700 in LLRP mode) at host:port. Its ROSpec 1 is replaced."""

    def __init__(
        self,
        host: str,
        port: int = LLRP_PORT,
        *,
        inventory: InventorySettings | None = None,
        connection: ConnectionSettings | None = None,
    ):
        super().__init__(connection or ConnectionSettings())
        self._llrpkit = import_llrpkit()
        self.host, self.port, self.inventory = host, port, inventory or InventorySettings()
        self.name = f"LLRP reader {host}:{port}"

    async def session(self) -> AsyncGenerator[Item, None]:
        """The items of one connection."""
        reader = self._llrpkit.Reader(
            self.host,
            self.port,
            response_timeout=self.connection.timeout_s,
            connect_timeout=self.connection.timeout_s,
        )
        answers = True
        try:
            info = await self._start(reader)
            yield info
            yield ReaderEvent("connected", f"{self.name}: {info.model}, {len(info.hop_table_hz)} channels")
            async with contextlib.aclosing(self._items(reader.client, info.hop_table_hz)) as items:
                async for item in items:
                    yield item
        except self._llrpkit.LLRPStatusError as error:
            raise ReaderError(
                f"{self.name} refuses a setting: {error}. Expected antennas, power_dbm and mode that it has; change these."
            ) from error
        except self._llrpkit.CapabilityError as error:
            raise ReaderError(f"{self.name}: {error}. Change power_dbm.") from error
        except (self._llrpkit.LLRPError, OSError) as error:
            answers = False
            raise error if isinstance(error, ReaderLostError) else ReaderLostError(str(error)) from error
        finally:
            await self._stop(reader, answers)

    async def _start(self, reader: llrpkit.Reader) -> ReaderInfo:
        """Connect, read the capabilities, set keep-alives and events, and start the ROSpec."""
        from llrpkit.client import check_status
        from llrpkit.protocol import messages

        await reader.connect()
        if not reader.is_impinj:
            raise ReaderError(
                f"{self.name}: a reader of manufacturer {reader.capabilities.manufacturer}; expected one of Impinj (25882). "
                "Others report no phase in a way that is known here."
            )
        client = reader.client
        rospec = self._rospec(reader)
        check_status(await client.transact(_reader_config(self.connection.silence_s)))
        with contextlib.suppress(self._llrpkit.LLRPStatusError):  # a model that does not know it reports as it does
            check_status(await client.transact(_low_latency()))
        # What the reader kept from an earlier connection has arrived by now, and stays in the queue of reports.
        with contextlib.suppress(self._llrpkit.LLRPStatusError):  # it has no such ROSpec
            check_status(await client.transact(messages.DELETE_ROSPEC(ro_spec_id=_ROSPEC)))
        check_status(await client.transact(messages.ADD_ROSPEC(ro_spec=rospec)))
        check_status(await client.transact(messages.ENABLE_ROSPEC(ro_spec_id=_ROSPEC)))
        check_status(await client.transact(messages.START_ROSPEC(ro_spec_id=_ROSPEC)))
        return ReaderInfo(
            protocol="llrp",
            model=f"Impinj model {reader.model_number}",
            firmware=reader.firmware,
            hop_table_hz=hop_table_hz(reader.capabilities.raw),
            antennas=self.inventory.antennas,
            power_dbm=self.inventory.power_dbm,
            mode=self.inventory.mode,
            session=self.inventory.session,
        )

    def _rospec(self, reader: llrpkit.Reader) -> Any:
        from llrpkit.inventory import build_rospec

        wanted = self.inventory
        highest = max(wanted.antennas)
        if reader.max_antennas and highest > reader.max_antennas:
            raise ReaderError(
                f"{self.name} has {reader.max_antennas} antenna ports; inventory.antennas names port {highest}. Change it."
            )
        power = None if wanted.power_dbm is None else reader.capabilities.power_index_for_dbm(wanted.power_dbm)
        return build_rospec(
            ro_spec_id=_ROSPEC,
            antennas=wanted.antennas,
            session=wanted.session,
            search_mode=_IMPINJ_SEARCH[wanted.search_mode],
            mode_index=wanted.mode,
            transmit_power_index=power,
            tag_population=wanted.num_tags,
            report_every_n=1,
            enable_impinj_reports=reader.impinj_extensions_enabled,
            include_phase=True,
            include_doppler=True,
        )

    async def _items(self, client: llrpkit.LLRPClient, hop_hz: tuple[float, ...]) -> AsyncGenerator[Item, None]:
        """Reads and events of a running ROSpec."""
        dropped, silent_s, end = 0, 0.0, ""
        while True:
            try:
                async with asyncio.timeout(_TICK_S):
                    report, silent_s = await client.reports.get(), 0.0
            except TimeoutError:
                report, silent_s = None, silent_s + _TICK_S
            if report is not None:
                arrival_ns = HOST_CLOCK.now_ns()
                for data in report.tag_report_datas:
                    yield captured_read(data, hop_hz, arrival_ns)
            if client.dropped_reports > dropped:
                lost, dropped = client.dropped_reports - dropped, client.dropped_reports
                yield ReaderEvent("overflow", f"{lost} reports came faster than they could be taken", count=lost)
            while not client.events.empty():
                for event in _events(client.events.get_nowait()):
                    yield event
                    end = event.text if event.kind == "ended" else end
            if report is None and (end or not client.connected):  # all reports before it are taken
                raise ReaderLostError(end or "the connection was lost")
            if silent_s >= self.connection.silence_s:
                await self._ask(client)
                silent_s = 0.0

    async def _ask(self, client: llrpkit.LLRPClient) -> None:
        """Ask something small of a silent reader. Raises llrpkit's errors where it does not answer."""
        from llrpkit.protocol import enums, messages

        wanted = enums.GetReaderConfigRequestedData.Identification
        question = messages.GET_READER_CONFIG(antenna_id=0, requested_data=wanted, gpi_port_num=0, gpo_port_num=0)
        await client.transact(question, timeout=self.connection.silence_s)

    async def _stop(self, reader: llrpkit.Reader, answers: bool) -> None:
        """Stop and delete the ROSpec where the reader still answers, and close the connection."""
        from llrpkit.protocol import messages

        client = reader.client
        if answers and client.connected:
            with contextlib.suppress(self._llrpkit.LLRPError, OSError):
                await client.transact(messages.STOP_ROSPEC(ro_spec_id=_ROSPEC), timeout=1.0)
                await client.transact(messages.DELETE_ROSPEC(ro_spec_id=_ROSPEC), timeout=1.0)
        await reader.close()


def hop_table_hz(capabilities: Any) -> tuple[float, ...]:
    """The carriers of channel index 1, 2, ... in Hz, from GET_READER_CAPABILITIES_RESPONSE; empty where it has none."""
    regulatory = capabilities.regulatory_capabilities
    band = regulatory.uhf_band_capabilities if regulatory is not None else None
    if band is None:
        return ()
    frequencies = band.frequency_information
    if frequencies.hopping and frequencies.frequency_hop_tables:
        return tuple(1e3 * khz for khz in frequencies.frequency_hop_tables[0].frequency)
    fixed = frequencies.fixed_frequency_table
    return () if fixed is None else tuple(1e3 * khz for khz in fixed.frequency)


def captured_read(data: Any, hop_hz: tuple[float, ...], arrival_ns: int) -> CapturedRead | ReaderEvent:
    """A read from TagReportData; an event of kind "malformed" for one without phase or time."""
    from llrpkit import TagReport

    tag = TagReport.from_param(data)
    # A reader without a UTC clock reports its uptime instead.
    stamp = data.first_seen_timestamp_utc or data.first_seen_timestamp_uptime
    if tag.phase_deg is None or stamp is None:
        what = "phase angle" if tag.phase_deg is None else "time"
        return ReaderEvent("malformed", f"a read of {tag.epc_hex.upper()} without {what}")
    channel = tag.channel_index or 0
    return CapturedRead(
        epc=tag.epc_hex.upper(),
        antenna=tag.antenna or 1,
        phase_rad=math.radians(tag.phase_deg) % (2 * math.pi),
        reader_time_ns=1000 * int(stamp.microseconds),
        arrival_time_ns=arrival_ns,
        rssi_dbm=math.nan if tag.rssi_dbm is None else tag.rssi_dbm,
        doppler_hz=math.nan if tag.doppler_hz is None else tag.doppler_hz,
        carrier_hz=hop_hz[channel - 1] if 0 < channel <= len(hop_hz) else math.nan,
        channel_index=channel,
    )


def _reader_config(keepalive_s: float) -> Any:
    """SET_READER_CONFIG: periodic KEEPALIVE, which llrpkit acknowledges, and the events that are reported."""
    from llrpkit.protocol import enums, messages, params

    wanted = ("ROSpec_Event", "Report_Buffer_Fill_Warning", "Reader_Exception_Event", "Antenna_Event")
    return messages.SET_READER_CONFIG(
        reset_to_factory_default=False,
        keepalive_spec=params.KeepaliveSpec(
            keepalive_trigger_type=enums.KeepaliveTriggerType.Periodic,
            periodic_trigger_value=max(1, round(1e3 * keepalive_s)),
        ),
        reader_event_notification_spec=params.ReaderEventNotificationSpec(
            event_notification_states=[
                params.EventNotificationState(
                    event_type=getattr(enums.NotificationEventType, name), notification_state=True
                )
                for name in wanted
            ]
        ),
    )


def _low_latency() -> Any:
    """SET_READER_CONFIG with Impinj's buffer mode in which each report is sent at once: delays show the clocks' relation."""
    from llrpkit.protocol import impinj, messages

    mode = impinj.ImpinjReportBufferMode.Low_Latency
    message = messages.SET_READER_CONFIG(reset_to_factory_default=False)
    message.custom.append(impinj.ImpinjReportBufferConfiguration(report_buffer_mode=mode))
    return message


def _events(message: Any) -> Iterator[ReaderEvent]:
    """What READER_EVENT_NOTIFICATION says; the end of the ROSpec, and of the connection, are of kind "ended"."""
    from llrpkit.protocol import enums, messages

    if not isinstance(message, messages.READER_EVENT_NOTIFICATION):
        yield ReaderEvent("reader", type(message).__name__)
        return
    data = message.reader_event_notification_data
    for field in dataclasses.fields(data):
        event = getattr(data, field.name)
        if field.name == "timestamp" or event is None or event == []:
            continue
        kind, text = "reader", _text(event)
        if field.name == "connection_close_event":
            kind, text = "ended", "the reader closed the connection"
        elif field.name == "ro_spec_event":
            if int(event.event_type) == int(enums.ROSpecEventType.Start_Of_ROSpec):
                continue
            kind, text = "ended", "the reader ended its ROSpec"
        yield ReaderEvent(kind, text)  # type: ignore[arg-type]


def _text(event: Any) -> str:
    if isinstance(event, list):
        return ", ".join(type(one).__name__ for one in event)
    values = (f"{one.name}={getattr(event, one.name)!s}" for one in dataclasses.fields(event))
    return f"{type(event).__name__}({', '.join(values)})"
