"""An emulated Impinj reader that speaks LLRP on loopback; messages are coded by llrpkit (extra `reader`).

It has what a recording needs: the connection event, capabilities with hop table and power table, Octane's extensions,
keep-alives, one ROSpec with its states, a report of each read. Other messages are answered by ERROR_MESSAGE.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Sequence
from typing import Any

from .emulation import LOOPBACK, AbstractEmulator
from .llrp import import_llrpkit
from .reads import HOST_CLOCK

_NUM_ANTENNAS = 4
_HEADER_BYTES = 10
_IMPINJ = 25882
_POWERS_CDBM = range(1000, 3025, 25)
_MODES = (0, 1, 2, 3, 4, 1000, 1002, 1003)


class LlrpEmulator(AbstractEmulator):
    """An LLRP reader at 127.0.0.1; a second client is refused."""

    _server: asyncio.Server | None = None
    _writer: asyncio.StreamWriter | None = None
    _keepalive: asyncio.Task[None] | None = None
    _state = ""  # of the ROSpec: "", "disabled", "enabled", "active"
    num_keepalive_acks = 0

    async def listen(self) -> None:
        """Accept connections at `port`."""
        import_llrpkit()
        self._server = await asyncio.start_server(self._serve, LOOPBACK, self.port)
        self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """End all connections, and accept no more."""
        server, self._server = self._server, None
        if server is not None:
            server.close()
        if self._writer is not None:
            self._writer.close()
        if server is not None:
            await server.wait_closed()
        while self._writer is not None:  # the client's task ends
            await asyncio.sleep(0.001)

    async def send(self, rows: Sequence[int]) -> None:
        """Report these rows, each in a message of its own."""
        if self._writer is None or self.muted:
            return
        self._writer.write(b"".join(self.report(row) for row in rows))
        self.sent += rows
        await self._drain()

    async def cut(self, *, half_message: bool = False) -> None:
        """End the connection at once, after the first half of a report if asked to."""
        writer = self._writer
        if writer is None:
            return
        if half_message:
            message = self.report(0)
            writer.write(message[: len(message) // 2])
            await self._drain()
        writer.close()

    async def notify(self, **event: Any) -> None:
        """Send READER_EVENT_NOTIFICATION with an event, such as antenna_event=params.AntennaEvent(...)."""
        if self._writer is not None:
            self._writer.write(_notification(**event))
            await self._drain()

    def report(self, row: int) -> bytes:
        """RO_ACCESS_REPORT of one row."""
        from llrpkit.protocol import BitStr, impinj, messages, params

        table, reads = self.table, self.table.reads
        stamp_us, epc = self.clock_ns(row) // 1000, bytes.fromhex(str(reads.epc[row]))
        rssi_dbm, doppler_hz = float(reads.rssi_dbm[row]), float(reads.doppler_hz[row])
        data = params.TagReportData(
            epc_parameter=params.EPC_96(epc=epc) if len(epc) == 12 else params.EPCData(epc=BitStr.from_bytes(epc)),
            antenna_id=params.AntennaID(antenna_id=int(reads.antenna[row])),
            channel_index=params.ChannelIndex(channel_index=int(table.channel[row])),
            first_seen_timestamp_utc=params.FirstSeenTimestampUTC(microseconds=stamp_us),
            last_seen_timestamp_utc=params.LastSeenTimestampUTC(microseconds=stamp_us),
            tag_seen_count=params.TagSeenCount(tag_count=1),
        )
        data.custom.append(impinj.ImpinjRFPhaseAngle(phase_angle=int(table.phase_code[row])))
        if math.isfinite(rssi_dbm):
            data.peak_rssi = params.PeakRSSI(peak_rssi=round(rssi_dbm))
            data.custom.append(impinj.ImpinjPeakRSSI(rssi=round(100 * rssi_dbm)))
        if math.isfinite(doppler_hz):
            data.custom.append(impinj.ImpinjRFDopplerFrequency(doppler_frequency=round(16 * doppler_hz)))
        return messages.RO_ACCESS_REPORT(tag_report_datas=[data]).to_bytes(message_id=0)

    async def _drain(self) -> None:
        with contextlib.suppress(ConnectionError):
            if self._writer is not None:
                await self._writer.drain()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """One client, from its connection to its end."""
        from llrpkit.protocol import decode_message, enums, params

        taken = self._writer is not None
        kinds = enums.ConnectionAttemptStatusType
        status = kinds.Failed_A_Client_Initiated_Connection_Already_Exists if taken else kinds.Success
        writer.write(_notification(connection_attempt_event=params.ConnectionAttemptEvent(status=status)))
        if taken:
            writer.close()
            return
        self._writer, self._state = writer, ""
        self.num_connections += 1
        try:
            while True:
                header = await reader.readexactly(_HEADER_BYTES)
                length = int.from_bytes(header[2:6], "big")
                message = decode_message(header + await reader.readexactly(length - _HEADER_BYTES))
                if not self.muted:
                    await self._answer(message)
        except (asyncio.IncompleteReadError, ConnectionError):
            pass
        finally:
            await self._end(writer)

    async def _end(self, writer: asyncio.StreamWriter) -> None:
        try:
            await self.stop_inventory()
            if self._keepalive is not None:
                self._keepalive.cancel()
            self._keepalive = None
            writer.close()
            with contextlib.suppress(ConnectionError):
                await writer.wait_closed()
        finally:
            self._writer = None  # `close` waits for this

    async def _answer(self, message: Any) -> None:
        from llrpkit.protocol import enums, impinj, messages, params

        writer, name = self._writer, type(message).__name__
        assert writer is not None
        good = params.LLRPStatus(status_code=enums.StatusCode.M_Success)
        if isinstance(message, messages.KEEPALIVE_ACK):
            self.num_keepalive_acks += 1
            return
        if name.endswith("_ROSPEC"):
            good = await self._rospec(name, good)
        if isinstance(message, messages.SET_READER_CONFIG) and message.keepalive_spec is not None:
            period_s = 1e-3 * message.keepalive_spec.periodic_trigger_value
            self._keepalive = asyncio.get_running_loop().create_task(self._keep_alive(period_s))
        if isinstance(message, messages.GET_READER_CAPABILITIES):
            answer = self._capabilities(good)
        elif isinstance(message, impinj.IMPINJ_ENABLE_EXTENSIONS):
            answer = impinj.IMPINJ_ENABLE_EXTENSIONS_RESPONSE(llrp_status=good)
        elif (response := getattr(messages, f"{name}_RESPONSE", None)) is not None:
            answer = response(llrp_status=good)
        else:
            code = enums.StatusCode.M_UnsupportedMessage
            answer = messages.ERROR_MESSAGE(llrp_status=params.LLRPStatus(status_code=code, error_description=name))
        writer.write(answer.to_bytes(message_id=message.message_id))
        await self._drain()
        if isinstance(message, messages.CLOSE_CONNECTION):
            writer.close()

    async def _rospec(self, name: str, good: Any) -> Any:
        """Change the state of the ROSpec; the status of the answer, which is an error where the state does not allow it."""
        from llrpkit.protocol import enums, params

        before, after = {
            "ADD_ROSPEC": (("",), "disabled"),
            "ENABLE_ROSPEC": (("disabled",), "enabled"),
            "START_ROSPEC": (("enabled",), "active"),
            "STOP_ROSPEC": (("active",), "enabled"),
            "DELETE_ROSPEC": (("disabled", "enabled", "active"), ""),
        }[name]
        if self._state not in before:
            text = f"{name} while the ROSpec is {self._state or 'absent'}"
            return params.LLRPStatus(status_code=enums.StatusCode.M_ParameterError, error_description=text)
        self._state = after
        if after == "active":
            self.start_inventory()
        else:
            await self.stop_inventory()
        return good

    async def _keep_alive(self, period_s: float) -> None:
        from llrpkit.protocol import messages

        while True:
            await asyncio.sleep(period_s)
            if self._writer is not None and not self.muted:
                self._writer.write(messages.KEEPALIVE().to_bytes(message_id=0))

    def _capabilities(self, status: Any) -> Any:
        from llrpkit.protocol import messages, params

        khz = [round(1e-3 * carrier) for carrier in self.table.hop_table_hz]
        hopping = len(khz) > 1
        modes = [params.C1G2UHFRFModeTableEntry(mode_identifier=mode) for mode in _MODES]
        powers = [
            params.TransmitPowerLevelTableEntry(index=index, transmit_power_value=cdbm)
            for index, cdbm in enumerate(_POWERS_CDBM, start=1)
        ]
        band = params.UHFBandCapabilities(
            transmit_power_level_table_entrys=powers,
            frequency_information=params.FrequencyInformation(
                hopping=hopping,
                frequency_hop_tables=[params.FrequencyHopTable(hop_table_id=1, frequency=khz)] if hopping else [],
                fixed_frequency_table=None if hopping else params.FixedFrequencyTable(frequency=khz),
            ),
            air_protocol_uhfrf_mode_tables=[params.C1G2UHFRFModeTable(c1_g2_uhfrf_mode_table_entrys=modes)],
        )
        return messages.GET_READER_CAPABILITIES_RESPONSE(
            llrp_status=status,
            general_device_capabilities=params.GeneralDeviceCapabilities(
                max_number_of_antenna_supported=_NUM_ANTENNAS,
                has_utc_clock_capability=True,
                device_manufacturer_name=_IMPINJ,
                model_name=2001002,
                reader_firmware_version="emulated",
                receive_sensitivity_table_entrys=[params.ReceiveSensitivityTableEntry(index=1)],
                gpio_capabilities=params.GPIOCapabilities(),
                per_antenna_air_protocols=[
                    params.PerAntennaAirProtocol(antenna_id=port, protocol_id=b"\x01")
                    for port in range(1, _NUM_ANTENNAS + 1)
                ],
            ),
            regulatory_capabilities=params.RegulatoryCapabilities(uhf_band_capabilities=band),
        )


def _notification(**event: Any) -> bytes:
    from llrpkit.protocol import messages, params

    stamp = params.UTCTimestamp(microseconds=HOST_CLOCK.now_ns() // 1000)
    data = params.ReaderEventNotificationData(timestamp=stamp, **event)
    return messages.READER_EVENT_NOTIFICATION(reader_event_notification_data=data).to_bytes(message_id=0)
