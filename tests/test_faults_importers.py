"""Fuzzed and hostile tables: one bad row never ends an import, and no file makes an importer hang or fail unclearly."""

from __future__ import annotations

import os
import random
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

from tagjax.benchmarks.faults import tables as table_faults
from tagjax.benchmarks.faults.outcome import TimeLimitError, escaped, outcome, time_limit, unclear
from tagjax.benchmarks.faults.sound_tables import HOP_TABLE_HZ, WRITERS, sound_lines, sound_reads, sound_tracks
from tagjax.core.errors import RecordingError, RecordingWarning
from tagjax.recording.importers.read_values import clean_epc, integer, number
from tagjax.recording.importers.rows import Rejected, RowError, csv_fields, parsed, text_lines
from tagjax.recording.importers.tables import import_table
from tagjax.recording.importers.tagged_walks import load_uwb, read_kinect, read_speeds, read_xovis
from tagjax.recording.virtual_tags import load_tracks_csv

WITH_PHASES = [name for name in WRITERS if name != "sllurp_log"]


def _table(name: str, num_rows: int = 12) -> list[str]:
    return sound_lines(name, sound_reads(num_rows, random.Random(3)))


def _import(path: Path, lines: list[str], name: str = "auto"):
    path.write_bytes("\n".join(lines).encode())
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        return import_table(
            path, format=name, hop_table_hz=HOP_TABLE_HZ, clock="reader" if "AntnenaId" in lines[0] else "auto"
        )


@pytest.mark.parametrize(
    "row",
    [
        "x" * 200_000,
        '"',
        'a,"b',
        "b'" + "\\" * 40 + "'",
        "[" * 100_000,
        '{"tagInventoryEvent": ' + "[" * 100_000,
        '{"tagInventoryEvent": 1' + "0" * 5000 + "}",
        '{"tagInventoryEvent": 1}',
        "\0\0\0",
        "\u2028",
        "// a comment in the midst",
        "9" * 400 + ",",
    ],
    ids=lambda row: row[:12],
)
@pytest.mark.parametrize("name", WITH_PHASES)
def test_one_bad_row_is_rejected_and_the_others_are_imported(tmp_path: Path, name: str, row: str) -> None:
    lines = _table(name)
    clean, _, _ = _import(tmp_path / "table", lines)
    place = len(lines) - 4
    reads, _, report = _import(tmp_path / "table", [*lines[:place], row, *lines[place:]])
    np.testing.assert_array_equal(reads.phase_rad, clean.phase_rad)
    rejected = report.rejected_lines
    if name == "itemtest" and row.startswith("//"):
        assert rejected.count == 0
    elif row == "\u2028":
        assert rejected.count == 0  # a blank line
    else:
        assert rejected.count == 1
        assert f"(line {place + 1})" in report.lines()[1]


@pytest.mark.parametrize("name", WITH_PHASES)
def test_a_bad_first_row_is_rejected(tmp_path: Path, name: str) -> None:
    lines = _table(name)
    lines[len(lines) - 12] = '"broken'
    reads, _, report = _import(tmp_path / "table", lines)
    assert (reads.num_reads, report.rejected_lines.count) == (11, 1)


def test_the_report_gives_the_first_line_numbers_of_each_reason(tmp_path: Path) -> None:
    lines = _table("sllurp", 40)
    for place in (3, 5, 7, 9, 11, 13, 15):
        lines[place] = lines[place].replace("b'", "b'xyz")
    lines[20] = "1"
    _, _, report = _import(tmp_path / "table", lines)
    assert report.lines()[1:3] == [
        "rejected 7: EPC is not hexadecimal (lines 4, 6, 8, 10, 12, ...)",
        "rejected 1: columns are missing: epc (line 21)",
    ]


