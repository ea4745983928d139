"""RFID table formats: how each is recognised and how a row becomes a read. To add one, add an entry to `FORMATS`."""

from __future__ import annotations

import ast
import base64
import binascii
import csv
import dataclasses
import datetime as dt
import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

TURN = 2 * math.pi
CODES = 4096


@dataclasses.dataclass
class Read:
    """One row in canonical units; None where the format has no such column."""

    epc: str
    reader_ns: int | None = None  # nanoseconds of the reader's clock
    host_ns: int | None = None  # nanoseconds of the host's clock
    antenna: int = 1
    carrier_hz: float | None = None
    channel_index: int | None = None
    phase_rad: float | None = None
    rssi_dbm: float | None = None
    doppler_hz: float | None = None


class RowError(ValueError):
    """A row that is no read; the message is the reason that is counted."""


Row = Mapping[str, str]


def _number(row: Row, name: str) -> float:
    try:
        value = float(row[name])
    except (KeyError, TypeError, ValueError) as error:
        raise RowError(f"{name} is no number") from error
    if not math.isfinite(value):
        raise RowError(f"{name} is not finite")
    return value


def _whole(row: Row, name: str) -> int:
    try:
        return int(row[name])
    except (KeyError, TypeError, ValueError) as error:
        raise RowError(f"{name} is no whole number") from error


def clean_epc(text: str | None) -> str:
    """An EPC in upper-case hex: spaces and the b'...' of printed Python bytes are taken off."""
    cleaned = (text or "").strip()
    if re.fullmatch(r"b(['\"]).*\1", cleaned):
        cleaned = ast.literal_eval(cleaned).decode("ascii", "replace")
    cleaned = re.sub(r"[\s-]", "", cleaned).upper()
    if not re.fullmatch(r"[0-9A-F]{4,}", cleaned):
        raise RowError("EPC is no hexadecimal number")
    return cleaned


def stamp_ns(text: str | None) -> int:
    """Nanoseconds since 1970 of an ISO time, or of a number of seconds, milliseconds or microseconds."""
    text = (text or "").strip()
    try:
        value = float(text)
    except ValueError:
        try:
            moment = dt.datetime.fromisoformat(re.sub(r"(\.\d{6})\d+", r"\1", text.replace("Z", "+00:00")))
        except ValueError as error:
            raise RowError("time is neither a number nor ISO") from error
        moment = moment if moment.tzinfo else moment.replace(tzinfo=dt.UTC)
        return int((moment - dt.datetime(1970, 1, 1, tzinfo=dt.UTC)) / dt.timedelta(microseconds=1)) * 1000
    if not math.isfinite(value) or value < 0:
        raise RowError("time is not finite")
    for limit, factor in ((1e11, 10**9), (1e14, 10**6), (1e17, 10**3)):
        if value < limit:
            # Whole numbers stay whole: a float holds 1.7e18 ns to 256 ns only.
            seconds, _, fraction = text.partition(".")
            if seconds.isdigit() and (fraction.isdigit() or not fraction):
                return int(seconds) * factor + round(float(f"0.{fraction or 0}") * factor)
            return round(value * factor)
    return int(value)


def _microseconds_ns(row: Row, name: str) -> int:
    return _whole(row, name) * 1000


def _codes(row: Row, name: str) -> float:
    code = _number(row, name)
    if not 0 <= code < CODES:
        raise RowError(f"{name} is outside 0 to {CODES - 1} codes")
    return code * TURN / CODES


def _radians(row: Row, name: str) -> float:
    phase = _number(row, name)
    if not -1e-6 <= phase <= TURN + 1e-3:
        raise RowError(f"{name} is outside 0 to 2 pi rad")
    return phase % TURN


def _degrees(row: Row, name: str) -> float:
    phase = _number(row, name)
    if not 0 <= phase <= 360.0:
        raise RowError(f"{name} is outside 0 to 360 degrees")
    return math.radians(phase) % TURN


