"""Fuzzed tables: each is imported with counts of its rejected rows, or refused in one line, and never takes long.

If one row of a sound table is damaged, every other row must be imported.
"""

from __future__ import annotations

import random
import re
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np

from ...core.errors import RecordingError, RecordingWarning
from ...recording.importers.clock import MAX_DRIFT_PPM
from ...recording.importers.rgbd_folder import import_tum
from ...recording.importers.tables import import_table
from ...recording.importers.tagged_walks import read_kinect, read_speeds, read_xovis
from ...recording.virtual_tags import load_tracks_csv
from .damaged_bytes import damaged_bytes
from .outcome import Outcome, TimeLimitError, joined, outcome, time_limit, unclear
from .sound_tables import HOP_TABLE_HZ, TIME_COLUMNS, WRITERS, sound_lines, sound_reads, sound_tracks

LIMIT_S = 10.0
_NUM_ROWS = 16
_TRACKS = ("tracks.csv", "kinect", "kinect speeds", "xovis", "tum")
_NO_READER_CLOCK = ("sllurp", "sllurp_log", "antenna_rail")

HOSTILE: tuple[str, ...] = (
    *(
        "",
        " ",
        "nan",
        "inf",
        "-inf",
        "-1",
        "0",
        "1e300",
        "1e39",
        "-1e39",
        "99999",
        "1" + "0" * 400,
        "9" * 5000,
        "1e999",
    ),
    *(
        "\u0661\u0662\u0663",
        "\uff11\uff12",
        "1_000",
        "0x10",
        "--1",
        "1e",
        "True",
        "None",
        "null",
        "1.0.0",
        "+5",
        "\ufb00",
    ),
    *("\0", "1\0", '"', '"1', '1"', '"""', "'", "b'", "b'\\x'", "b'\\xff'", "b'" + "'" * 50, "=1+1", "../../x", "[/b]"),
    *(
        "x" * 200_000,
        "1" * 140_000,
        "[" * 5000,
        "{" * 5000,
        '{"a":' * 3000,
        "A" * 3000,
        "\u2028",
        "\x85",
        "\x0c",
        "\x1c",
    ),
    *("\x1b[31m", "\r", "\n", "//", "#", "{", "}", "\ufeff", "\u00e9", "$\\foo{$", ",", ",,,", ";", "\t", "9999-12-31"),
    *(
        "0001-01-01T00:00:00+23:59",
        "2023-11-14T22:13:20",
        "20231114",
        "-0",
        "1E5",
        " 7 ",
        "9" * 19,
        "9223372036854775807",
    ),
)


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """Try fuzzed tables of all formats, `number` in all; one outcome for each format."""
    rng = random.Random(seed)
    names = [*WRITERS, *_TRACKS]
    cv2.imwrite(str(folder / "image.png"), np.zeros((480, 640), np.uint16))
    found: list[Outcome] = []
    for count in range(number):
        name = names[count % len(names)]
        content, sound = _fuzzed(name, rng)
        fault = fault_of(name, content, sound, folder, clock=rng.choice(("auto", "given")))
        found.append(outcome(f"tables, {name}", [fault]))
    return joined(found)


def fault_of(name: str, content: bytes, sound: int | None, folder: Path, *, clock: str = "auto") -> str | None:
    """None if a table of this content is imported or refused as it must be; else what happens instead.

    `sound` is the least number of rows that must be imported, if it is known.
    """
    path = folder / ("rgb.txt" if name == "tum" else "table")
    path.write_bytes(content)
    try:
        with time_limit(LIMIT_S), warnings.catch_warnings():
            warnings.simplefilter("error")
            warnings.simplefilter("ignore", RecordingWarning)
            num_imported = _READERS[name](path) if name in _READERS else _import(name, path, clock)
    except (Exception, TimeLimitError) as error:
        wrong = unclear(error, RecordingError)
        return f"{sound} sound rows, but {error}" if wrong is None and sound is not None else wrong
    return f"{num_imported} of {sound} sound rows were imported" if num_imported < (sound or 0) else None


def _import(name: str, path: Path, clock: str) -> int:
    given = "auto" if name in _NO_READER_CLOCK else "reader"
    reads, audit, report = import_table(path, hop_table_hz=HOP_TABLE_HZ, clock="auto" if clock == "auto" else given)
    assert reads.num_reads + report.rejected_lines.count == report.num_rows, "rows are missing in the counts"
    values = np.concatenate([reads.phase_rad, reads.rssi_dbm, reads.doppler_hz, reads.carrier_hz])
    assert not np.isinf(values).any(), "infinite values"
    drifts_ppm = [piece.drift_ppm for piece in audit.pieces] if audit is not None else []
    assert all(abs(drift) <= MAX_DRIFT_PPM for drift in drifts_ppm), f"drifts of {drifts_ppm} ppm"
    reads.check()
    return reads.num_reads


