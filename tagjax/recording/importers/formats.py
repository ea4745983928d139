"""RFID table formats: how each is recognised and how a row becomes a read. To add one, add an entry to `FORMATS`."""

from __future__ import annotations

import base64
import binascii
import csv
import dataclasses
import json
from collections.abc import Callable, Iterable, Iterator, Sequence

from .read_values import (
    Read,
    Row,
    RowError,
    clean_epc,
    codes_rad,
    degrees_rad,
    integer,
    microseconds_ns,
    number,
    radians_rad,
    stamp_ns,
)


def _sllurp(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["epc"]),
        host_ns=stamp_ns(row["timestamp"]),
        antenna=integer(row, "antenna"),
        channel_index=integer(row, "channel_index"),
        phase_rad=codes_rad(row, "phase_angle"),
        rssi_dbm=number(row, "rssi"),
        doppler_hz=number(row, "doppler_frequency") / 16,
    )


def _sllurp_log(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["epc"]),
        host_ns=stamp_ns(row["timestamp"]),
        antenna=integer(row, "antenna"),
        rssi_dbm=number(row, "rssi"),
    )


def _octane_simple(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["EPC"]),
        reader_ns=microseconds_ns(row, "Timestamp"),
        carrier_hz=number(row, "ChannelInMhz") * 1e6,
        phase_rad=radians_rad(row, "PhaseAngleInRadians"),
        rssi_dbm=number(row, "PeakRssiInDbm"),
    )


def _octane_gesture(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["EPC"]),
        reader_ns=microseconds_ns(row, "Time"),
        host_ns=stamp_ns(row["UNIX_time"]) if row.get("UNIX_time") else None,
        antenna=integer(row, "Antenna"),
        carrier_hz=number(row, "Frequency(MHz)") * 1e6,
        phase_rad=radians_rad(row, "PhaseAngle(Radian)"),
        rssi_dbm=number(row, "RSS(dbm)"),
        doppler_hz=number(row, "DopplerShift(Hz)"),
    )


def _itemtest(row: Row) -> Read:
    low = {name.lower(): value for name, value in row.items() if name}
    frequency = number(low, "frequency")
    return Read(
        epc=clean_epc(low["epc"]),
        reader_ns=stamp_ns(low["timestamp"]),
        antenna=integer(low, "antenna"),
        carrier_hz=frequency * (1e6 if frequency < 1e4 else 1e3),
        phase_rad=radians_rad(low, "phaseangle"),
        rssi_dbm=number(low, "rssi"),
        doppler_hz=number(low, "dopplerfrequency"),
    )


def _tagbeat(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["EPC"]),
        reader_ns=microseconds_ns(row, "FirstReadTime"),
        host_ns=integer(row, "Timestamp") * 10**6,
        antenna=integer(row, "AntnenaId"),
        channel_index=integer(row, "ChannelIndex"),
        phase_rad=codes_rad(row, "Phase"),
        rssi_dbm=number(row, "PreciseRssi") / 100,
        doppler_hz=number(row, "Doppler") / 16,
    )


def _rail(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["epc"]),
        antenna=integer(row, "antennaIndex"),
        carrier_hz=number(row, "frequency"),
        phase_rad=radians_rad(row, "phase"),
        rssi_dbm=number(row, "RSSI"),
        doppler_hz=number(row, "dopplerShift"),
    )


def _r700(row: Row) -> Read:
    try:
        event = json.loads(row["line"])
    except json.JSONDecodeError as error:
        raise RowError("line is not JSON") from error
    if not isinstance(event, dict) or "tagInventoryEvent" not in event:
        raise RowError("event is not a tag inventory")
    tag = {name: str(value) for name, value in event["tagInventoryEvent"].items()}
    epc = tag.get("epcHex")
    if epc is None:
        coded = tag.get("epc", "")
        try:
            epc = base64.urlsafe_b64decode(coded + "=" * (-len(coded) % 4)).hex()
        except (binascii.Error, ValueError) as error:
            raise RowError("EPC is not base64url") from error
    if "phaseAngle" not in tag:
        raise RowError("phaseAngle is absent: enable it in the reader's eventConfig")
    return Read(
        epc=clean_epc(epc),
        reader_ns=stamp_ns(tag.get("lastSeenTime", str(event.get("timestamp", "")))),
        host_ns=None,
        antenna=integer(tag, "antennaPort"),
        carrier_hz=number(tag, "frequency") * 1e3,
        phase_rad=degrees_rad(tag, "phaseAngle"),
        rssi_dbm=number(tag, "peakRssiCdbm") / 100,
    )


def _plain(lines: Sequence[str]) -> Iterator[Row]:
    yield from csv.DictReader(lines, skipinitialspace=True)


def _commented(lines: Sequence[str]) -> Iterator[Row]:
    """The last comment line is the header."""
    comments = [line for line in lines if line.lstrip().startswith("//")]
    body = [line for line in lines if line.strip() and not line.lstrip().startswith("//")]
    yield from csv.DictReader([comments[-1].lstrip().removeprefix("//").strip(), *body], skipinitialspace=True)


def _line_by_line(lines: Sequence[str]) -> Iterator[Row]:
    for line in lines:
        if line.strip():
            yield {"line": line}


@dataclasses.dataclass(frozen=True)
class Format:
    """A table format: the columns that identify it, how lines become rows, how a row becomes a read."""

    name: str
    columns: frozenset[str]
    read: Callable[[Row], Read]
    rows: Callable[[Sequence[str]], Iterable[Row]] = _plain


FORMATS: dict[str, Format] = {
    one.name: one
    for one in (
        Format("sllurp", frozenset({"timestamp", "antenna", "epc", "phase_angle", "channel_index"}), _sllurp),
        Format("octane", frozenset({"EPC", "Timestamp", "ChannelInMhz", "PhaseAngleInRadians"}), _octane_simple),
        Format("octane_gesture", frozenset({"EPC", "Time", "Frequency(MHz)", "PhaseAngle(Radian)"}), _octane_gesture),
        Format("tagbeat", frozenset({"EPC", "AntnenaId", "PreciseRssi", "FirstReadTime", "Phase"}), _tagbeat),
        Format("antenna_rail", frozenset({"epc", "antennaIndex", "frequency", "phase", "position"}), _rail),
        Format("itemtest", frozenset({"timestamp", "epc", "frequency", "phaseangle"}), _itemtest, _commented),
        Format("itemtest_plain", frozenset({"timestamp", "epc", "frequency", "phaseangle"}), _itemtest),
        Format("r700", frozenset({"tagInventoryEvent"}), _r700, _line_by_line),
        Format("sllurp_log", frozenset({"timestamp", "reader", "antenna", "rssi", "epc"}), _sllurp_log),
    )
}


def recognise(lines: Sequence[str]) -> Format | None:
    """The format of a table by its first lines; None if the header fits no format."""
    head = [line.strip() for line in lines[:20] if line.strip()]
    if not head:
        return None
    if head[0].startswith("{"):
        return FORMATS["r700"] if any("EventType" in line or "eventType" in line for line in head) else None
    comments = [line for line in head if line.startswith("//")]
    header = comments[-1].removeprefix("//") if comments else head[0]
    columns = {name.strip().strip('"') for name in next(csv.reader([header], skipinitialspace=True))}
    low = {name.lower() for name in columns}
    for one in FORMATS.values():
        if one.rows is _line_by_line or (one.rows is _commented) != bool(comments):
            continue
        if one.columns <= (low if one.read is _itemtest else columns):
            return one
    return None
