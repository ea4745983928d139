"""Properties of the importers of reader tables: what is written in a format is read back; garbage is counted."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tagjax.benchmarks.faults.sound_tables import HOP_TABLE_HZ, WRITERS, SoundRead, sound_lines
from tagjax.recording import RecordingError, RecordingWarning
from tagjax.recording.importers.formats import FORMATS, recognise
from tagjax.recording.importers.read_values import clean_epc
from tagjax.recording.importers.tables import import_table

START_US = 1_700_000_000_000_000  # microseconds since 1970

WITH_PHASES = [name for name in WRITERS if name != "sllurp_log"]

same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def tables(draw, min_size: int = 1):
    """Reads in order of time, with values that every format can write."""
    time_us, reads = START_US, []
    for _ in range(draw(st.integers(min_size, 8))):
        time_us += 1000 * draw(st.integers(1, 100_000))  # a tagbeat table holds milliseconds of the host
        reads.append(
            SoundRead(
                epc=draw(st.sampled_from(["E2801191A503006543210ABC", "300833B2DDD9014000000000", "ABCD"])),
                time_us=time_us,
                antenna=draw(st.integers(1, 4)),
                channel=draw(st.integers(1, len(HOP_TABLE_HZ))),
                code=draw(st.integers(0, 4095)),
                rssi_dbm=draw(st.integers(-90, -20)),
                doppler_hz=draw(st.integers(-40, 40)),
            )
        )
    return reads


def _imported(folder: Path, lines: list[str]):
    path = folder / "table"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        return import_table(path, hop_table_hz=HOP_TABLE_HZ, clock="reader" if "AntnenaId" in lines[0] else "auto")


def test_every_format_with_phases_has_a_writer():
    assert set(WRITERS) == set(FORMATS)


@pytest.mark.parametrize("name", WITH_PHASES)
@same_folder
@given(tables())
def test_what_is_written_in_a_format_is_read_back(tmp_path, name, written):
    lines = sound_lines(name, written)
    recognised = recognise(lines)
    assert recognised is not None
    assert recognised.name == name
    reads, _, report = _imported(tmp_path, lines)
    assert report.format == name
    assert report.rejected == {}
    if name == "antenna_rail":  # without times: every tag's reads are stamped in order
        written = sorted(written, key=lambda read: [r for r in written if r.epc == read.epc].index(read))
        by_tag = {epc: [read for read in written if read.epc == epc] for epc in reads.epcs}
        reads = {epc: reads.select(epc) for epc in reads.epcs}
        pairs = [(by_tag[epc], reads[epc]) for epc in by_tag]
    else:
        expected_ns = np.array([read.time_us for read in written], np.int64) * 1000
        # Of seconds with a decimal fraction, a float's rounding remains: below a microsecond.
        np.testing.assert_allclose(reads.time_ns - expected_ns, 0, atol=1000)
        pairs = [(written, reads)]
    for rows, found in pairs:
        assert found.num_reads == len(rows)
        assert found.epc.tolist() == [read.epc for read in rows]
        carriers = [HOP_TABLE_HZ[read.channel - 1] for read in rows]
        np.testing.assert_allclose(found.carrier_hz, carriers, rtol=1e-9)
        np.testing.assert_allclose(found.phase_rad, [read.phase_rad for read in rows], atol=1e-9)
        np.testing.assert_allclose(found.rssi_dbm, [read.rssi_dbm for read in rows])
        if name != "octane":  # which has no column for them
            np.testing.assert_array_equal(found.antenna, [read.antenna for read in rows])
        if name not in ("octane", "r700"):
            np.testing.assert_allclose(found.doppler_hz, [read.doppler_hz for read in rows])
        found.check()


# A quotation mark opens a field that swallows the lines after it: that is CSV, and no garbage of one row.
GARBAGE = st.text(st.characters(codec="utf-8", exclude_characters='"\r\n', exclude_categories=["Zl", "Zp", "Cc"]))


@pytest.mark.parametrize("name", WITH_PHASES)
@same_folder
@given(tables(min_size=4), st.lists(GARBAGE, min_size=1, max_size=3))
def test_rows_of_garbage_are_counted_and_leave_the_others_as_they_are(tmp_path, name, written, garbage):
    garbage = [line for line in garbage if line.strip() and not line.lstrip().startswith("//")]
    lines = sound_lines(name, written)
    clean, _, _ = _imported(tmp_path, lines)
    reads, _, report = _imported(tmp_path, [*lines[:-1], *garbage, lines[-1]])
    assert reads.num_reads == len(written)
    assert sum(report.rejected.values()) == len(garbage)
    assert report.num_rows == len(written) + len(garbage)
    for column in ("epc", "phase_rad", "carrier_hz", "antenna"):
        np.testing.assert_array_equal(getattr(reads, column), getattr(clean, column))


@st.composite
def spoiled(draw):
    """A table with one field of one row replaced by anything, and the number of that row."""
    name = draw(st.sampled_from([name for name in WITH_PHASES if name != "r700"]))
    header, write = WRITERS[name]
    lines = [*header.split("\n"), *map(write, draw(tables(min_size=4)))]
    number = draw(st.integers(len(lines) - 4, len(lines) - 1))
    fields = lines[number].split(",")
    field = draw(st.integers(0, len(fields) - 1))
    fields[field] = draw(
        st.one_of(
            st.sampled_from(["", "nan", "inf", "-inf", "1e300", "-1", "99999", str(10**30), "b'\\x'", "b'é'", "0x10"]),
            st.integers(-(10**20), 10**20).map(str),
            st.floats().map(repr),
            st.text(st.characters(codec="ascii", exclude_characters='",\r\n', exclude_categories=["Cc"]), max_size=12),
        )
    )
    return name, [*lines[:number], ",".join(fields), *lines[number + 1 :]], len(lines)


@same_folder
@given(spoiled())
def test_a_field_of_anything_never_crashes_the_import(tmp_path, table):
    _, lines, _ = table
    try:
        reads, _, report = _imported(tmp_path, lines)
    except RecordingError:
        return  # a clear refusal of the whole table, for instance of a channel that the hop table lacks
    assert reads.num_reads == report.num_rows - sum(report.rejected.values())
    assert np.isfinite(reads.phase_rad).all()
    reads.check()


@example("b'\\x'")
@example("b'é'")
@given(st.text(max_size=40))
def test_an_epc_is_upper_case_hexadecimal_or_refused(text):
    try:
        cleaned = clean_epc(text)
    except ValueError:
        return
    assert set(cleaned) <= set("0123456789ABCDEF")
    assert len(cleaned) >= 4
    assert clean_epc(cleaned) == cleaned
