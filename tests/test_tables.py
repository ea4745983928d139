"""RFID tables: every format, its units, rejected rows, clocks; and the real tables where they are at hand."""

import base64
import json
import warnings

import numpy as np
import pytest

from tagjax.recording import RecordingError, RecordingWarning
from tagjax.recording.importers.clock import reader_epoch, to_host_clock
from tagjax.recording.importers.formats import FORMATS, recognise
from tagjax.recording.importers.read_values import clean_epc, stamp_ns
from tagjax.recording.importers.tables import import_table

EPC = "E2801191A503006543210ABC"
HOUR = 1_700_000_000

TABLES = {
    "sllurp": [
        "timestamp,reader,antenna,rssi,epc,phase_angle,channel_index,doppler_frequency",
        f"{HOUR}.25,10.0.0.2:5084,1,-60,b'{EPC.lower()}',1024,2,-16",
        f"{HOUR}.50,10.0.0.2:5084,1,-61,b'{EPC.lower()}',2048,1,16",
    ],
    "octane": [
        '"EPC","Timestamp","ChannelInMhz","PeakRssiInDbm","PhaseAngleInRadians"',
        f'"E280 1191 A503 0065 4321 0ABC","{HOUR}250000","920.875","-60","1.5707963"',
        f'"E280 1191 A503 0065 4321 0ABC","{HOUR}500000","920.625","-61","3.1415927"',
    ],
    "octane_gesture": [
        "EPC,DopplerShift(Hz),Time,Antenna,TxPower,Frequency(MHz),RSS(dbm),PhaseAngle(Radian),PhaseAngle(Degree)",
        f"{EPC},-1,{HOUR}250000,1,30,920.875,-60,1.5707963,90",
        f"{EPC},1,{HOUR}500000,1,30,920.625,-61,3.1415927,180",
    ],
    "tagbeat": [
        "EPC,AntnenaId,ChannelIndex,Doppler,PeekRssi,PreciseRssi,Phase,FirstReadTime,LastReadTime,ReadCount,Timestamp",
        f"{EPC},1,2,-16,-60,-6000,1024,{HOUR}250000,{HOUR}250000,1,{HOUR}250",
        f"{EPC},1,1,16,-61,-6100,2048,{HOUR}500000,{HOUR}500000,1,{HOUR}500",
    ],
    "itemtest": [
        "// Antennas connected = 1, ModeIndex=1002, Session=1",
        "// Timestamp, EPC, TID, Antenna, RSSI, Frequency, Hostname, PhaseAngle, DopplerFrequency, CRHandle",
        f"2023-11-14T22:13:20.2500000Z, {EPC}, , 1, -60, 920.875, r, 1.5707963, -1, 0",
        f"2023-11-14T22:13:20.5000000Z, {EPC}, , 1, -61, 920.625, r, 3.1415927, 1, 0",
    ],
    "itemtest_plain": [
        "timestamp,epc,antenna,rssi,frequency,hostname,phaseAngle,dopplerFrequency,power",
        f"2023-11-14T22:13:20.2500000Z,{EPC},1,-60,920.875,r,1.5707963,-1,30",
        f"2023-11-14T22:13:20.5000000Z,{EPC},1,-61,920.625,r,3.1415927,1,30",
    ],
    "r700": [
        json.dumps(
            {
                "timestamp": f"2023-11-14T22:13:20.{stamp}Z",
                "eventType": "tagInventory",
                "tagInventoryEvent": {
                    "epc": base64.urlsafe_b64encode(bytes.fromhex(EPC)).decode().rstrip("="),
                    "antennaPort": 1,
                    "peakRssiCdbm": rssi,
                    "frequency": frequency,
                    "lastSeenTime": f"2023-11-14T22:13:20.{stamp}Z",
                    "phaseAngle": phase,
                },
            }
        )
        for stamp, rssi, frequency, phase in (("250", -6000, 920875, 90.0), ("500", -6100, 920625, 180.0))
    ],
}


