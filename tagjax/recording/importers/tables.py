"""Import of RFID tables as tag reads: the format is recognised, and rejected rows are counted and reported."""

from __future__ import annotations

import collections
import dataclasses
import math
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from ...core.errors import RecordingError, RecordingWarning
from ..reads import TagReads
from ..recording import ClockAudit
from .clock import MAX_SET_ASIDE, HostTimes, reader_epoch, to_host_clock
from .formats import FORMATS, Format, recognise
from .read_values import Read
from .rows import MAX_REJECTED, Rejected, RowError, numbered, read_rows, shortened, text_lines

_MAX_NUMBER = np.iinfo(np.int16).max
_MAX_TIME_NS = np.iinfo(np.int64).max
_MAX_DOPPLER_HZ = 1e5
_MAX_CARRIER_DIFFERENCE_HZ = 60e6
"""A row whose carrier differs by more from the table's median is rejected; one reader's band spans at most about 100 MHz."""


@dataclasses.dataclass(frozen=True)
class ImportReport:
    """Result of an import: numbers of rows and reads, line numbers of rejected rows by reason, and notes about corrections."""

    format: str
    num_rows: int
    num_reads: int
    rejected_lines: Rejected
    notes: tuple[str, ...]

    @property
    def rejected(self) -> dict[str, int]:
        """The number of rejected rows by reason."""
        return {reason: len(lines) for reason, lines in self.rejected_lines.lines_by_reason.items()}

    def lines(self) -> list[str]:
        """The report as lines of text; of the rejected rows of each reason the first line numbers are given."""
        out = [f"format {self.format}: {self.num_reads} reads of {self.num_rows} rows"]
        out += [f"rejected {text}" for text in self.rejected_lines.texts()]
        return out + list(self.notes)


def import_table(
    path: str | Path,
    *,
    format: str = "auto",
    hop_table_hz: Sequence[float] | None = None,
    carrier_hz: float | None = None,
    clock: Literal["auto", "reader", "arrival"] | float = "auto",
    synthetic_rate_hz: float = 50.0,
) -> tuple[TagReads, ClockAudit | None, ImportReport]:
    """Read an RFID table: `TagReads` in order of host time, a clock audit if the table has both clocks, and a report.

    Args:
        path: the table.
        format: a name in `FORMATS`, or "auto" to recognise the header.
        hop_table_hz: carriers of channel index 1, 2, ... (readers number their own, shuffled hop table).
        carrier_hz: the one carrier of a reader that does not hop.
        clock: "reader" uses the reader's clock as it is, "arrival" the host's; a number of seconds is added to the
            reader's; "auto" converts reader times to the host's clock (`to_host_clock`) if the table has both. Rows whose
            reader time fits no clock are then rejected.
        synthetic_rate_hz: rows of a table without times get times in order, each tag at this rate.

    A row that is not a valid read is rejected, counted and reported with its line number. Raises `RecordingError` for a
    file that is no text, if no format fits, if phases are absent, or if more than half of the rows are rejected.
    """
    path = Path(path)
    lines = text_lines(path)
    chosen = _choose(path, lines, format)
    if chosen.name == "sllurp_log":
        raise RecordingError(
            f"{path}: a sllurp log without phases; expected phase reports. Enable them (impinj_tag_content_selector: "
            "EnableRFPhaseAngle) and record again."
        )
    reads, line_of_read, num_rows, rejected = _reads(path, lines, chosen, hop_table_hz)
    notes: list[str] = []
    times = _times(reads, clock, synthetic_rate_hz, notes)
    carrier, index = _carriers(reads, hop_table_hz, carrier_hz, notes)
    table = TagReads(
        epc=np.array([read.epc for read in reads]),
        time_ns=times.time_ns,
        antenna=np.array([read.antenna for read in reads], np.int16),
        carrier_hz=carrier,
        phase_rad=np.array([read.phase_rad for read in reads], np.float64),
        rssi_dbm=np.array([np.nan if read.rssi_dbm is None else read.rssi_dbm for read in reads], np.float32),
        doppler_hz=np.array([np.nan if read.doppler_hz is None else read.doppler_hz for read in reads], np.float32),
        reader_time_ns=times.reader_ns,
        arrival_time_ns=times.arrival_ns,
        channel_index=index,
        hop_table_hz=tuple(hop_table_hz or ()),
    )
    if not times.usable.all():
        wrong = line_of_read[~times.usable]
        rejected.lines_by_reason["the reader's time fits no clock"] = sorted(wrong.tolist())
        table, line_of_read = table[times.usable], line_of_read[times.usable]
    order = np.argsort(table.time_ns, kind="stable")
    back = int(np.sum(np.diff(table.time_ns) < 0))
    if back:
        notes.append(f"{back} reads were out of order of time and have been sorted")
    table, line_of_read = table[order], line_of_read[order]
    repeated = np.concatenate(
        [
            [False],
            (np.diff(table.time_ns) == 0)
            & (table.epc[1:] == table.epc[:-1])
            & (table.antenna[1:] == table.antenna[:-1])
            & (table.phase_rad[1:] == table.phase_rad[:-1]),
        ]
    )
    if repeated.any():
        rejected.lines_by_reason["repeats the read before it"] = sorted(line_of_read[repeated].tolist())
        table = table[~repeated]
    return table, times.audit, ImportReport(chosen.name, num_rows, table.num_reads, rejected, tuple(notes))