@pytest.mark.parametrize(
    ("column", "value", "reason"),
    [
        (7, "1e300", "Doppler shift is outside"),
        (6, "17", "channel index is outside the hop table, which has entries 1 to 16"),
        (6, "0", "channel index is outside"),
        (4, "b'" + "AB" * 200 + "'", "EPC has more than 124 digits"),
        (5, "1_0", "phase_angle is not a number"),
        (5, "\u0661\u0662", "phase_angle is not a number"),
        (2, "9" * 4000, "antenna is outside"),
        (2, "9" * 5000, "antenna is not an integer"),
        (0, "9" * 400, "time is not finite"),
    ],
)
def test_values_outside_of_their_domain_reject_the_row(tmp_path: Path, column: int, value: str, reason: str) -> None:
    lines = _table("sllurp")
    fields = lines[5].split(",")
    fields[column] = value
    lines[5] = ",".join(fields)
    reads, _, report = _import(tmp_path / "table", lines)
    assert reads.num_reads == 11
    assert reason in next(iter(report.rejected))
    reads.check()


def test_a_carrier_of_another_band_rejects_the_row(tmp_path: Path) -> None:
    lines = _table("octane")
    lines[4] = lines[4].replace(lines[4].split(",")[2], '"433.92"')
    reads, _, report = _import(tmp_path / "table", lines)
    assert report.rejected == {"carrier is outside the band of the other rows": 1}
    reads.check()


def test_values_are_ascii_digits() -> None:
    for text in ("1_0", "\u0661", "\uff11", "", "x"):
        for parse in (number, integer):
            with pytest.raises(RowError):
                parse({"a": text}, "a")
    with pytest.raises(RowError, match="hexadecimal"):
        clean_epc("\ufb00" * 4)  # of which the upper case is FFFF
    assert clean_epc("b'ab cd'") == "ABCD"


def test_spaces_in_a_header_do_not_matter(tmp_path: Path) -> None:
    lines = _table("sllurp")
    spaced = [lines[0].replace(",", " , "), *lines[1:]]
    assert _import(tmp_path / "table", spaced)[0].num_reads == 12


def test_headers_that_cannot_be_used_are_refused(tmp_path: Path) -> None:
    sllurp = _table("sllurp")
    with pytest.raises(RecordingError, match="column antenna is there twice"):
        _import(tmp_path / "table", [sllurp[0].replace("reader", "antenna"), *sllurp[1:]])
    with pytest.raises(RecordingError, match="header is missing"):
        _import(tmp_path / "table", sllurp, "itemtest")
    with pytest.raises(RecordingError, match="found no known header"):
        _import(tmp_path / "table", ["x" * 200_000, *sllurp[1:]])
    with pytest.raises(RecordingError, match="row is not CSV"):
        _import(tmp_path / "table", ["x" * 200_000, *sllurp[1:]], "sllurp")


def test_files_that_are_no_text_are_refused_in_one_line(tmp_path: Path) -> None:
    table = tmp_path / "table"
    for content, message in (
        (b"", "found an empty file"),
        (b"\xef\xbb\xbf \n\n", "found an empty file"),
        (bytes(range(256)) * 40, "found binary data"),
        ("timestamp,epc\n1,2\n".encode("utf-16"), "found binary data"),
    ):
        table.write_bytes(content)
        with pytest.raises(RecordingError, match=message):
            text_lines(table)
    for path, message in (
        (tmp_path, "found a folder"),
        (tmp_path / "none", "no such file"),
        (tmp_path / ("x" * 300), "cannot be read|no such file"),
        (tmp_path / "a\0b", "no such file|cannot be read"),
        (table / "below", "no such file|cannot be read"),
    ):
        with pytest.raises(RecordingError, match=message) as error:
            text_lines(path)
        assert "\n" not in str(error.value)
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(RecordingError, match="no such file"):
        text_lines(tmp_path / "pipe")


