"""Scenario recordings of several suites, drawn small, against the tables measured on logs of real readers.

The tables: rail = an antenna on a rail (8 channels), counted = 1 to 25 tags before one antenna, hopping = 50 channels.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from tagjax.core.settings import from_mapping
from tagjax.radio.reader import HOP_TABLES_HZ
from tagjax.recording import Recording
from tagjax.sim.record import simulate_recording
from tagjax.sim.stories.scenario import Scenario
from tagjax.sim.suites import Suite, item_scenario
from tagjax.sim.world.bodies import STEP_S, tag_path

pytestmark = pytest.mark.ci

C = 299_792_458.0
FOLDER = Path(__file__).parents[1] / "conf" / "suite"
STATIONARY_S = 20.0
QUIET = {"outages_per_minute": 0.0}


def _scenario(name: str, duration_s: float, **settings) -> Scenario:
    """The world of a suite's first test recording, with another duration."""
    suite = from_mapping(Suite, yaml.safe_load((FOLDER / f"{name}.yaml").read_text()))
    suite = dataclasses.replace(suite, duration_s=duration_s, settings={**suite.settings, **settings})
    return item_scenario(next(item for item in suite.items() if item.split == "test"))


def _simulate(scenario: Scenario, seed: int = 3, **inventory) -> Recording:
    """A frame every two seconds, 64 pixels wide; `inventory` replaces settings of the reader."""
    settings = dataclasses.replace(scenario.inventory, **{**QUIET, **inventory})
    suite = from_mapping(Suite, yaml.safe_load((FOLDER / "multi_2.yaml").read_text()))
    capture = dataclasses.replace(suite.capture, width=64, frame_rate_hz=0.5)
    return simulate_recording(dataclasses.replace(scenario, inventory=settings), capture, seed=seed, name="statistics")


@pytest.fixture(scope="module")
def static_world() -> Scenario:
    """Twenty static tags in an office; for the first `STATIONARY_S` nothing moves."""
    return _scenario("static_tags", 2.5 * STATIONARY_S, stationary_s=STATIONARY_S)


@pytest.fixture(scope="module")
def static(static_world) -> Recording:
    """Read in a mode without pi flips, by a reader whose clock is off and drifts."""
    return _simulate(static_world, flip_probability=0.0, clock_offset_s=0.37, clock_drift_ppm=42.0)


@pytest.fixture(scope="module")
def flipping(static_world) -> Recording:
    """Read in the default, Miller, mode."""
    return _simulate(static_world)


@pytest.fixture(scope="module")
def counted() -> dict[str, Recording]:
    """1, 2, 4, 6 and 12 tags."""
    names = ("single_static", "multi_2", "multi_4", "ceiling_6", "crowd")
    return {name: _simulate(_scenario(name, 12.0)) for name in names}


def _time_s(recording: Recording) -> np.ndarray:
    """Times of reads on the host's clock, as corrected, from the first frame on."""
    return (recording.reads.time_ns - recording.time_ns[0]) * 1e-9


def _at_rest(recording: Recording) -> dict[str, np.ndarray]:
    """Indices of the reads while nothing moves, by EPC, of tags that are read often."""
    early = _time_s(recording) < STATIONARY_S - 0.5
    found = {epc: np.flatnonzero(early & (recording.reads.epc == epc)) for epc in recording.reads.epcs}
    return {epc: reads for epc, reads in found.items() if len(reads) > 60}


