"""Rows of text tables: each row by itself, so that one that cannot be read is rejected and counted, and the others stay."""

from __future__ import annotations

import csv
import dataclasses
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TypeVar

from ...core.errors import RecordingError, RecordingWarning

MAX_REJECTED = 0.5
"""A table of which a larger fraction of rows is rejected is taken for another format."""

_NUM_LINES_SHOWN = 5
_NUM_BYTES_CHECKED = 1 << 16
_MAX_CONTROL_FRACTION = 0.1
_CONTROL_BYTES = bytes(code for code in (*range(32), 127) if chr(code) not in "\t\n\r\f\v\x1b")

PARSING_ERRORS = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    SyntaxError,
    TypeError,
    ValueError,
    csv.Error,
)
"""What Python's parsers of numbers, times, CSV and JSON raise for a text that is none."""

Row = Mapping[str, str]
T = TypeVar("T")


class RowError(ValueError):
    """A row that is not valid; the rejected rows are counted by this message, which therefore holds no value of the row."""


@dataclasses.dataclass
class Rejected:
    """The rejected rows of a file: the line numbers by reason, counted from 1."""

    lines_by_reason: dict[str, list[int]] = dataclasses.field(default_factory=dict)

    def add(self, reason: str, line: int) -> None:
        self.lines_by_reason.setdefault(reason, []).append(line)

    @property
    def count(self) -> int:
        """The number of rejected rows."""
        return sum(map(len, self.lines_by_reason.values()))

    def texts(self) -> list[str]:
        """Each reason with its count and the first lines, the most frequent reason first."""
        ordered = sorted(self.lines_by_reason.items(), key=lambda one: (-len(one[1]), one[0]))
        return [f"{len(lines)}: {reason} ({_line_numbers(lines)})" for reason, lines in ordered]

    def check(self, path: Path, num_rows: int, expected: str) -> None:
        """Raise `RecordingError` for a table without a row, or with too many rejected ones; warn of some rejected ones."""
        reasons = "; ".join(self.texts()[:3])
        if not num_rows:
            raise RecordingError(f"{path}: found no row; expected {expected}.")
        if self.count > MAX_REJECTED * num_rows:
            raise RecordingError(
                f"{path}: {self.count} of {num_rows} rows rejected ({reasons}); expected {expected}. Check format and units."
            )
        if self.count:
            warnings.warn(
                f"{path}: {self.count} of {num_rows} rows rejected ({reasons}).", RecordingWarning, stacklevel=3
            )


def parsed(parse: Callable[[str], T], text: str, line: int, rejected: Rejected) -> T | None:
    """What `parse` makes of the text of a line; None, and the line is rejected, if `parse` raises."""
    try:
        return parse(text)
    except RowError as error:
        rejected.add(str(error), line)
    except KeyError as error:
        rejected.add(f"columns are missing: {error.args[0]}", line)
    except PARSING_ERRORS as error:
        rejected.add(f"row cannot be read ({type(error).__name__})", line)
    return None


def read_rows(lines: Iterable[tuple[int, str]], parse: Callable[[str], T], rejected: Rejected) -> list[tuple[int, T]]:
    """What `parse` makes of the lines, with their numbers, without those that it rejects."""
    rows = ((line, parsed(parse, text, line, rejected)) for line, text in lines)
    return [(line, row) for line, row in rows if row is not None]


def text_lines(path: str | Path) -> list[str]:
    """The lines of a UTF-8 text file, without their ends; bytes that are no UTF-8 are replaced.

    A line ends at \\n, \\r\\n or \\r only. Raises `RecordingError` for a file that is missing, cannot be read, is empty or
    is no text.
    """
    path = Path(path)
    try:
        if path.is_dir():
            raise RecordingError(f"{path}: found a folder; expected a text file. Name the file in it.")
        if not path.is_file():
            raise RecordingError(f"{path}: no such file. Check the path.")
        with path.open("rb") as file:
            head = file.read(_NUM_BYTES_CHECKED)
            control = len(head) - len(head.translate(None, _CONTROL_BYTES))
            if control > _MAX_CONTROL_FRACTION * len(head):
                raise RecordingError(
                    f"{path}: found binary data; expected text in UTF-8. Name the table itself, or save it as UTF-8."
                )
            content = head + file.read()
    except (OSError, ValueError) as error:
        if isinstance(error, RecordingError):
            raise
        reason = getattr(error, "strerror", None) or error
        raise RecordingError(f"{path}: cannot be read ({reason}). Check the path and its permissions.") from error
    text = content.decode("utf-8-sig", errors="replace")
    if not text.strip():
        raise RecordingError(f"{path}: found an empty file; expected a table. Copy it again.")
    return text.replace("\r\n", "\n").replace("\r", "\n").split("\n")


def numbered(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """The lines that are not blank, with their numbers counted from 1."""
    return ((number, line) for number, line in enumerate(lines, start=1) if line.strip())


def csv_fields(line: str, delimiter: str = ",") -> list[str]:
    """The fields of one line of CSV. A quotation mark that is not closed ends with its line. Raises `RowError`."""
    try:
        return next(csv.reader([line], delimiter=delimiter, skipinitialspace=True))
    except csv.Error as error:
        raise RowError("row is not CSV") from error


def csv_row(columns: Sequence[str], line: str, delimiter: str = ",") -> Row:
    """One line of CSV as values by column. Raises `RowError`."""
    return dict(zip(columns, csv_fields(line, delimiter), strict=False))


def csv_header(path: Path, line: str, required: Iterable[str], delimiter: str = ",") -> list[str]:
    """The columns that a header names. Raises `RecordingError` if a required one is missing or repeated."""
    try:
        columns = [name.strip() for name in csv_fields(line, delimiter)]
    except RowError as error:
        raise RecordingError(f"{path}: the header is not CSV ({line[:120]!r}). Copy the file again.") from error
    missing = sorted(set(required) - set(columns))
    if missing:
        raise RecordingError(
            f"{path}: columns {', '.join(missing)} are missing; found {shortened(', '.join(columns))}. Correct the header."
        )
    repeated = sorted(name for name in set(required) if columns.count(name) > 1)
    if repeated:
        raise RecordingError(f"{path}: column {repeated[0]} is there twice; expected it once. Remove or rename one.")
    return columns


def shortened(text: str, length: int = 120) -> str:
    """The text as a quoted Python literal, in which control characters are escaped, of a limited length."""
    return repr(text if len(text) <= length else f"{text[:length]}...")


def _line_numbers(lines: Sequence[int]) -> str:
    first = ", ".join(map(str, lines[:_NUM_LINES_SHOWN]))
    return f"line{'s' if len(lines) > 1 else ''} {first}{', ...' if len(lines) > _NUM_LINES_SHOWN else ''}"
