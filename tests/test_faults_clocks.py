"""Faults of clocks: times within 5 ms (median) or a refusal, for simulated tables and for real ones where they are."""

import csv
import dataclasses
import json

import numpy as np
import pytest

from tagjax.benchmarks.faults.clocks import (
    CLOCK_TABLES,
    FAULTS,
    MAX_ERROR_S,
    ClockTable,
    median_error_s,
    sound_table,
    trial,
)
from tagjax.recording import RecordingError
from tagjax.recording.importers.clock import to_host_clock
from tagjax.recording.importers.tables import import_table
from tagjax.recording.store import open_recording, save_recording
from tests import synthetic_clips as synthetic

HOUR_NS = 3600 * 10**9


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("table", CLOCK_TABLES)
def test_every_fault_is_corrected_or_refused(table, fault):
    change, refused = FAULTS[fault]
    rng = np.random.default_rng(11)
    faulty = change(sound_table(CLOCK_TABLES[table], rng), rng)
    _check(faulty, refused=refused, may_be_refused=fault in ("sixteen rows", "one in 25 times is 0.3 s late"))


def _check(faulty, *, refused, may_be_refused):
    error_s, refusal = None, ""
    try:
        error_s = median_error_s(faulty)
    except RecordingError as error:
        refusal = str(error)
    if error_s is None:
        assert refused or may_be_refused, refusal
        assert "clock=" in refusal
    else:
        assert not refused
        assert error_s <= MAX_ERROR_S


def test_the_trial_counts_failures(tmp_path, monkeypatch):
    number = len(CLOCK_TABLES) * len(FAULTS)
    monkeypatch.setattr("tagjax.benchmarks.faults.clocks.MAX_ERROR_S", 0.0)
    outcomes = {one.kind: one for one in trial(number, 0, tmp_path)}
    assert outcomes["clocks, none"].tried == outcomes["clocks, none"].failed == len(CLOCK_TABLES)
    assert outcomes["clocks, reader's clock stands still"].failed == 0


@pytest.mark.real_data
@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("name", ["D_100cm", "rpm187", "wind-1"])
def test_real_tables(real_data, name, fault):
    with open(real_data / "rfid" / "tagbeat" / f"{name}.csv") as file:
        rows = list(csv.DictReader(file))
    reader = np.array([int(row["FirstReadTime"]) for row in rows]) * 1000
    arrival = np.array([int(row["Timestamp"]) for row in rows]) * 10**6
    sound = ClockTable(reader, arrival, to_host_clock(reader, arrival).time_ns)
    change, refused = FAULTS[fault]
    faulty = change(sound, np.random.default_rng(3))
    _check(faulty, refused=refused, may_be_refused=fault in ("sixteen rows", "one in 25 times is 0.3 s late"))


def test_intervals_hold_the_truth():
    """Of 40 tables, the 95 % intervals of the drift hold the true one in at least 34 (binomial: 0.9 % are below)."""
    settings = dataclasses.replace(CLOCK_TABLES["few reads"], span_s=200.0)
    held = 0
    for seed in range(40):
        table = sound_table(settings, np.random.default_rng(seed))
        (piece,) = to_host_clock(table.reader_ns, table.arrival_ns).audit.pieces
        assert piece.drift_interval_ppm is not None
        low, high = piece.drift_interval_ppm
        held += low <= settings.drift_ppm <= high
    assert held >= 34


def test_a_jump_makes_two_pieces_and_single_wrong_rows_are_set_aside():
    table = sound_table(CLOCK_TABLES["few reads"], np.random.default_rng(2))
    reader = table.reader_ns.copy()
    reader[1200:] += HOUR_NS
    reader[[100, 1900]] = 5
    found = to_host_clock(reader, table.arrival_ns)
    first, second = found.audit.pieces
    assert first.num_reads == 1200
    assert abs((first.offset_s - second.offset_s) - 3600) < 0.1
    assert np.flatnonzero(~found.usable).tolist() == [100, 1900]
    assert found.audit.num_set_aside == 2


def _tagbeat_lines(reader_ns, arrival_ns):
    header = (
        "EPC,AntnenaId,ChannelIndex,Doppler,PeekRssi,PreciseRssi,Phase,FirstReadTime,LastReadTime,ReadCount,Timestamp"
    )
    return [header] + [
        f"E2008181810E007525801120,1,1,0,-60,-6000,{k % 4096},{reader // 1000},{reader // 1000},1,{arrival // 10**6}"
        for k, (reader, arrival) in enumerate(zip(reader_ns, arrival_ns, strict=True))
    ]


def test_an_import_reports_pieces_and_rejected_rows_and_keeps_raw_times(tmp_path):
    table = sound_table(CLOCK_TABLES["few reads"], np.random.default_rng(4))
    reader = table.reader_ns.copy()
    reader[1200:] += HOUR_NS
    reader[300] = 0
    path = tmp_path / "t.csv"
    path.write_text("\n".join(_tagbeat_lines(reader, table.arrival_ns)))
    reads, audit, report = import_table(path, carrier_hz=920e6)
    assert report.rejected == {"the reader's time fits no clock": 1}
    assert len(audit.pieces) == 2
    text = "\n".join(report.notes)
    assert "piece 1 of 2" in text
    assert "set anew or restarted 1 time" in text
    kept = np.delete(np.arange(len(reader)), 300)
    np.testing.assert_array_equal(reads.reader_time_ns, reader[kept])
    np.testing.assert_array_equal(reads.arrival_time_ns, table.arrival_ns[kept])
    assert np.median(np.abs(reads.time_ns - table.true_ns[kept])) < 5e6


def test_a_refused_clock_can_be_imported_by_arrival(tmp_path):
    table = sound_table(CLOCK_TABLES["short"], np.random.default_rng(4))
    path = tmp_path / "t.csv"
    path.write_text("\n".join(_tagbeat_lines(np.full_like(table.reader_ns, table.reader_ns[0]), table.arrival_ns)))
    with pytest.raises(RecordingError, match="stands still"):
        import_table(path, carrier_hz=920e6)
    reads, audit, report = import_table(path, carrier_hz=920e6, clock="arrival")
    assert audit is None
    assert any("do not agree" in note for note in report.notes)
    np.testing.assert_array_equal(reads.time_ns, table.arrival_ns)


def test_a_recording_of_an_older_release_keeps_its_clock(tmp_path):
    save_recording(synthetic.recording(3), tmp_path / "a.zarr")
    path = tmp_path / "a.zarr" / "zarr.json"
    stored = json.loads(path.read_text())
    stored["attributes"]["clock"] = {
        "offset_s": 1.5,
        "drift_ppm": 20.0,
        "residual_ms": 0.3,
        "num_reads": 7,
        "reader_epoch": "unix",
        "note": "",
    }
    path.write_text(json.dumps(stored))
    clock = open_recording(tmp_path / "a.zarr").clock
    assert clock.pieces[0].offset_s == 1.5
    assert clock.pieces[0].drift_ppm == 20.0
    assert clock.num_set_aside == 0
