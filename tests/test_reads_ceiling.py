"""The reads' ceiling: dwell likelihoods in closed form, which candidate wins, and scores of winners."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_clips as synthetic
from composed import composed
from jax import numpy as jnp

from experiments.suites import suites_named
from tagjax.core.numerics import SPEED_OF_LIGHT_M_S
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation import suite_items
from tagjax.evaluation.reads_ceiling import CeilingConfig, run_ceiling
from tagjax.evaluation.reads_ceiling.candidates import Memory, candidates_of, winners
from tagjax.evaluation.reads_ceiling.likelihood import (
    EvidenceSettings,
    carried_evidence,
    independent_evidence,
    log_i0,
    read_phasors,
)
from tagjax.evaluation.reads_ceiling.run import _with_antennas, ceilings
from tagjax.evaluation.true_distance import at_times, true_distance_m
from tagjax.metrics.recordings import ScoreSettings
from tagjax.radio.noise import thermal_sigma_rad
from tagjax.radio.reader_model import ReaderModel
from tagjax.recording import RecordingError, TagReads
from tagjax.recording.reads import concatenate_reads

RSSI_DBM = -55.0
PLAIN = EvidenceSettings(spread_rad=0.1, slack=0.0, doubled_angle=False)
EVERYTHING = Memory(None, carried=False)
SCORES = ScoreSettings(min_pixels=2, border_px=0.0)


def _reads(
    time_s: np.ndarray, distance_m: np.ndarray, carrier_hz: np.ndarray, offset_rad: np.ndarray | float = 0.0
) -> TagReads:
    count = len(time_s)
    return TagReads(
        epc=np.full(count, "a"),
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        antenna=np.ones(count, np.int16),
        carrier_hz=carrier_hz,
        phase_rad=np.mod(4 * np.pi * carrier_hz * distance_m / SPEED_OF_LIGHT_M_S + offset_rad, 2 * np.pi),
        rssi_dbm=np.full(count, RSSI_DBM, np.float32),
        doppler_hz=np.full(count, np.nan, np.float32),
    )


def _two_candidates(time_s: np.ndarray) -> np.ndarray:
    return np.stack([1.5 + 0.2 * np.sin(2 * time_s), 2.0 + 0.2 * np.cos(3 * time_s)])


def test_noiseless_reads_choose_the_right_one_of_two() -> None:
    time_s = np.arange(0, 1, 1 / 40)
    carriers_hz = np.where(time_s < 0.5, 905e6, 921e6)
    ranges_m = _two_candidates(time_s)
    frame_s = np.array([-1.0, 0.3, 0.95])
    for own in (0, 1):
        reads = read_phasors(_reads(time_s, ranges_m[own], carriers_hz, 1.0), time_s, ranges_m, PLAIN)
        for evidence in (independent_evidence(reads, frame_s), carried_evidence(reads, frame_s, PLAIN)):
            assert winners(evidence).tolist() == [-1, own, own]  # before the first read nothing wins


def test_a_dwell_of_noiseless_reads_has_its_closed_form() -> None:
    """n reads of concentration w in one dwell: log I0(n w) - n log I0(w); two dwells of n / 2 each: twice that of n / 2."""
    num = 12
    time_s = np.arange(num) / 40
    distance_m = 1.5 + 0.2 * np.sin(2 * time_s)
    weight = 1 / (thermal_sigma_rad(np.array([RSSI_DBM]))[0] ** 2 + 0.1**2)
    for carrier_hz, dwell in ((np.full(num, 915e6), num), (np.repeat([905e6, 921e6], num // 2), num // 2)):
        offset_rad = np.where(carrier_hz == 921e6, 2.0, 0.3)
        phasors = read_phasors(_reads(time_s, distance_m, carrier_hz, offset_rad), time_s, distance_m[None], PLAIN)
        evidence = independent_evidence(phasors, np.array([1.0]))
        expected = num / dwell * log_i0(np.array(dwell * weight)) - num * log_i0(np.array(weight))
        np.testing.assert_allclose(evidence, expected, rtol=1e-9)


def test_distances_that_differ_by_a_constant_tie() -> None:
    time_s = np.arange(0, 1, 1 / 40)
    distance_m = 1.5 + 0.2 * np.sin(2 * time_s)
    carrier_hz = np.where(time_s < 0.5, 905e6, 921e6)
    both_m = np.stack([distance_m, distance_m + 0.37])
    phasors = read_phasors(_reads(time_s, distance_m, carrier_hz), time_s, both_m, PLAIN)
    evidence = independent_evidence(phasors, time_s)
    np.testing.assert_allclose(evidence[0], evidence[1], atol=1e-8)
    assert set(winners(evidence)) == {-1}


def test_pi_flips_count_only_without_the_doubled_angle() -> None:
    time_s = np.arange(0, 1, 1 / 40)
    distance_m = 1.5 + 0.2 * np.sin(2 * time_s)
    flips = np.pi * (np.arange(len(time_s)) % 3 == 0)
    carrier_hz = np.full(len(time_s), 915e6)
    for doubled, equal in ((True, True), (False, False)):
        settings = dataclasses.replace(PLAIN, doubled_angle=doubled)
        found = [
            independent_evidence(
                read_phasors(_reads(time_s, distance_m, carrier_hz, offset), time_s, distance_m[None], settings),
                time_s[-1:],
            )[0, 0]
            for offset in (0.0, flips)
        ]
        assert np.isclose(*found) == equal


def test_one_dwell_is_what_the_tracer_accumulates_read_by_read() -> None:
    """The sum that `tagjax.radio.reader_model` makes read by read, with outliers and errors of motion set to nearly 0."""
    rng = np.random.default_rng(3)
    time_s = np.sort(rng.uniform(0.01, 0.4, 16))
    distance_m = 1.5 + 0.1 * np.sin(4 * time_s)
    table = _reads(time_s, distance_m, np.full(16, 915e6), rng.normal(0, 0.2, 16))
    settings = EvidenceSettings(spread_rad=0.07, slack=0.0)
    expected = independent_evidence(read_phasors(table, time_s, distance_m[None], settings), time_s[-1:])[0, 0]

    reader = ReaderModel(spread_rad=0.07, still_spread_rad=0.07, drift_m=1e-12, outlier=1e-6)
    single = lambda value: jnp.asarray(value, jnp.float32)  # noqa: E731
    weight = reader.concentration(single(RSSI_DBM), single(0.0))
    total, real, imaginary = 0.0, single(0.0), single(0.0)
    for phase_rad, moved_m in zip(table.phase_rad, np.diff(distance_m, prepend=distance_m[0]), strict=True):
        real, imaginary = reader.moved(real, imaginary, single(moved_m), single(1.0), single(915e6))
        gain, real, imaginary = reader.add_read(real, imaginary, weight, single(phase_rad))
        total += float(gain)
    assert abs(expected) > 5
    np.testing.assert_allclose(expected, total, rtol=2e-3)


def test_carried_offsets_decide_where_every_dwell_has_one_read() -> None:
    """Alone, one read with an unknown offset says nothing; with affine offsets the sequence does."""
    rng = np.random.default_rng(0)
    time_s = np.arange(30) * 0.2
    carrier_hz = 902.75e6 + 0.5e6 * rng.permutation(50)[:30]
    ranges_m = np.stack([1.5 + 0.05 * np.sin(0.5 * time_s), 1.5 + 0.05 * np.sin(0.9 * time_s + 1)])
    offset_rad = 0.7 + 0.41e-6 * (carrier_hz - 915e6) + np.cumsum(rng.normal(0, 0.05, 30))
    phasors = read_phasors(_reads(time_s, ranges_m[0], carrier_hz, offset_rad), time_s, ranges_m, PLAIN)
    alone = independent_evidence(phasors, time_s)
    assert set(winners(alone)) == {-1}
    carried = carried_evidence(phasors, time_s, dataclasses.replace(PLAIN, hop_spread_rad=0.1))
    assert winners(carried)[-10:].tolist() == [0] * 10
    assert carried[0, -1] - carried[1, -1] > 5


def test_an_infinite_spread_makes_dwells_independent_and_none_makes_them_one() -> None:
    time_s = np.arange(0, 1, 1 / 40)
    carrier_hz = 915e6 + 1e6 * np.floor(time_s / 0.2)
    distance_m = 1.5 + 0.2 * np.sin(2 * time_s)
    phasors = read_phasors(_reads(time_s, distance_m, carrier_hz), time_s, distance_m[None], PLAIN)
    alone = independent_evidence(phasors, time_s)
    np.testing.assert_allclose(
        carried_evidence(phasors, time_s, dataclasses.replace(PLAIN, hop_spread_rad=1e9)), alone, atol=1e-6
    )
    # Noiseless, with slope 0 among those averaged: one dwell of all reads, less at most the prior of that slope.
    weight = np.abs(phasors.phasor[0, 0])
    one = log_i0(np.array(len(time_s) * weight)) - len(time_s) * log_i0(np.array(weight))
    joint = carried_evidence(phasors, time_s, dataclasses.replace(PLAIN, hop_spread_rad=0.0))[0, -1]
    assert one - np.log(201) <= joint <= one
    assert joint > alone[0, -1]


def test_a_bounded_memory_forgets() -> None:
    """The reads follow one candidate for 3 s, and then the other for 1.5 s."""
    time_s = np.arange(0, 4.5, 1 / 40)
    carrier_hz = 905e6 + 1e6 * np.floor(time_s / 0.2)
    ranges_m = _two_candidates(time_s)
    followed = np.where(time_s < 3, ranges_m[0], ranges_m[1])
    phasors = read_phasors(_reads(time_s, followed, carrier_hz), time_s, ranges_m, PLAIN)
    assert winners(independent_evidence(phasors, time_s))[-1] == 0
    recent = independent_evidence(phasors, time_s, 1.01)
    assert winners(recent)[-1] == 1
    later = time_s > time_s[-1] - 1.01
    fresh = read_phasors(_reads(time_s, followed, carrier_hz)[later], time_s[later], ranges_m[:, later], PLAIN)
    np.testing.assert_allclose(recent[:, -1], independent_evidence(fresh, time_s[-1:])[:, 0], rtol=1e-6)


def test_distances_at_other_times_are_unknown_outside_and_in_gaps() -> None:
    frame_s = np.arange(20) / 10
    distance_m = 2 + 0.1 * np.sin(frame_s)
    distance_m[7:9] = np.nan
    found = at_times(frame_s, distance_m, np.array([-0.1, 0.55, 0.65, 0.75, 1.2, 1.91]))
    assert np.isnan(found).tolist() == [True, False, True, True, False, True]
    np.testing.assert_allclose(found[[1, 4]], 2 + 0.1 * np.sin([0.55, 1.2]), atol=1e-5)


def test_distances_come_from_positions_or_from_ranges_of_the_first_antenna() -> None:
    recording = dataclasses.replace(synthetic.recording(6), antennas_m=np.array([[0.0, 0, 0], [0, 0, 1]]))
    first = true_distance_m(recording, "tag-a", 1)
    assert first is not None
    np.testing.assert_allclose(first, recording.truth.tag_range_m["tag-a"])
    assert true_distance_m(recording, "tag-a", 2) is None
    position = np.tile([0.0, 0, 3], (6, 1))
    placed = dataclasses.replace(recording.truth, tag_position_m={"tag-a": position})
    known = dataclasses.replace(recording, truth=placed)
    second = true_distance_m(known, "tag-a", 2)
    assert second is not None
    np.testing.assert_allclose(second, 2.0)


def test_scores_are_those_of_the_winners_true_mask() -> None:
    recording = synthetic.recording(40)
    (right,) = ceilings(recording, EvidenceSettings(), [EVERYTHING], SCORES)
    assert right.scores().result()["identification"] > 0.9
    assert right.scores().result()["iou"] == pytest.approx(right.scores().result()["identification"])
    names = recording.reads.epc
    swapped = np.where(names == "tag-a", "tag-b", "tag-a")
    (wrong,) = ceilings(
        recording.with_reads(dataclasses.replace(recording.reads, epc=swapped)),
        EvidenceSettings(),
        [EVERYTHING],
        SCORES,
    )
    assert wrong.scores().result()["identification"] < 0.1
    assert wrong.scores().result()["iou"] < 0.1


def test_the_reads_of_chosen_antennas_of_a_suite_with_several(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recording = synthetic.recording(10)
    second = dataclasses.replace(recording.reads, antenna=np.full(recording.reads.num_reads, 2, np.int16))
    several = dataclasses.replace(
        recording, reads=concatenate_reads([recording.reads, second]), antennas_m=np.zeros((2, 3))
    )
    assert set(_with_antennas(several, (2,)).reads.antenna) == {2}
    assert _with_antennas(several, None) is several
    with pytest.raises(RecordingError, match="no read of antenna 3; expected antennas among 1, 2"):
        _with_antennas(several, (1, 3))
    asked: list[Any] = []
    monkeypatch.setattr(suite_items, "make_items", lambda suite, *_, **__: asked.append(suite) or suite.items())
    config = CeilingConfig(suites=suites_named(["walkers"]), num_antennas=4, recordings_dir=str(tmp_path))
    config.all_items()
    assert asked[0].settings == {**asked[0].settings, "num_antennas": 4, "room": "hall", "num_people": 3}


def test_a_recording_of_one_tag_is_refused() -> None:
    recording = synthetic.recording(10)
    alone = recording.with_reads(recording.reads.select("tag-a"))
    with pytest.raises(RecordingError, match=r"found 1 tag .*expected at least 2.*several tags, such as multi_4"):
        candidates_of(alone)


def test_settings_that_mean_nothing_are_refused() -> None:
    with pytest.raises(ValueError, match="hop_spread_rad is -1"):
        EvidenceSettings(hop_spread_rad=-1.0)
    suites = suites_named(["multi_2"])
    with pytest.raises(ConfigError, match=r"memories_s is \[0\.0\]"):
        CeilingConfig(suites=suites, memories_s=(0.0,))
    with pytest.raises(ConfigError, match=r"antennas is \[0\]"):
        CeilingConfig(suites=suites, antennas=(0,))
    with pytest.raises(ConfigError, match="split is 'exam'"):
        CeilingConfig(suites=suites, split="exam")
    with pytest.raises(ConfigError, match="suites is empty"):
        CeilingConfig(suites={})
    with pytest.raises(ConfigError, match="planar_101 has lines"):
        CeilingConfig(suites=suites_named(["planar_101"])).items("planar_101")


@pytest.mark.ci
def test_a_suite_in_small(tmp_path: Path) -> None:
    values = composed("reads_ceiling", "suites=[multi_2]", "smoke=true", "scores.min_pixels=2")
    values.pop("progress")
    values |= {"suites": suites_named(["multi_2"]), "recordings_dir": str(tmp_path / "made")}
    config = from_mapping(CeilingConfig, values)
    rows, tags = run_ceiling(config, tmp_path / "out")
    assert [row.memory for row in rows] == list(config.memories)
    assert tags
    assert all(len(tag.identified) == 4 for tag in tags)
    for row in rows:
        value = row.estimates["identification"].value
        assert value is not None
        assert 0 <= value <= 1
    written = json.loads((tmp_path / "out" / "result.json").read_text())
    assert len(written["rows"]) == 4
    table = (tmp_path / "out" / "table.md").read_text()
    assert "| `multi_2` | all reads so far | carried |" in table
    assert (tmp_path / "out" / "ceiling.png").stat().st_size > 5000
    assert (tmp_path / "out" / "table.csv").read_text().count("\n") == 1 + 4 * 3
