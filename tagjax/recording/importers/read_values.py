"""One row of an RFID table as a read in canonical units, and the conversion of its values."""

from __future__ import annotations

import dataclasses
import datetime as dt
import math
import re

from .rows import Row, RowError

_TURN_RAD = 2 * math.pi
_CODES_PER_TURN = 4096
_MAX_EPC_DIGITS = 124  # 496 bits, the most that EPC Gen2 has


@dataclasses.dataclass
class Read:
    """One read in canonical units; None where the format has no such column."""

    epc: str
    reader_ns: int | None = None  # nanoseconds of the reader's clock
    host_ns: int | None = None  # nanoseconds of the host's clock
    antenna: int = 1
    carrier_hz: float | None = None
    channel_index: int | None = None
    phase_rad: float | None = None
    rssi_dbm: float | None = None
    doppler_hz: float | None = None


def number(row: Row, name: str) -> float:
    """A finite number of a column, in ASCII digits. Raises `RowError`, and `KeyError` without the column."""
    try:
        value = float(_plain_digits(row[name]))
    except (AttributeError, TypeError, ValueError) as error:
        raise RowError(f"{name} is not a number") from error
    if not math.isfinite(value):
        raise RowError(f"{name} is not finite")
    return value


def integer(row: Row, name: str) -> int:
    """An integer of a column, in ASCII digits. Raises `RowError`, and `KeyError` without the column."""
    try:
        return int(_plain_digits(row[name]))
    except (AttributeError, TypeError, ValueError) as error:
        raise RowError(f"{name} is not an integer") from error


def _plain_digits(text: str) -> str:
    """The text. Raises `ValueError` for digits of other scripts and for 1_000, which Python takes for numbers."""
    if not text.isascii() or "_" in text:
        raise ValueError("expected ASCII digits")
    return text


def clean_epc(text: str | None) -> str:
    """An EPC in upper-case hex, without spaces, hyphens and the b'...' of printed Python bytes. Raises `RowError`."""
    cleaned = (text or "").strip()
    if printed := re.fullmatch(r"b(['\"])(.*)\1", cleaned):
        cleaned = printed[2]
    cleaned = re.sub(r"[\s-]", "", cleaned)
    if not re.fullmatch(r"[0-9A-Fa-f]{4,}", cleaned):
        raise RowError("EPC is not hexadecimal")
    if len(cleaned) > _MAX_EPC_DIGITS:
        raise RowError(f"EPC has more than {_MAX_EPC_DIGITS} digits")
    return cleaned.upper()


def stamp_ns(text: str | None) -> int:
    """Nanoseconds since 1970 of an ISO time, or of a number of seconds, milliseconds, microseconds or nanoseconds."""
    text = (text or "").strip()
    try:
        value = float(_plain_digits(text))
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
            # Integers are not converted to float: a float resolves 1.7e18 ns to 256 ns only.
            seconds, _, fraction = text.partition(".")
            if seconds.isdigit() and (fraction.isdigit() or not fraction):
                return int(seconds) * factor + round(float(f"0.{fraction or 0}") * factor)
            return round(value * factor)
    return int(text) if text.isdigit() else int(value)


def microseconds_ns(row: Row, name: str) -> int:
    """Nanoseconds of a column in microseconds. Raises `RowError`."""
    return integer(row, name) * 1000


def codes_rad(row: Row, name: str) -> float:
    """Phase in radians of a column in codes of 1/4096 turn. Raises `RowError`."""
    code = number(row, name)
    if not 0 <= code < _CODES_PER_TURN:
        raise RowError(f"{name} is outside 0 to {_CODES_PER_TURN - 1} codes")
    return code * _TURN_RAD / _CODES_PER_TURN


def radians_rad(row: Row, name: str) -> float:
    """Phase in [0, 2 pi) of a column in radians. Raises `RowError`."""
    phase = number(row, name)
    if not -1e-6 <= phase <= _TURN_RAD + 1e-3:
        raise RowError(f"{name} is outside 0 to 2 pi rad")
    return phase % _TURN_RAD


def degrees_rad(row: Row, name: str) -> float:
    """Phase in [0, 2 pi) of a column in degrees. Raises `RowError`."""
    phase = number(row, name)
    if not 0 <= phase <= 360.0:
        raise RowError(f"{name} is outside 0 to 360 degrees")
    return math.radians(phase) % _TURN_RAD
