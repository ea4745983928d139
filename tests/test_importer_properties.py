"""Properties of the importers of reader tables: what is written in a format is read back; garbage is counted."""

import base64
import datetime
import json
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from tagjax.recording import RecordingError, RecordingWarning
from tagjax.recording.importers.formats import FORMATS, recognise
from tagjax.recording.importers.read_values import clean_epc
from tagjax.recording.importers.tables import import_table

TURN = 2 * np.pi
HOP_TABLE_HZ = tuple(920.625e6 + 0.25e6 * number for number in range(16))
START_US = 1_700_000_000_000_000  # microseconds since 1970

same_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@st.composite
def tables(draw, min_size: int = 1):
    """Reads as dictionaries, in order of time, with values that every format can write."""
    time_us, reads = START_US, []
    for _ in range(draw(st.integers(min_size, 8))):
        time_us += 1000 * draw(st.integers(1, 100_000))  # a tagbeat table holds milliseconds of the host
        reads.append(
            {
                "epc": draw(st.sampled_from(["E2801191A503006543210ABC", "300833B2DDD9014000000000", "ABCD"])),
                "time_us": time_us,
                "antenna": draw(st.integers(1, 4)),
                "channel": draw(st.integers(1, len(HOP_TABLE_HZ))),
                "code": draw(st.integers(0, 4095)),  # phase in 1/4096 of a turn
                "rssi_dbm": draw(st.integers(-90, -20)),
                "doppler_hz": draw(st.integers(-40, 40)),
            }
        )
    return reads