def _import_tum(path: Path) -> int:
    path.with_name("depth.txt").write_bytes(path.read_bytes())
    return import_tum(path.parent, camera="freiburg3").num_frames


def _num_samples(tracks) -> int:
    return sum(len(samples) for samples in tracks.values())


_READERS: dict[str, Callable[[Path], int]] = {
    "tracks.csv": lambda path: sum(
        int(np.isfinite(track.position_m[:, 0]).sum()) for track in load_tracks_csv(path, np.arange(30) / 30).values()
    ),
    "kinect": lambda path: _num_samples(read_kinect(path)),
    "kinect speeds": lambda path: sum(len(speeds.time_s) for speeds in read_speeds(path).values()),
    "xovis": lambda path: _num_samples(read_xovis(path, 0.02)),
    "tum": _import_tum,
}


def _fuzzed(name: str, rng: random.Random) -> tuple[bytes, int | None]:
    """A damaged table, and the number of its sound rows if the damage is within one row."""
    if name in WRITERS:
        lines = sound_lines(name, sound_reads(_NUM_ROWS, rng))
    else:
        lines = sound_tracks(_NUM_ROWS, rng)[name]
    first = len(lines) - _NUM_ROWS
    if rng.random() < 0.4:
        place = rng.randrange(first, len(lines))
        lines[place] = damaged_row(name, lines[0], lines[place], rng)
        return encoded(lines, rng), None if name == "sllurp_log" else _NUM_ROWS - 1
    return damaged_table(lines, first, rng), None


def damaged_row(name: str, header: str, row: str, rng: random.Random) -> str:
    """A row of a sound table with one field damaged that is no time, or cut."""
    if name == "r700":
        values = list(re.finditer(r': ("[^"]*"|[-\d.]+)', row)) if rng.random() < 0.8 else [re.search(r": \{.*\}", row)]
        chosen = rng.choice([one for one in values if one is not None and "T" not in one[0]] or values)
        return row if chosen is None else f"{row[: chosen.start()]}: {rng.choice(HOSTILE)}{row[chosen.end() :]}"
    delimiter = {"xovis": ";", "tum": " "}.get(name, ",")
    fields = row.split(delimiter)
    names = [one.strip(' "').lower() for one in header.split("\n")[-1].split(delimiter)]
    free = [n for n in range(len(fields)) if n >= len(names) or names[n] not in TIME_COLUMNS]
    fault = rng.random()
    if fault < 0.7:
        fields[rng.choice(free)] = rng.choice(HOSTILE)
    elif fault < 0.8:
        del fields[rng.randrange(len(fields)) :]
    elif fault < 0.9:
        rng.shuffle(fields)
    else:
        fields.insert(rng.randint(0, len(fields)), rng.choice(HOSTILE))
    return delimiter.join(fields)


def damaged_table(lines: Sequence[str], first: int, rng: random.Random) -> bytes:
    """A table with damage anywhere: several rows, the header, the order, the ends of lines, or the bytes of the file."""
    lines = list(lines)
    fault = rng.random()
    if fault < 0.4:
        for _ in range(rng.choice([1, 2, 4, 12])):
            place = rng.randrange(len(lines))
            fields = re.split("([,; ])", lines[place])
            fields[rng.randrange(len(fields))] = rng.choice(HOSTILE)
            lines[place] = "".join(fields)
    elif fault < 0.5:
        header = re.split("([,;])", lines[max(first - 1, 0)])
        rng.shuffle(header)
        lines[max(first - 1, 0)] = "".join(header)
    elif fault < 0.6:
        lines = rng.choices(lines, k=rng.choice([0, 1, len(lines), 3 * len(lines)]))
    elif fault < 0.65:
        return rng.choice([rng.randbytes(3000), b"", b"\xff" * 50, b"\0" * 5000, b"x" * 1_000_000, b"\n" * 1000])
    elif fault < 0.7:
        return "\n".join(lines).encode(rng.choice(["utf-16", "utf-32", "utf-7", "cp037"]))
    content = encoded(lines, rng)
    return damaged_bytes(content, rng) if rng.random() < 0.6 else content


def encoded(lines: Sequence[str], rng: random.Random) -> bytes:
    """The lines as UTF-8, with any kind of line ends, in a tenth of the tables mixed, and with or without a BOM."""
    ends = [rng.choice(["\n", "\n", "\r\n", "\r"])] * len(lines)
    if rng.random() < 0.1:
        ends = [rng.choice(["\n", "\r\n", "\r"]) for _ in lines]
    text = "".join(line + end for line, end in zip(lines, ends, strict=True))
    return (b"\xef\xbb\xbf" if rng.random() < 0.2 else b"") + text.encode("utf-8", "surrogatepass")