def _reads(
    path: Path, lines: Sequence[str], chosen: Format, hop_table_hz: Sequence[float] | None
) -> tuple[list[Read], np.ndarray, int, Rejected]:
    """The reads of a table, the line number of each, the number of rows, and the rejected rows."""
    rejected = Rejected()
    try:
        split, body = chosen.row_parser(list(numbered(lines)))
    except RowError as error:
        raise RecordingError(f"{path}: {error}. Check format=, or copy the file again.") from error

    def read_row(text: str) -> Read:
        return _checked(chosen.read(split(text)), hop_table_hz)

    found = read_rows(body, read_row, rejected)
    known = [read.carrier_hz for _, read in found if read.carrier_hz is not None]
    if known:
        middle_hz = float(np.median(known))
        far = [abs((read.carrier_hz or middle_hz) - middle_hz) > _MAX_CARRIER_DIFFERENCE_HZ for _, read in found]
        for (line, _), is_far in zip(found, far, strict=True):
            if is_far:
                rejected.add("carrier is outside the band of the other rows", line)
        found = [one for one, is_far in zip(found, far, strict=True) if not is_far]
    for name in ("reader_ns", "host_ns"):  # a few rows without a time do not take it from the others
        lacking = [getattr(read, name) is None for _, read in found]
        if 0 < sum(lacking) <= MAX_SET_ASIDE * len(found):
            for (line, _), is_lacking in zip(found, lacking, strict=True):
                if is_lacking:
                    rejected.add("a time is missing", line)
            found = [one for one, is_lacking in zip(found, lacking, strict=True) if not is_lacking]
    if len(found) < (1 - MAX_REJECTED) * len(body) or not found:
        reasons = "; ".join(rejected.texts()[:3]) or "no row"
        raise RecordingError(
            f"{path}: {len(body) - len(found)} of {len(body)} rows are not valid {chosen.name} reads ({reasons}). Check format "
            "and units; set format= to one of " + ", ".join(FORMATS) + "."
        )
    return [read for _, read in found], np.array([line for line, _ in found]), len(body), rejected


def _choose(path: Path, lines: list[str], name: str) -> Format:
    if name != "auto":
        if name not in FORMATS:
            raise RecordingError(f"Unknown format {name!r}; expected auto or one of {', '.join(FORMATS)}.")
        return FORMATS[name]
    found = recognise(lines)
    if found is None:
        head = next((line for line in lines if line.strip()), "")
        raise RecordingError(
            f"{path}: found no known header (first line: {shortened(head)}). Known formats: {', '.join(FORMATS)}; set format= if it is one."
        )
    return found


def _checked(read: Read, hop_table_hz: Sequence[float] | None) -> Read:
    """The read, if its values are within their domains. Raises `RowError`."""
    if read.phase_rad is None:
        raise RowError("phase is absent")
    if not 1 <= read.antenna <= _MAX_NUMBER:
        raise RowError(f"antenna is outside 1 to {_MAX_NUMBER}")
    if read.channel_index is not None and not 0 <= read.channel_index <= _MAX_NUMBER:
        raise RowError(f"channel index is outside 0 to {_MAX_NUMBER}")
    if any(stamp is not None and not 0 <= stamp <= _MAX_TIME_NS for stamp in (read.reader_ns, read.host_ns)):
        raise RowError("time is outside 1970 to 2262: wrong unit?")
    if read.rssi_dbm is not None and not -120 <= read.rssi_dbm <= 20:
        raise RowError("RSSI is outside -120 to 20 dBm: wrong unit?")
    if read.carrier_hz is not None and not 300e6 <= read.carrier_hz <= 6e9:
        raise RowError("carrier is outside 0.3 to 6 GHz: wrong unit?")
    if read.doppler_hz is not None and abs(read.doppler_hz) > _MAX_DOPPLER_HZ:
        raise RowError(f"Doppler shift is outside -{_MAX_DOPPLER_HZ:g} to {_MAX_DOPPLER_HZ:g} Hz: wrong unit?")
    if hop_table_hz is None or read.carrier_hz is not None or read.channel_index is None:
        return read
    if not 1 <= read.channel_index <= len(hop_table_hz):
        raise RowError(f"channel index is outside the hop table, which has entries 1 to {len(hop_table_hz)}")
    return read


@dataclasses.dataclass(frozen=True)
class _Times:
    """Times of a table's rows: those to use, and the raw ones."""

    time_ns: np.ndarray  # (num_rows,) int64
    usable: np.ndarray  # (num_rows,) bool
    reader_ns: np.ndarray | None
    arrival_ns: np.ndarray | None
    audit: ClockAudit | None