def _iso(time_us: int) -> str:
    moment = datetime.datetime.fromtimestamp(time_us // 10**6, datetime.UTC)
    return f"{moment:%Y-%m-%dT%H:%M:%S}.{time_us % 10**6:06d}0Z"


def _phase(read) -> float:
    return read["code"] * TURN / 4096


def _mhz(read) -> str:
    return f"{HOP_TABLE_HZ[read['channel'] - 1] / 1e6:.3f}"


def _r700(read) -> str:
    tag = {
        "epc": base64.urlsafe_b64encode(bytes.fromhex(read["epc"])).decode().rstrip("="),
        "antennaPort": read["antenna"],
        "peakRssiCdbm": 100 * read["rssi_dbm"],
        "frequency": round(HOP_TABLE_HZ[read["channel"] - 1] / 1e3),
        "lastSeenTime": _iso(read["time_us"]),
        "phaseAngle": read["code"] * 360 / 4096,
    }
    return json.dumps({"timestamp": tag["lastSeenTime"], "eventType": "tagInventory", "tagInventoryEvent": tag})


WRITERS = {
    "sllurp": (
        "timestamp,reader,antenna,rssi,epc,phase_angle,channel_index,doppler_frequency",
        lambda r: (
            f"{r['time_us'] // 10**6}.{r['time_us'] % 10**6:06d},h,{r['antenna']},{r['rssi_dbm']},"
            f"b'{r['epc'].lower()}',{r['code']},{r['channel']},{16 * r['doppler_hz']}"
        ),
    ),
    "octane": (
        '"EPC","Timestamp","ChannelInMhz","PeakRssiInDbm","PhaseAngleInRadians"',
        lambda r: f'"{r["epc"][:4]} {r["epc"][4:]}","{r["time_us"]}","{_mhz(r)}","{r["rssi_dbm"]}","{_phase(r)!r}"',
    ),
    "octane_gesture": (
        "EPC,DopplerShift(Hz),Time,Antenna,TxPower,Frequency(MHz),RSS(dbm),PhaseAngle(Radian),PhaseAngle(Degree)",
        lambda r: (
            f"{r['epc']},{r['doppler_hz']},{r['time_us']},{r['antenna']},30,{_mhz(r)},{r['rssi_dbm']},{_phase(r)!r},0"
        ),
    ),
    "tagbeat": (
        "EPC,AntnenaId,ChannelIndex,Doppler,PeekRssi,PreciseRssi,Phase,FirstReadTime,LastReadTime,ReadCount,Timestamp",
        lambda r: (
            f"{r['epc']},{r['antenna']},{r['channel']},{16 * r['doppler_hz']},{r['rssi_dbm']},{100 * r['rssi_dbm']},"
            f"{r['code']},{r['time_us']},{r['time_us']},1,{r['time_us'] // 1000}"
        ),
    ),
    "itemtest": (
        "// Antennas connected = 1\n// Timestamp, EPC, TID, Antenna, RSSI, Frequency, Hostname, PhaseAngle, DopplerFrequency",
        lambda r: (
            f"{_iso(r['time_us'])}, {r['epc']}, , {r['antenna']}, {r['rssi_dbm']}, {_mhz(r)}, h, {_phase(r)!r}, "
            f"{r['doppler_hz']}"
        ),
    ),
    "itemtest_plain": (
        "timestamp,epc,antenna,rssi,frequency,hostname,phaseAngle,dopplerFrequency,power",
        lambda r: (
            f"{_iso(r['time_us'])},{r['epc']},{r['antenna']},{r['rssi_dbm']},{_mhz(r)},h,{_phase(r)!r},"
            f"{r['doppler_hz']},30"
        ),
    ),
    "antenna_rail": (
        "epc,antennaIndex,frequency,phase,RSSI,dopplerShift,position",
        lambda r: (
            f"{r['epc']},{r['antenna']},{HOP_TABLE_HZ[r['channel'] - 1]!r},{_phase(r)!r},{r['rssi_dbm']},"
            f"{r['doppler_hz']},0"
        ),
    ),
    "r700": (None, _r700),
}


def _lines(name: str, reads) -> list[str]:
    header, write = WRITERS[name]
    return [*([] if header is None else header.split("\n")), *map(write, reads)]


def _imported(folder: Path, lines: list[str]):
    path = folder / "table"
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        return import_table(path, hop_table_hz=HOP_TABLE_HZ, clock="reader" if "AntnenaId" in lines[0] else "auto")


def test_every_format_with_phases_has_a_writer():
    assert set(WRITERS) == set(FORMATS) - {"sllurp_log"}  # which holds no phases, and is refused


@pytest.mark.parametrize("name", WRITERS)
@same_folder
@given(tables())
def test_what_is_written_in_a_format_is_read_back(tmp_path, name, written):
    lines = _lines(name, written)
    recognised = recognise(lines)
    assert recognised is not None
    assert recognised.name == name
    reads, _, report = _imported(tmp_path, lines)
    assert report.format == name
    assert report.rejected == {}
    if name == "antenna_rail":  # without times: every tag's reads are stamped in order
        written = sorted(written, key=lambda read: [r for r in written if r["epc"] == read["epc"]].index(read))
        by_tag = {epc: [read for read in written if read["epc"] == epc] for epc in reads.epcs}
        reads = {epc: reads.select(epc) for epc in reads.epcs}
        pairs = [(by_tag[epc], reads[epc]) for epc in by_tag]
    else:
        expected_ns = np.array([read["time_us"] for read in written], np.int64) * 1000
        # Of seconds with a decimal fraction, a float's rounding remains: below a microsecond.
        np.testing.assert_allclose(reads.time_ns - expected_ns, 0, atol=1000)
        pairs = [(written, reads)]
    for rows, found in pairs:
        assert found.num_reads == len(rows)
        assert found.epc.tolist() == [read["epc"] for read in rows]
        carriers = [HOP_TABLE_HZ[read["channel"] - 1] for read in rows]
        np.testing.assert_allclose(found.carrier_hz, carriers, rtol=1e-9)
        np.testing.assert_allclose(found.phase_rad, [_phase(read) for read in rows], atol=1e-9)
        np.testing.assert_allclose(found.rssi_dbm, [read["rssi_dbm"] for read in rows])
        if name != "octane":  # which has no column for them
            np.testing.assert_array_equal(found.antenna, [read["antenna"] for read in rows])
        if name not in ("octane", "r700"):
            np.testing.assert_allclose(found.doppler_hz, [read["doppler_hz"] for read in rows])
        found.check()


# A quotation mark opens a field that swallows the lines after it: that is CSV, and no garbage of one row.
GARBAGE = st.text(st.characters(codec="utf-8", exclude_characters='"\r\n', exclude_categories=["Zl", "Zp", "Cc"]))


@pytest.mark.parametrize("name", WRITERS)
@same_folder
@given(tables(min_size=4), st.lists(GARBAGE, min_size=1, max_size=3))
def test_rows_of_garbage_are_counted_and_leave_the_others_as_they_are(tmp_path, name, written, garbage):
    garbage = [line for line in garbage if line.strip() and not line.lstrip().startswith("//")]
    lines = _lines(name, written)
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
    name = draw(st.sampled_from([name for name in WRITERS if name != "r700"]))
    lines = _lines(name, draw(tables(min_size=4)))
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