def _rounds(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Rounds as seen by the tag that is read most: how many reads each has, and how long it takes."""
    reads, time_s = recording.reads, _time_s(recording)
    counts = {epc: int(np.sum(reads.epc == epc)) for epc in reads.epcs}
    at = np.flatnonzero(reads.epc == max(counts, key=lambda epc: counts[epc]))
    return np.diff(at), np.diff(time_s[at])


def _spread(values: np.ndarray, groups: np.ndarray) -> float:
    """Standard deviation within groups, pooled."""
    _, group, count = np.unique(groups, return_inverse=True, return_counts=True)
    apart = values - (np.bincount(group, values) / count)[group]
    return float(np.sqrt(np.sum(apart**2) / np.sum(count - 1)))


def test_a_round_takes_its_base_and_a_slot_for_each_tag_that_replies(counted, static):
    """Counted: 17.3 ms + 4.23 ms for each tag, rms error 2 ms."""
    num, took = (np.concatenate(part) for part in zip(*map(_rounds, [*counted.values(), static]), strict=True))
    # A read that is lost makes two rounds one.
    single = took < 1.5 * (17.3e-3 + 4.23e-3 * num)
    assert single.mean() > 0.9
    slope, base = np.polyfit(num[single], took[single], 1)
    assert abs(slope - 4.23e-3) < 0.4e-3
    assert abs(base - 17.3e-3) < 2e-3


@pytest.mark.parametrize(
    ("name", "tags", "rate"),
    [("single_static", 1, 46.5), ("multi_2", 2, 37), ("multi_4", 4, 29), ("ceiling_6", 6, 25), ("crowd", 12, 15)],
)
def test_reads_a_second_of_a_tag(counted, name, tags, rate):
    """Counted: per tag, of the tags with strong signals (the fit for one tag, of which that log has none)."""
    recording = counted[name]
    assert len(recording.reads.epcs) == tags
    duration_s = (recording.time_ns[-1] - recording.time_ns[0]) * 1e-9
    counts = np.sort([np.sum(recording.reads.epc == epc) for epc in recording.reads.epcs]) / duration_s
    np.testing.assert_allclose(np.mean(counts[-max(1, tags // 3) :]), rate, rtol=0.15)


def test_twenty_tags_share_the_reader(static):
    """Counted: 10 reads/s of each of 20 tags; tags out of range take no slot."""
    rates = [len(reads) / (STATIONARY_S - 0.5) for reads in _at_rest(static).values()]
    assert len(rates) >= 14
    np.testing.assert_allclose(np.median(rates), 10.0, rtol=0.15)


def test_phase_noise_by_rssi(static):
    """Rail: 0.014 rad at -46 dBm to 0.080 at -67 within a channel; the floor is the recording's, 0.012 to 0.02."""
    reads = static.reads
    level, residual, group = [], [], []
    for number, rows in enumerate(_at_rest(static).values()):
        keys = reads.channel_index[rows].astype(int) + 100 * number
        _, inverse = np.unique(keys, return_inverse=True)
        turn = np.exp(1j * reads.phase_rad[rows])
        mean = np.bincount(inverse, turn.real) + 1j * np.bincount(inverse, turn.imag)
        residual.append(np.angle(turn * np.conj(mean[inverse])))
        # Of the channel, not of the read: a read's own RSSI error would choose its bin.
        level.append((np.bincount(inverse, reads.rssi_dbm[rows]) / np.bincount(inverse))[inverse])
        group.append(keys)
    level, residual, group = map(np.concatenate, (level, residual, group))
    table = {-46: 0.014, -50: 0.017, -53: 0.019, -59: 0.044, -62: 0.052, -65: 0.070, -67: 0.080}
    found = {}
    for rssi in table:
        some = np.abs(level - rssi) < 1.5
        if np.sum(some) > 80:
            found[rssi] = _spread(residual[some], group[some])
    assert len(found) >= 4
    for rssi, sigma in found.items():
        assert abs(np.log2(sigma / table[rssi])) < 0.75, (rssi, sigma)
        line = 10 ** (-0.0374 * rssi - 3.56)
        assert np.hypot(0.011, 0.8 * line) < sigma < np.hypot(0.022, 1.25 * line), (rssi, sigma)


def test_rssi_spreads_within_and_over_channels(static):
    """Rail: 0.1 dB within a channel at -46 dBm, 0.3 to 0.4 at -62 to -68; hopping: 4.8 to 6.4 dB over the band, each in
    steps of 0.5 dB.
    """
    reads = static.reads
    strong, weak, over = [], [], []
    for rows in _at_rest(static).values():
        channel, rssi = reads.channel_index[rows], reads.rssi_dbm[rows].astype(float)
        level = np.median(rssi)
        if level > -50:
            strong.append(_spread(rssi, channel))
        elif -69 < level < -61:
            weak.append(_spread(rssi, channel))
        means = [np.mean(rssi[channel == one]) for one in np.unique(channel)]
        over.append(np.ptp(means))
        assert np.all(rssi * 2 == np.rint(rssi * 2))
    assert strong
    assert weak
    assert np.median(strong) < 0.25
    assert 0.25 < np.median(weak) < 0.45
    assert 3.5 < np.median(over) < 8.5


def test_pi_flips_come_where_the_mode_has_them(static, flipping):
    """Logs: 11 to 21 % of the steps within a channel in Miller modes, none in FM0."""

    def steps(recording):
        reads, jumps = recording.reads, []
        for rows in _at_rest(recording).values():
            if np.median(reads.rssi_dbm[rows]) > -66:
                same = np.diff(reads.channel_index[rows]) == 0
                near = np.diff(_time_s(recording)[rows]) < 0.3
                turn = np.angle(np.exp(1j * np.diff(reads.phase_rad[rows])))
                jumps.append(np.pi - np.abs(turn[same & near]) < 0.5)
        return np.concatenate(jumps)

    assert len(steps(flipping)) > 600
    assert 0.11 < np.mean(steps(flipping)) < 0.21
    assert np.mean(steps(static)) < 0.002
    assert flipping.reads.pi_flips
    assert not static.reads.pi_flips


@pytest.mark.parametrize("which", ["static", "flipping"])
def test_the_offset_over_channels_is_affine(which, request):
    """Logs: 0.31 to 0.43 rad/MHz in size, one for all tags; what reflections add differs from tag to tag."""
    recording = request.getfixturevalue(which)
    reads, multiple = recording.reads, 2 if recording.reads.pi_flips else 1
    slopes = []
    for epc, rows in _at_rest(recording).items():
        if np.median(reads.rssi_dbm[rows]) < -67:
            continue
        range_m = float(np.nanmean(recording.truth.tag_range_m[epc]))
        carriers, inverse = np.unique(reads.carrier_hz[rows], return_inverse=True)
        angle = multiple * (reads.phase_rad[rows] - 4 * np.pi * reads.carrier_hz[rows] * range_m / C)
        total = np.bincount(inverse, np.cos(angle)) + 1j * np.bincount(inverse, np.sin(angle))
        phase = np.unwrap(np.angle(total)) / multiple
        slopes.append(np.polyfit((carriers - carriers.mean()) * 1e-6, phase, 1)[0])
    assert len(slopes) >= 10
    assert 0.28 < abs(np.median(slopes)) < 0.45
    assert np.std(slopes) < 0.06


def test_a_channel_is_held_for_a_fifth_of_a_second(static):
    """Counted and hopping: 0.203 s in the median, 0.195 to 0.215; the order is the reader's own."""
    reads, time_s = static.reads, _time_s(static)
    first = np.append(0, np.flatnonzero(np.diff(reads.channel_index)) + 1)
    dwell = np.diff(time_s[first])[1:]
    assert abs(np.median(dwell) - 0.203) < 0.005
    low, high = np.quantile(dwell, [0.1, 0.9])
    assert low > 0.18
    assert high < 0.225
    table = np.asarray(reads.hop_table_hz)
    assert sorted(table) == list(HOP_TABLES_HZ["fcc"])
    assert np.any(np.diff(table) < 0)
    np.testing.assert_array_equal(reads.carrier_hz, table[reads.channel_index.astype(int) - 1])


def test_the_clock_is_recovered(static):
    """Offset to the latency of 5 to 50 ms. A recording of less than a minute gets no drift: 42 ppm are 2 ms then."""
    assert static.clock is not None
    assert static.reads.reader_time_ns is not None
    (piece,) = static.clock.pieces
    assert piece.drift_interval_ppm is None
    ran_s = (piece.reference_ns - static.reads.reader_time_ns[0]) * 1e-9
    np.testing.assert_allclose(piece.offset_s - 42e-6 * ran_s, 0.37 + 0.006, atol=0.004)
    moved_ns = static.reads.time_ns - static.reads.reader_time_ns
    np.testing.assert_array_equal(moved_ns, round(piece.offset_s * 1e9))


def test_corrected_times_fit_the_motion():
    """A waved tag's phase follows its path best where reads are late by the smallest latency, 5 ms."""
    scenario = _scenario("single_static", 8.0, speed_m_s=1.5)
    recording = _simulate(scenario, flip_probability=0.0)
    reads = recording.reads
    path = np.linalg.norm(tag_path(scenario.world, scenario.world.tags[0]) - np.asarray(scenario.antennas_m[0]), axis=1)
    steps_s = np.arange(len(path)) * STEP_S

    def coherence(late_s: float) -> float:
        range_m = np.interp(_time_s(recording) - late_s, steps_s, path)
        turn = np.exp(1j * (reads.phase_rad - 4 * np.pi * reads.carrier_hz * range_m / C))
        channel = np.asarray(reads.channel_index)
        return float(sum(abs(np.sum(turn[channel == one])) for one in np.unique(channel)))

    lags = np.arange(-0.04, 0.0401, 0.002)
    best = lags[np.argmax([coherence(lag) for lag in lags])]
    assert -0.004 <= best <= 0.014