def _times(reads: list[Read], clock: str | float, rate_hz: float, notes: list[str]) -> _Times:
    def column(name: str) -> np.ndarray | None:
        values = [getattr(read, name) for read in reads]
        return None if any(value is None for value in values) else np.array(values, np.int64)

    reader, arrival = column("reader_ns"), column("host_ns")
    all_rows = np.ones(len(reads), bool)
    if reader is None and arrival is None:
        counts: collections.Counter[str] = collections.Counter()
        stamps = []
        for read in reads:
            stamps.append(round(counts[read.epc] / rate_hz * 1e9))
            counts[read.epc] += 1
        warnings.warn(
            f"The table has no times: reads get times in order, {rate_hz:g} a second for each tag.",
            RecordingWarning,
            stacklevel=4,
        )
        notes.append(f"no times in the table: set in order at {rate_hz:g} reads/s per tag")
        return _Times(np.array(stamps, np.int64), all_rows, None, None, None)
    # One wrong time does not make a clock that was never set.
    if reader is not None and (epoch := reader_epoch(np.sort(reader)[len(reader) // 10 :])) != "unix":
        note = f"the reader's clock was never set: it started in {epoch}"
        warnings.warn(note[0].upper() + note[1:] + ".", RecordingWarning, stacklevel=4)
        notes.append(note)
    compared = _compare_clocks(reader, arrival, required=clock == "auto", notes=notes)
    audit = None if compared is None else compared.audit
    if isinstance(clock, int | float) and not isinstance(clock, bool):
        if reader is None:
            raise RecordingError(f"clock={clock}: an offset is added to the reader's clock, which this table lacks.")
        return _Times(_shifted(reader, clock), all_rows, reader, arrival, audit)
    if clock == "arrival" or reader is None:
        if arrival is None:
            raise RecordingError("clock=arrival: the table has no arrival times. Use clock=reader or an offset.")
        return _Times(arrival, all_rows, reader, arrival, audit)
    if clock == "auto" and compared is not None:
        notes += _clock_notes(compared.audit)
        return _Times(compared.time_ns, compared.usable, reader, arrival, audit)
    return _Times(reader, all_rows, reader, arrival, audit)


def _compare_clocks(
    reader: np.ndarray | None, arrival: np.ndarray | None, *, required: bool, notes: list[str]
) -> HostTimes | None:
    """The comparison of both clocks; None without both. A fault is an error if `required`, otherwise a note."""
    if reader is None or arrival is None or len(reader) < 2:
        return None
    try:
        return to_host_clock(reader, arrival)
    except RecordingError as error:
        if required:
            raise
        notes.append(f"the two clocks of the table do not agree: {error}")
        return None


def _shifted(reader: np.ndarray, seconds: float) -> np.ndarray:
    """Reader times plus an offset. Raises `RecordingError` for an offset that leaves the range of times."""
    offset_ns = round(seconds * 1e9) if math.isfinite(seconds) else _MAX_TIME_NS + 1
    if not (int(reader.min()) + offset_ns >= 0 and int(reader.max()) + offset_ns <= _MAX_TIME_NS):
        raise RecordingError(f"clock={seconds}: times would lie outside 1970 to 2262; expected seconds to add.")
    return reader + offset_ns


def _clock_notes(audit: ClockAudit) -> list[str]:
    """How the reader's times were converted to the host's clock, in a line for each piece."""
    notes = []
    for number, piece in enumerate(audit.pieces, 1):
        low, high = piece.offset_interval_s
        drift = "too short for a drift"
        if piece.drift_interval_ppm is not None:
            low_ppm, high_ppm = piece.drift_interval_ppm
            drift = f"drift {piece.drift_ppm:.1f} ppm (95 %: {low_ppm:.1f} to {high_ppm:.1f})"
        which = f" (piece {number} of {len(audit.pieces)}, {piece.num_reads} reads)" if len(audit.pieces) > 1 else ""
        notes.append(
            f"reader times converted to the host's clock{which}: offset {piece.offset_s:.4f} s (95 %: {low:.4f} to {high:.4f}), "
            f"{drift}"
        )
    if len(audit.pieces) > 1:
        count = len(audit.pieces) - 1
        notes.append(f"a clock was set anew or restarted {count} time{'s' if count > 1 else ''}")
    return notes


def _carriers(
    reads: list[Read], hop_table_hz: Sequence[float] | None, carrier_hz: float | None, notes: list[str]
) -> tuple[np.ndarray, np.ndarray | None]:
    carrier = np.array([np.nan if read.carrier_hz is None else read.carrier_hz for read in reads])
    index = None
    if all(read.channel_index is not None for read in reads):
        index = np.array([read.channel_index for read in reads], np.int16)
    unknown = np.isnan(carrier)
    if unknown.any() and hop_table_hz is not None and index is not None:
        carrier = np.where(unknown, np.asarray(hop_table_hz, float)[np.where(unknown, index, 1) - 1], carrier)
    elif unknown.any() and carrier_hz is not None:
        carrier = np.where(unknown, carrier_hz, carrier)
    elif unknown.any():
        note = "carriers are unknown: give the reader's own hop table (hop_table_hz) or its one carrier (carrier_hz)"
        warnings.warn(note[0].upper() + note[1:] + ".", RecordingWarning, stacklevel=4)
        notes.append(note)
    return carrier, index
