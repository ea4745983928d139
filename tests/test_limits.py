"""The check of a recording: one fault at a time changes the right verdict and no other; speeds, noise and flips are the true ones."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from limits_scenes import EPC, FAULTS, READER, faultless, moved, reads_of

from experiments.command import CONF
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.check import CheckConfig, check_recording
from tagjax.recording import RecordingError, TagReads
from tagjax.recording.limits import Thresholds, find_limits
from tagjax.recording.limits.line import judged, worst_verdict
from tagjax.recording.limits.pieces import fit_pieces
from tagjax.recording.store import save_recording
from tagjax.recording.virtual_tags import Track, virtual_reads
from tagjax.report.check_page import check_html, check_text, summary


def test_a_faultless_recording_is_good_in_every_line() -> None:
    limits = find_limits(faultless())
    assert set(limits.verdicts()) == set(FAULTS)
    assert set(limits.verdicts().values()) == {"good"}
    assert abs(limits.lag.lag_s) < 0.05
    assert summary(limits) == "Nothing that was measured limits this recording."


@pytest.mark.parametrize("name", FAULTS)
def test_one_fault_changes_the_verdict_of_its_line_alone(name: str) -> None:
    limits = find_limits(FAULTS[name](faultless()))
    assert {line for line, verdict in limits.verdicts().items() if verdict != "good"} == {name}, check_text(limits)
    assert len(limits.line(name).change.split()) > 3
    assert f"To do: {limits.line(name).change}" in check_text(limits)


@pytest.mark.parametrize("lag_s", [-0.4, 0.2, 0.7])
def test_a_shake_shows_the_lag_of_the_reads(lag_s: float) -> None:
    reads = dataclasses.replace(faultless().reads, time_ns=faultless().reads.time_ns + round(lag_s * 1e9))
    assert find_limits(faultless().with_reads(reads)).lag.lag_s == pytest.approx(lag_s, abs=0.05)


def test_without_motion_the_lag_is_not_measured() -> None:
    assert find_limits(faultless().with_reads(reads_of(0.0))).lag is None


def _pieces(way_m: float, *, noise_rad: float, flips: float, period_rad: float = 2 * np.pi, sign: int = 1):
    """Pieces of reads with known noise and flips, and the true speed at each."""
    rng = np.random.default_rng(2)
    time_s = np.cumsum(rng.gamma(16, 0.022 / 16, 500))
    carrier_hz = 905e6 + 0.5e6 * (time_s // 0.2 % 7)
    phase = 4 * np.pi * carrier_hz / 299792458.0 * way_m * moved(time_s) + carrier_hz / 1e6
    phase += rng.normal(0, noise_rad, 500) + np.pi * (rng.random(500) < flips)
    reads = TagReads(
        epc=np.full(500, EPC),
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        antenna=np.ones(500, np.int16),
        carrier_hz=carrier_hz,
        phase_rad=(sign * phase) % period_rad,
        rssi_dbm=np.full(500, -50, np.float32),
        doppler_hz=np.full(500, np.nan, np.float32),
        phase_period_rad=period_rad,
        phase_sign=sign,  # type: ignore[arg-type]
    )
    pieces = fit_pieces(reads, time_s)
    step = 0.01
    true = way_m * (moved(pieces.time_s + step) - moved(pieces.time_s - step)) / (2 * step)
    return pieces, true


@pytest.mark.parametrize("way_m", [0.0, 0.35, 1.5])
@pytest.mark.parametrize(("flips", "period", "sign"), [(0.0, 2 * np.pi, 1), (0.1, 2 * np.pi, -1), (0.1, np.pi, 1)])
def test_speed_noise_and_flips_are_the_true_ones(way_m: float, flips: float, period: float, sign: int) -> None:
    pieces, true = _pieces(way_m, noise_rad=0.08, flips=flips, period_rad=period, sign=sign)
    assert np.median(np.abs(pieces.speed_m_s - true)) < 0.03
    assert np.max(np.abs(pieces.speed_m_s - true)) < 0.3
    assert pieces.noise_rad == pytest.approx(0.08, rel=0.15)
    expected = flips if period > 6 else 0.0
    assert pieces.flip_probability == pytest.approx(expected, abs=0.03)


def test_few_reads_are_not_measured() -> None:
    recording = faultless()
    limits = find_limits(recording.with_reads(recording.reads[::40]))
    assert limits.line("read_rate").verdict == "bad"
    for name in ("phase_noise", "pi_flips", "speed"):
        assert limits.line(name).verdict == "not measured"
    assert np.isnan(limits.tags[0].speed_m_s)


def test_a_single_frame_has_no_rate() -> None:
    recording = faultless()
    one = dataclasses.replace(
        recording, colour=recording.colour[:1], depth=recording.depth[:1], time_ns=recording.time_ns[:1]
    )
    verdicts = find_limits(one.with_reads(recording.reads[:3])).verdicts()
    assert verdicts["frame_rate"] == "not measured"
    assert verdicts["depth"] == "good"


def test_no_read_at_all() -> None:
    limits = find_limits(faultless().with_reads(TagReads.empty()))
    assert limits.verdicts()["read_rate"] == limits.verdicts()["gaps"] == "bad"
    assert "no tag was read" in check_text(limits)
    page = check_html(limits)
    assert "</html>" in page
    assert set(re.findall(r"var\((--\w+)\)", page)) <= set(re.findall(r"(--\w+):", page))  # every colour is there


def test_the_worst_tag_is_named_and_strays_can_be_left_out() -> None:
    recording = faultless()
    stray = dataclasses.replace(recording.reads[::40], epc=np.full(len(recording.reads.epc[::40]), "STRAY"))
    order = np.argsort(np.concatenate([recording.reads.time_ns, stray.time_ns]), kind="stable")
    columns = {
        name: np.concatenate([getattr(recording.reads, name), getattr(stray, name)])[order]
        for name in ("epc", "time_ns", "antenna", "carrier_hz", "phase_rad", "rssi_dbm", "doppler_hz", "channel_index")
    }
    both = recording.with_reads(dataclasses.replace(recording.reads, **columns))
    line = find_limits(both).line("read_rate")
    assert line.verdict == "bad"
    assert "STRAY" in line.found
    assert "1 of 2 tags good" in line.found
    assert set(find_limits(both, epcs=[EPC]).verdicts().values()) == {"good"}
    with pytest.raises(RecordingError, match="never read"):
        find_limits(both, epcs=["ABSENT"])


def test_the_page_is_self_contained_and_names_are_escaped() -> None:
    hostile = "<script>alert(1)</script>"
    recording = dataclasses.replace(faultless(), name=hostile)
    reads = dataclasses.replace(recording.reads, epc=np.full(recording.reads.num_reads, f'"{hostile}'))
    page = check_html(find_limits(recording.with_reads(reads)))
    assert "<script" not in page
    assert "http://" not in page
    assert "https://" not in page
    assert "&lt;script&gt;" in page
    assert len(page) < 100_000
    assert page.count('class="verdict') == len(FAULTS)


def test_the_command_writes_the_page(tmp_path: Path) -> None:
    save_recording(faultless(), tmp_path / "one.zarr")
    done = []
    config = CheckConfig(recording=str(tmp_path / "one.zarr"), out=str(tmp_path / "page.html"))
    limits, page = check_recording(config, tmp_path, on_frame=lambda number, total: done.append((number, total)))
    assert page == tmp_path / "page.html"
    assert limits.name in page.read_text()
    assert done[-1] == (300, 300)


def test_yaml_and_defaults_are_the_same_and_limits_are_checked() -> None:
    values = yaml.safe_load((CONF / "check.yaml").read_text())["thresholds"]
    assert from_mapping(Thresholds, values) == Thresholds()
    with pytest.raises(ConfigError, match="a larger, then a smaller"):
        Thresholds(reads_per_s=(5.0, 15.0))
    with pytest.raises(ConfigError, match="positive"):
        Thresholds(gap_s=0.0)


def test_verdicts() -> None:
    assert [judged(value, (2.0, 1.0)) for value in (2.0, 1.5, 1.0, 0.9)] == ["good", "limits", "limits", "bad"]
    assert [judged(value, (1.0, 2.0)) for value in (1.0, 2.0, 2.1)] == ["good", "limits", "bad"]
    assert judged(float("nan"), (1.0, 2.0)) == "not measured"
    assert worst_verdict(["good", "not measured", "limits"]) == "limits"
    assert worst_verdict([]) == "not measured"


def test_another_antenna_and_the_reads_of_a_dwell() -> None:
    time_s = np.arange(0, 15, 0.01)
    path = np.tile([0.0, 0.0, 1.5], (len(time_s), 1))
    settings = dataclasses.replace(READER, region="fcc", dwell_s=0.2)
    reads = virtual_reads(Track(time_s, path), EPC, settings, seed=5, antenna_m=np.zeros(3))
    ports = np.where(np.arange(reads.num_reads) % 5 == 0, 1, 2).astype(np.int16)
    limits = find_limits(faultless().with_reads(dataclasses.replace(reads, antenna=ports)))
    assert limits.tags[0].antenna == 2
    assert limits.tags[0].num_reads == reads.num_reads
    assert 5 <= limits.tags[0].reads_per_dwell <= 9