def _write(path, lines, encoding="utf-8"):
    path.write_text("\n".join(lines) + "\n", encoding=encoding)
    return path


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig"])
def test_every_format_gives_the_same_reads(tmp_path, name, encoding):
    path = _write(tmp_path / "table", TABLES[name], encoding)
    reads, _, report = import_table(path, hop_table_hz=[920.625e6, 920.875e6], clock="auto")
    assert report.format == name
    assert reads.epcs == [EPC]
    np.testing.assert_allclose(reads.phase_rad, [np.pi / 2, np.pi], atol=1e-6)
    np.testing.assert_allclose(reads.carrier_hz, [920.875e6, 920.625e6])
    np.testing.assert_allclose(reads.rssi_dbm, [-60, -61])
    np.testing.assert_array_equal(reads.time_ns, [HOUR * 10**9 + 250_000_000, HOUR * 10**9 + 500_000_000])
    if name not in ("octane", "r700"):
        np.testing.assert_allclose(reads.doppler_hz, [-1, 1])
    reads.check()


def test_a_named_format_overrides_and_an_unknown_one_is_refused(tmp_path):
    path = _write(tmp_path / "table", TABLES["octane"])
    with pytest.raises(RecordingError, match="2 of 2 rows are not valid tagbeat"):
        import_table(path, format="tagbeat")
    with pytest.raises(RecordingError, match="Unknown format"):
        import_table(path, format="nonsense")
    with pytest.raises(RecordingError, match="no known header"):
        import_table(_write(tmp_path / "other", ["a,b,c", "1,2,3"]))
    assert recognise([]) is None


def test_rejected_rows_are_counted_by_reason(tmp_path):
    good = TABLES["sllurp"]
    lines = [*good, good[1].replace("1024", "5000"), good[1].replace(EPC.lower(), "xyz"), good[1][:40]]
    lines += [good[2].replace(".50", f".{k}") for k in range(51, 59)]
    lines += [good[1].replace("-60", "-6000"), good[2].replace("2048", "nan")]
    reads, _, report = import_table(_write(tmp_path / "t", lines), carrier_hz=920e6)
    assert reads.num_reads == 10
    assert sum(report.rejected.values()) == 5
    assert report.rejected["phase_angle is outside 0 to 4095 codes"] == 1
    assert report.rejected["EPC is not hexadecimal"] == 2
    assert report.rejected["RSSI is outside -120 to 20 dBm: wrong unit?"] == 1
    assert report.rejected["phase_angle is not finite"] == 1


def test_degrees_where_radians_belong_are_refused(tmp_path):
    lines = [line.replace("1.5707963", "90.0").replace("3.1415927", "180.0") for line in TABLES["octane"]]
    with pytest.raises(RecordingError, match="outside 0 to 2 pi rad"):
        import_table(_write(tmp_path / "t", lines))


def test_a_table_without_phases_is_refused_with_advice(tmp_path):
    lines = ["timestamp,reader,antenna,rssi,epc", f"{HOUR}.25,r,1,-60,{EPC}"]
    with pytest.raises(RecordingError, match="EnableRFPhaseAngle"):
        import_table(_write(tmp_path / "t", lines))


def test_other_events_of_the_r700_are_counted(tmp_path):
    lines = [*TABLES["r700"], json.dumps({"timestamp": "2023-11-14T22:13:21Z", "eventType": "inventoryStatus"})]
    _, _, report = import_table(_write(tmp_path / "t", lines))
    assert report.rejected == {"event is not a tag inventory": 1}


def test_channel_indices_need_the_hop_table(tmp_path):
    path = _write(tmp_path / "t", TABLES["sllurp"])
    with pytest.warns(RecordingWarning, match="hop table"):
        reads, _, _ = import_table(path)
    assert np.isnan(reads.carrier_hz).all()
    reads, _, report = import_table(path, hop_table_hz=[920e6])
    assert reads.carrier_hz.tolist() == [920e6]
    assert report.rejected_lines.texts() == [
        "1: channel index is outside the hop table, which has entries 1 to 1 (line 2)"
    ]
    with pytest.raises(RecordingError, match=r"2 of 2 rows are not valid.*hop table"):
        import_table(path, hop_table_hz=[])