def _sllurp(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["epc"]),
        host_ns=stamp_ns(row["timestamp"]),
        antenna=_whole(row, "antenna"),
        channel_index=_whole(row, "channel_index"),
        phase_rad=_codes(row, "phase_angle"),
        rssi_dbm=_number(row, "rssi"),
        doppler_hz=_number(row, "doppler_frequency") / 16,
    )


def _sllurp_log(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["epc"]),
        host_ns=stamp_ns(row["timestamp"]),
        antenna=_whole(row, "antenna"),
        rssi_dbm=_number(row, "rssi"),
    )


def _octane_simple(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["EPC"]),
        reader_ns=_microseconds_ns(row, "Timestamp"),
        carrier_hz=_number(row, "ChannelInMhz") * 1e6,
        phase_rad=_radians(row, "PhaseAngleInRadians"),
        rssi_dbm=_number(row, "PeakRssiInDbm"),
    )


def _octane_gesture(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["EPC"]),
        reader_ns=_microseconds_ns(row, "Time"),
        host_ns=stamp_ns(row["UNIX_time"]) if row.get("UNIX_time") else None,
        antenna=_whole(row, "Antenna"),
        carrier_hz=_number(row, "Frequency(MHz)") * 1e6,
        phase_rad=_radians(row, "PhaseAngle(Radian)"),
        rssi_dbm=_number(row, "RSS(dbm)"),
        doppler_hz=_number(row, "DopplerShift(Hz)"),
    )


def _itemtest(row: Row) -> Read:
    low = {name.lower(): value for name, value in row.items() if name}
    frequency = _number(low, "frequency")
    return Read(
        epc=clean_epc(low["epc"]),
        reader_ns=stamp_ns(low["timestamp"]),
        antenna=_whole(low, "antenna"),
        carrier_hz=frequency * (1e6 if frequency < 1e4 else 1e3),
        phase_rad=_radians(low, "phaseangle"),
        rssi_dbm=_number(low, "rssi"),
        doppler_hz=_number(low, "dopplerfrequency"),
    )


def _tagbeat(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["EPC"]),
        reader_ns=_microseconds_ns(row, "FirstReadTime"),
        host_ns=_whole(row, "Timestamp") * 10**6,
        antenna=_whole(row, "AntnenaId"),
        channel_index=_whole(row, "ChannelIndex"),
        phase_rad=_codes(row, "Phase"),
        rssi_dbm=_number(row, "PreciseRssi") / 100,
        doppler_hz=_number(row, "Doppler") / 16,
    )


def _rail(row: Row) -> Read:
    return Read(
        epc=clean_epc(row["epc"]),
        antenna=_whole(row, "antennaIndex"),
        carrier_hz=_number(row, "frequency"),
        phase_rad=_radians(row, "phase"),
        rssi_dbm=_number(row, "RSSI"),
        doppler_hz=_number(row, "dopplerShift"),
    )


def _r700(row: Row) -> Read:
    try:
        event = json.loads(row["line"])
    except json.JSONDecodeError as error:
        raise RowError("line is no JSON") from error
    if not isinstance(event, dict) or "tagInventoryEvent" not in event:
        raise RowError("event is no tag inventory")
    tag = {name: str(value) for name, value in event["tagInventoryEvent"].items()}
    epc = tag.get("epcHex")
    if epc is None:
        coded = tag.get("epc", "")
        try:
            epc = base64.urlsafe_b64decode(coded + "=" * (-len(coded) % 4)).hex()
        except (binascii.Error, ValueError) as error:
            raise RowError("EPC is no base64url") from error
    if "phaseAngle" not in tag:
        raise RowError("phaseAngle is absent: enable it in the reader's eventConfig")
    return Read(
        epc=clean_epc(epc),
        reader_ns=stamp_ns(tag.get("lastSeenTime", str(event.get("timestamp", "")))),
        host_ns=None,
        antenna=_whole(tag, "antennaPort"),
        carrier_hz=_number(tag, "frequency") * 1e3,
        phase_rad=_degrees(tag, "phaseAngle"),
        rssi_dbm=_number(tag, "peakRssiCdbm") / 100,
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
    """A table format: columns that tell it, how its lines become rows, how a row becomes a read."""

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
    """The format of a table by its first lines; None if no header fits."""
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
