"""Results as JSON, CSV and Markdown tables. A file is written whole or not at all."""

from __future__ import annotations

import csv
import io
import json
import math
import re
import reprlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .files import write_atomic

_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)(e[+-]?\d+)?|[+-]?(inf|nan)", re.IGNORECASE)


def write_json(path: str | Path, content: Any) -> None:
    """Write JSON; NaN and infinity become null."""
    write_atomic(path, json.dumps(to_json_values(content), indent=2) + "\n")


def to_json_values(content: Any) -> Any:
    """The content as numbers, strings, lists and dictionaries only; values that are not finite become None."""
    if isinstance(content, Mapping):
        return {str(key): to_json_values(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [to_json_values(value) for value in content]
    if isinstance(content, np.ndarray):
        return to_json_values(content.tolist())
    if isinstance(content, np.generic):
        return to_json_values(content.item())
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content


def write_csv(path: str | Path, header: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a CSV file with one header row; None becomes an empty cell.

    A text that a spreadsheet would take for a formula (`=1+1`) begins with an apostrophe in the file.
    """
    text = io.StringIO(newline="")
    writer = csv.writer(text)
    writer.writerow(header)
    writer.writerows([_cell(value) for value in row] for row in rows)
    write_atomic(path, text.getvalue())


def _cell(value: Any) -> Any:
    if isinstance(value, str) and value.startswith(("=", "+", "-", "@", "\t", "\r")) and not _NUMBER.fullmatch(value):
        return f"'{value}"
    return "" if value is None else value


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """A Markdown table; None becomes "-". Raises `ValueError` for a row of another length than the header."""
    lines = ["| " + " | ".join(header) + " |", "|" + "---|" * len(header)]
    for row in rows:
        if len(row) != len(header):
            raise ValueError(f"A table row has {len(row)} cells; expected {len(header)}, one for each heading.")
        lines.append("| " + " | ".join("-" if cell is None else str(cell) for cell in row) + " |")
    return "\n".join(lines)


def finite_array(value: Any, shape: tuple[int, ...], name: str) -> np.ndarray:
    """Nested lists of numbers from a JSON file as float64. Raises `ValueError` unless they are finite and of this shape."""
    try:
        array = np.asarray(value)
    except ValueError:  # lists of different lengths
        array = np.asarray(None)
    if array.dtype.kind not in "iuf" or array.shape != shape or not np.all(np.isfinite(array)):
        raise ValueError(f"{name} is {reprlib.repr(value)}; expected finite numbers of shape {shape}.")
    return array.astype(np.float64)