def test_reads_out_of_order_are_sorted_and_repeats_dropped(tmp_path):
    lines = [TABLES["sllurp"][k] for k in (0, 2, 1, 1)]
    reads, _, report = import_table(_write(tmp_path / "t", lines), carrier_hz=920e6)
    assert reads.num_reads == 2
    assert np.all(np.diff(reads.time_ns) > 0)
    assert report.rejected == {"repeats the read before it": 1}
    assert any("out of order" in note for note in report.notes)


def test_a_reader_clock_that_was_never_set_is_reported(tmp_path):
    lines = [line.replace(str(HOUR), "0946694475") for line in TABLES["octane"]]
    with pytest.warns(RecordingWarning, match="started in 2000"):
        reads, _, _ = import_table(_write(tmp_path / "t", lines), clock=1e9)
    assert reads.time_ns[0] == 946694475_250_000_000 + 10**18
    assert reader_epoch(np.array([5_000_000_000])) == "1970"


def test_clock_audit_recovers_offset_and_drift_through_latency():
    rng = np.random.default_rng(0)
    reader = np.sort(rng.integers(0, 120 * 10**9, 4000)) + HOUR * 10**9
    since = (reader - reader[0]) * 1e-9
    latency = 0.004 + rng.exponential(0.02, 4000)
    host = reader + np.rint((0.4 + 40e-6 * since + latency) * 1e9).astype(np.int64)
    found = to_host_clock(reader, host)
    (piece,) = found.audit.pieces
    assert abs(piece.drift_ppm - 40) < 5
    assert piece.drift_interval_ppm is not None
    low, high = piece.drift_interval_ppm
    assert low < 40 < high
    assert abs(piece.offset_s - (0.404 + 40e-6 * (piece.reference_ns - reader[0]) * 1e-9)) < 0.002
    assert found.usable.all()
    np.testing.assert_allclose((found.time_ns - reader) * 1e-9 - 40e-6 * since, 0.404, atol=0.002)
    with pytest.raises(RecordingError, match="two of each"):
        to_host_clock(reader[:1], host[:1])


def test_stamps_and_epcs():
    assert stamp_ns("1747162820.246058") == 1747162820_246058000
    assert stamp_ns("1456563637533") == 1456563637_533000000
    assert stamp_ns("1456555681352962") == 1456555681_352962000
    assert stamp_ns("1456555681352962789") == 1456555681_352962789
    assert stamp_ns("2026-04-02T12:00:00Z") == 1775131200 * 10**9
    assert clean_epc("b'3034f5'") == "3034F5"
    assert clean_epc("E200 9366") == "E2009366"


def test_formats_are_recognised_by_their_headers():
    for name, lines in TABLES.items():
        found = recognise(lines)
        assert found is FORMATS[name]


@pytest.mark.real_data
@pytest.mark.parametrize(
    ("path", "name", "rate"),
    [
        ("sllurp-hopping/static/1ft.csv", "sllurp", (69, 71)),
        pytest.param("sllurp-hopping/static/7ft.csv", "sllurp", (69, 71), marks=pytest.mark.ci),
        pytest.param("tagbeat/D_100cm.csv", "tagbeat", (110, 120), marks=pytest.mark.ci),
        ("tagbeat/rpm187.csv", "tagbeat", (145, 150)),
        ("antenna-rail/rail_50_positions.csv", "antenna_rail", (249, 251)),
    ],
)
def test_real_tables(real_data, path, name, rate):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RecordingWarning)
        reads, audit, report = import_table(
            real_data / "rfid" / path, carrier_hz=None if name == "sllurp" else 920.625e6
        )
        reads.check()
    assert report.format == name
    assert not report.rejected
    assert rate[0] < reads.num_reads / ((reads.time_ns[-1] - reads.time_ns[0]) * 1e-9) < rate[1]
    if name == "tagbeat":
        assert audit is not None
        assert len(audit.pieces) == 1
        assert audit.num_set_aside == 0
        assert audit.pieces[0].drift_interval_ppm is not None
        low, high = audit.pieces[0].drift_interval_ppm
        assert 20 < low < high < 40
        assert audit.residual_ms < 3