def test_a_file_without_permission_is_refused_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "table"
    path.write_text("a")

    def refused(*arguments, **more):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    with pytest.raises(RecordingError, match=r"table: cannot be read \(Permission denied\)\. Check the path"):
        text_lines(path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_end_at_line_ends_only(tmp_path: Path, end: str) -> None:
    path = tmp_path / "table"
    path.write_bytes(end.join(["a\u2028b", "c\x0bd\x85", "", "e"]).encode("utf-8-sig"))
    assert text_lines(path) == ["a\u2028b", "c\x0bd\x85", "", "e"]


def test_whatever_parsing_raises_rejects_the_row() -> None:
    rejected = Rejected()

    def fails(error: Exception):
        def parse(text: str):
            raise error

        return parse

    for line, error in enumerate((RecursionError(), SyntaxError(), OverflowError(), MemoryError(), KeyError("a"))):
        assert parsed(fails(error), "", line, rejected) is None
    assert rejected.count == 5
    assert "1: columns are missing: a (line 4)" in rejected.texts()
    with pytest.raises(OSError, match="disk"):
        parsed(fails(OSError("disk")), "", 0, rejected)
    with pytest.raises(RowError, match="not CSV"):
        csv_fields("x" * 200_000)


def test_huge_lines_and_values_take_no_time(tmp_path: Path) -> None:
    begun = time.monotonic()
    for line in ("x," * 1_000_000, "b'" * 500_000, "1" * 3_000_000, '"' * 1_000_000, "." * 1_000_000, "-0" * 1_000_000):
        for name in ("sllurp", "r700", "itemtest"):
            lines = [*_table(name), line]
            assert _import(tmp_path / "table", lines)[2].rejected_lines.count == 1
    assert time.monotonic() - begun < 20


def test_bad_rows_of_tracks_are_left_out_with_a_warning(tmp_path: Path) -> None:
    path = tmp_path / "tracks.csv"
    lines = sound_tracks(16, random.Random(0))["tracks.csv"]
    bad = ["1,1,0,0,1", "99,1,0,0,1", "2,0,0,0,1", "3,5,inf,0,1", "4,6,1e9,0,1", '"']
    path.write_text("\n".join([*lines, *bad]))
    with pytest.warns(
        RecordingWarning, match=r"tracks.csv: 6 of 22 rows rejected \(1: frame is not an integer \(line 23\)"
    ):
        tracks = load_tracks_csv(path, np.arange(8) / 30)
    assert list(tracks) == [1, 2]
    assert all(np.isfinite(track.position_m).all() for track in tracks.values())


@pytest.mark.parametrize(
    ("name", "read", "bad", "reason"),
    [
        ("kinect", read_kinect, "7, 2020-05-01 12:00:01:000, nan, 2", "x is not finite"),
        ("kinect", read_kinect, "71, 2099-05-01 12:00:01:000, 3, 2", "time is more than 60 s from the others"),
        ("kinect", read_kinect, "71, 2020-05-01 12:00:00:100, 99999999, 2", "position is more than 50 m"),
        ("kinect", read_kinect, "71, 0001-01-01 00:00:00:000, 3, 2", "time is"),
        ("kinect speeds", read_speeds, "1,2,3,1e300,2020-05-01 12:00:00:100", "speed is outside -100 to 100"),
        ("xovis", lambda path: read_xovis(path, 0.02), "0;1e300;1;2;3", "time is outside"),
        ("xovis", lambda path: read_xovis(path, 0.02), "0;1957995040213;1;150;150", "time is more than 60 s"),
        ("xovis", lambda path: read_xovis(path, 0.02), "0", "columns are missing"),
    ],
)
def test_bad_rows_of_walks_are_left_out_with_a_warning(tmp_path: Path, name: str, read, bad: str, reason: str) -> None:
    path = tmp_path / "walks"
    lines = sound_tracks(16, random.Random(0))[name]
    path.write_text("\n".join([*lines, bad]))
    with pytest.warns(RecordingWarning, match=rf"walks: 1 of 17 rows rejected \(1: .*{reason}"):
        found = read(path)
    path.write_text("\n".join(lines))
    clean = read(path)
    assert list(found) == list(clean)
    if name != "kinect speeds":
        assert found == clean


def test_a_uwb_tag_with_bad_rows_is_read(tmp_path: Path) -> None:
    seconds = np.arange(0.0, 70.0, 0.2)
    rows = [f"0;{1e3 * (500 + t)};11;{150 + 50 * np.sin(t)};{100 + 50 * np.cos(t)}" for t in seconds]
    (tmp_path / "raw_xovis.csv").write_text("\n".join([";time;id;x;y", *rows]))
    pairs = [f"{1e3 * (500 + t)};{1e3 * (3 + np.sin(t))};{1e3 * (2 + np.cos(t))};11" for t in seconds]
    pairs[7] = "1e9;x;0;11"
    pairs += ["9e13;0;0;11", "5e5;1e300;0;11", '"', f"{1e3 * 520};1000;1000;99"]
    (tmp_path / "XOVIS_UWB.csv").write_text("\n".join(["UWB_TIME;UWB_X;UWB_Y;XOVIS_PERSON_ID", *pairs]))
    with pytest.warns(RecordingWarning, match="XOVIS_UWB.csv: 3 of 354 rows rejected"):
        (tagged,) = load_uwb(tmp_path, 15.0, 0.02)
    assert np.isfinite(tagged.speeds.towards_m_s).all()
    assert np.abs(tagged.speeds.towards_m_s).max() < 20


def test_the_trial_itself_detects_what_fails(tmp_path: Path) -> None:
    lines = _table("sllurp", 16)
    assert table_faults.fault_of("sllurp", "\n".join(lines).encode(), 16, tmp_path) is None
    assert table_faults.fault_of("sllurp", "\n".join(lines[:9]).encode(), 16, tmp_path) == (
        "8 of 16 sound rows were imported"
    )
    assert "16 sound rows, but" in (table_faults.fault_of("sllurp", b"x", 16, tmp_path) or "")
    assert unclear(RecordingError("one line"), RecordingError) is None
    assert "2 lines" in (unclear(RecordingError("a\nb"), RecordingError) or "")
    assert "KeyError" in (unclear(KeyError("a"), RecordingError) or "")
    with pytest.raises(TimeLimitError, match=r"longer than 0\.1 s"), time_limit(0.1):
        time.sleep(5)
    found = outcome("kind", [None, "a|b\n\x1b[31m<script>é", "x" * 1000])
    assert (found.tried, found.failed) == (3, 2)
    assert found.examples[0] == "a\\x7cb\\x0a\\x1b\\x5b31m\\x3cscript\\x3e\\xe9"
    assert len(escaped("\0" * 1000)) <= 1200


def test_fuzzed_tables_are_imported_with_counts_or_refused_in_one_line(tmp_path: Path) -> None:
    outcomes = table_faults.trial(280, 0, tmp_path)
    assert {one.kind for one in outcomes} == {f"tables, {name}" for name in (*WRITERS, *table_faults._TRACKS)}
    assert sum(one.tried for one in outcomes) == 280
    assert [(one.kind, one.examples) for one in outcomes if one.failed] == []
    assert table_faults.trial(28, 0, tmp_path) == table_faults.trial(28, 0, tmp_path)


@pytest.mark.ci
def test_a_minute_of_fuzzed_tables(tmp_path: Path) -> None:
    begun, seed, outcomes = time.monotonic(), 1, []
    while time.monotonic() - begun < 60:
        outcomes += table_faults.trial(500, seed, tmp_path)
        seed += 1
    failures = [example for one in outcomes for example in one.examples]
    assert sum(one.failed for one in outcomes) <= 0.001 * sum(one.tried for one in outcomes), failures[:10]


@pytest.mark.real_data
@pytest.mark.parametrize(
    "path",
    [
        "sllurp-hopping/static/1ft.csv",
        "sllurp-hopping/moving/MoveTest1-1.csv",
        "antenna-rail/rail_50_positions.csv",
        "tagbeat/wind-1.csv",
    ],
)
def test_damaged_real_tables_are_imported_with_counts_or_refused_in_one_line(
    real_data: Path, tmp_path: Path, path: str
) -> None:
    lines = text_lines(real_data / "rfid" / path)[:200]
    rng = random.Random(0)
    for _ in range(30):
        content = table_faults.damaged_table(lines, 1, rng)
        assert table_faults.fault_of("sllurp", content, None, tmp_path) is None
