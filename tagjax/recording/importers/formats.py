"""RFID table formats: how each is recognised and how a row becomes a read. To add one, add an entry to `FORMATS`."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import itertools
import json
from collections.abc import Callable, Sequence

from .read_values import (
    Read,
    clean_epc,
    codes_rad,
    degrees_rad,
    integer,
    microseconds_ns,
    number,
    radians_rad,
    stamp_ns,
)
from .rows import Row, RowError, csv_fields, csv_row


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
    except (ValueError, RecursionError) as error:
        raise RowError("line is not JSON") from error
    if not isinstance(event, dict) or not isinstance(event.get("tagInventoryEvent"), dict):
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


@dataclasses.dataclass(frozen=True)
class Format:
    """A table format: the columns that identify it, how a row becomes a read, and where the header is.

    `layout` is "csv" (the first line is the header), "commented_csv" (of the first lines, which begin with //, the last is
    the header) or "json_lines" (each line is an event; there is no header).
    """

    name: str
    columns: frozenset[str]
    read: Callable[[Row], Read]
    layout: str = "csv"

    def row_parser(self, lines: Sequence[tuple[int, str]]) -> tuple[Callable[[str], Row], Sequence[tuple[int, str]]]:
        """The function that splits a line into values by column, and the lines of the rows, numbered as `lines` are.

        Raises `RowError` if the header is missing, is not CSV or has a column twice; the function raises it for a line.
        """
        if self.layout == "json_lines":
            return lambda line: {"line": line}, lines
        comments = _first_comments([line for _, line in lines]) if self.layout == "commented_csv" else []
        if self.layout == "commented_csv" and not comments:
            raise RowError("the header is missing: expected a line that begins with //")
        header = comments[-1].lstrip().removeprefix("//").strip() if comments else lines[0][1]
        columns = _column_names(header)
        names = [name.lower() if self.read is _itemtest else name for name in columns]
        if repeated := sorted(name for name in self.columns if names.count(name) > 1):
            raise RowError(f"column {repeated[0]} is there twice; expected it once")
        body = [one for one in lines if not _is_comment(one[1])] if comments else lines[1:]
        return lambda line: csv_row(columns, line), body


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("//")


def _column_names(header: str) -> list[str]:
    return [name.strip().strip('"') for name in csv_fields(header)]


def _first_comments(lines: Sequence[str]) -> list[str]:
    """The comments above the first row. Of later ones none is a header: a damaged row may begin like a comment."""
    return list(itertools.takewhile(_is_comment, lines))


FORMATS: dict[str, Format] = {
    one.name: one
    for one in (
        Format("sllurp", frozenset({"timestamp", "antenna", "epc", "phase_angle", "channel_index"}), _sllurp),
        Format("octane", frozenset({"EPC", "Timestamp", "ChannelInMhz", "PhaseAngleInRadians"}), _octane_simple),
        Format("octane_gesture", frozenset({"EPC", "Time", "Frequency(MHz)", "PhaseAngle(Radian)"}), _octane_gesture),
        Format("tagbeat", frozenset({"EPC", "AntnenaId", "PreciseRssi", "FirstReadTime", "Phase"}), _tagbeat),
        Format("antenna_rail", frozenset({"epc", "antennaIndex", "frequency", "phase", "position"}), _rail),
        Format("itemtest", frozenset({"timestamp", "epc", "frequency", "phaseangle"}), _itemtest, "commented_csv"),
        Format("itemtest_plain", frozenset({"timestamp", "epc", "frequency", "phaseangle"}), _itemtest),
        Format("r700", frozenset({"tagInventoryEvent"}), _r700, "json_lines"),
        Format("sllurp_log", frozenset({"timestamp", "reader", "antenna", "rssi", "epc"}), _sllurp_log),
    )
}


def recognise(lines: Sequence[str]) -> Format | None:
    """The format of a table by its first lines; None if the header fits no format."""
    head = [line.strip() for line in lines[:20] if line.strip()]
    if not head:
        return None
    if any(line.startswith("{") and ("EventType" in line or "eventType" in line) for line in head):
        return FORMATS["r700"]
    comments = _first_comments(head)
    try:
        columns = set(_column_names(comments[-1].removeprefix("//") if comments else head[0]))
    except RowError:
        return None
    low = {name.lower() for name in columns}
    for one in FORMATS.values():
        fits = one.columns <= (low if one.read is _itemtest else columns)
        if fits and one.layout == ("commented_csv" if comments else "csv"):
            return one
    return None
