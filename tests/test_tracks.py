"""Association scores on tracks: loaders, windows, and what each method says of synthetic walks."""

from __future__ import annotations

import dataclasses
import json
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
import yaml

from tagjax.core.progress import unobserved
from tagjax.core.settings import from_mapping
from tagjax.evaluation.tracks.association import METHODS, accuracy, association_scores, windows
from tagjax.evaluation.tracks.real_tags import (
    SCORES,
    align,
    associate,
    measured_speed,
    places_around,
    speed_scores,
    speed_windows,
)
from tagjax.evaluation.tracks.run import run_tracks, score_real_tags
from tagjax.evaluation.tracks.scenes import (
    Scene,
    TracksConfig,
    antenna_place,
    load_kinect,
    load_scenes,
    load_xovis,
)
from tagjax.evaluation.tracks.tables import real_tags_markdown
from tagjax.recording import RecordingError
from tagjax.recording.importers.tagged_walks import Speeds, Walk, load_tagged, load_uwb
from tagjax.tagattention.attention import coherent_score
from tagjax.tracing.range_windows import phase_reads

RATE_HZ = 15.0


def _walks(seconds: float = 16.0, rate_hz: float = 30.0) -> tuple[np.ndarray, list[np.ndarray]]:
    """Two circles of other speeds and phases, and one who stands."""
    time_s = np.arange(0, seconds, 1 / rate_hz)
    circle = lambda radius, turn_hz, start: np.stack(  # noqa: E731
        [
            2 + radius * np.cos(2 * np.pi * turn_hz * time_s + start),
            radius * np.sin(2 * np.pi * turn_hz * time_s + start),
        ],
        axis=-1,
    )
    return time_s, [circle(0.8, 0.12, 0.0), circle(0.7, 0.1, 2.0), np.broadcast_to([3.0, 0.5], (len(time_s), 2))]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    home = tmp_path_factory.mktemp("tracks")
    time_s, paths = _walks()
    (home / "kinect-rfid").mkdir()
    begin = datetime(2020, 5, 1, 12, 0, 0)
    for number, path in enumerate(paths):
        lines = []
        for second, (x, z) in zip(time_s, path, strict=True):
            stamp = begin + timedelta(seconds=100.0 * number + second)
            text = stamp.strftime("%Y-%m-%d %H:%M:%S") + f":{stamp.microsecond // 1000:03d}"
            lines.append(f"7{number}, {text}, {100 * x}, {100 * z}")
        (home / "kinect-rfid" / f"{number + 1}-5-2020.txt").write_text("\n".join(lines) + "\n")
    (home / "xovis-uwb").mkdir()
    rows = [";time;id;x;y;height;cam"]
    for number, path in enumerate(paths[:2]):
        rows += [
            f"{k};{1000 * second + 5e5 * number};{number};{x / 0.02};{y / 0.02};1700;c"
            for k, (second, (x, y)) in enumerate(zip(time_s, path, strict=True))
            if k % 6 == 0
        ]
    (home / "xovis-uwb" / "raw_xovis.csv").write_text("\n".join(rows) + "\n")
    return home


def test_tracks_are_put_side_by_side_on_one_clock(folder):
    _, paths = _walks()
    kinect = load_kinect(folder / "kinect-rfid", RATE_HZ)
    xovis = load_xovis(folder / "xovis-uwb" / "raw_xovis.csv", RATE_HZ, 0.02)
    assert (len(kinect.position_m), len(xovis.position_m)) == (3, 2)
    # Every second sample of the walks' 30 a second; the table's 5 a second are joined by straight lines.
    for scene, atol in ((kinect, 2e-3), (xovis, 0.02)):
        for found, path in zip(scene.position_m, paths, strict=False):
            there = np.all(np.isfinite(found), axis=1)
            assert there.sum() > 230
            np.testing.assert_allclose(found[there], path[::2][: there.sum()], atol=atol)


def test_windows_are_those_in_which_the_carrier_moves(folder):
    config = TracksConfig(str(folder), frame_rate_hz=RATE_HZ, max_windows=1000, noise_m=0.0)
    scene = load_kinect(folder / "kinect-rfid", RATE_HZ)
    found = windows(scene, 2.0, config)
    assert {window.carrier for window in found} == {0, 1}
    for window in found:
        assert window.distance_m.shape == (3, 30)
        assert np.ptp(window.distance_m[window.carrier]) >= config.min_move_m
        assert np.ptp(window.distance_m[2]) < 1e-9
        stamps = window.reads.time_ns * 1e-9
        assert stamps.min() >= 0
        assert stamps.max() <= window.time_s[-1] + 1e-9
        assert 30 < window.reads.num_reads < 130
    assert len(windows(scene, 2.0, dataclasses.replace(config, max_windows=5))) == 5
    antenna = antenna_place(scene)
    reach = np.linalg.norm(
        np.concatenate([scene.position_m, np.zeros((*scene.position_m.shape[:2], 1))], -1) - antenna, axis=-1
    )
    np.testing.assert_allclose(
        found[0].distance_m[:, 0], reach[:, np.argmin(np.abs(reach[0] - found[0].distance_m[0, 0]))], atol=0.05
    )
    noisy = windows(scene, 2.0, dataclasses.replace(config, noise_m=0.02))
    apart = np.concatenate([(a.distance_m - b.distance_m).ravel() for a, b in zip(found, noisy, strict=True)])
    assert 0.015 < apart.std() < 0.025


def test_ties_count_for_their_share():
    assert accuracy(np.array([0.2, 0.9, 0.1]), 1) == 1.0
    assert accuracy(np.array([0.2, 0.9, 0.1]), 0) == 0.0
    assert accuracy(np.zeros(4), 2) == 0.25


def test_a_silent_tag_scores_nothing(folder):
    config = TracksConfig(str(folder), frame_rate_hz=RATE_HZ, max_windows=1)
    (window,) = windows(load_kinect(folder / "kinect-rfid", RATE_HZ), 2.0, config)
    silent = dataclasses.replace(window, reads=window.reads[:2])
    assert all(not score.any() for score in association_scores(silent).values())


def test_what_is_no_folder_of_tracks_is_refused(folder, tmp_path):
    with pytest.raises(RecordingError, match="neither kinect-rfid"):
        load_scenes(TracksConfig(str(tmp_path)))
    (tmp_path / "kinect-rfid").mkdir()
    with pytest.raises(RecordingError, match="0 tracks"):
        load_scenes(TracksConfig(str(tmp_path)))
    (tmp_path / "kinect-rfid" / "1-1-2020.txt").write_text("7, yesterday, 1, 2\n")
    with pytest.raises(RecordingError, match=r"time is not year-month-day .*\(line 1\)\); expected id, time"):
        load_scenes(TracksConfig(str(tmp_path)))
    (tmp_path / "t.csv").write_text(";time;id;x\n")
    with pytest.raises(RecordingError, match="columns y are missing"):
        load_xovis(tmp_path / "t.csv", RATE_HZ, 0.02)
    with pytest.raises(ValueError, match="at least 5 frames"):
        TracksConfig("x", windows_s=(0.1,))
    with pytest.raises(ValueError, match="noise_m -1"):
        TracksConfig("x", noise_m=-1.0)


def test_noise_of_a_track_costs_the_doubled_angle_more_than_flips_cost_the_plain_one():
    """One person walks, the other stands; the walker's coherence is what noise and flips leave of 1, channel by channel."""
    time_s = np.arange(0.0, 24.0, 1 / RATE_HZ)
    walks = np.stack([3.0 + 1.0 * np.sin(2 * np.pi * time_s / 6.0), np.zeros(len(time_s))], axis=-1)
    still = np.broadcast_to([4.0, 1.0], walks.shape)
    scene = Scene("walk", time_s, np.stack([walks, still]))
    config = TracksConfig("x", noise_m=0.02, region="fixed", flip_probability=0.08, max_windows=3)
    seen = [window for window in windows(scene, 4.0, config) if window.carrier == 0]
    scores = []
    for one in seen:
        given = jnp.asarray(one.distance_m[None], jnp.float32), phase_reads(one.reads, "virtual", 0)
        frames = jnp.asarray(one.time_s, jnp.float32)
        scores.append([float(coherent_score(*given, frames, doubled_angle=twice)[0, 0]) for twice in (True, False)])
    doubled, plain = np.mean(scores, axis=0)
    # Read between two frames' samples, noise is averaged: by 2/3 in variance.
    turn = 4 * np.pi / 0.328 * 0.02 * (2 / 3) ** 0.5
    assert plain == pytest.approx((1 - 2 * 0.08) * np.exp(-(turn**2) / 2), abs=0.1)
    assert doubled == pytest.approx(np.exp(-((2 * turn) ** 2) / 2), abs=0.12)
    assert plain > doubled + 0.2


def test_the_configuration_names_every_setting():
    values: dict[str, Any] = yaml.safe_load((Path(__file__).parents[1] / "conf" / "tracks.yaml").read_text())
    assert values.pop("progress") is True  # read by the command itself
    values.pop("defaults")
    assert from_mapping(TracksConfig, {**values, "folder": "x"}) == TracksConfig("x")
    assert set(values) == {field.name for field in dataclasses.fields(TracksConfig)}


@pytest.mark.ci
def test_every_method_finds_the_carrier_on_clean_walks(folder, tmp_path):
    """Without noise, flips or hops a window of 4 s suffices for all of them; a run writes what it found."""
    config = TracksConfig(
        str(folder),
        windows_s=(4.0,),
        frame_rate_hz=RATE_HZ,
        max_windows=6,
        noise_m=0.0,
        flip_probability=0.0,
        region="fixed",
    )
    rows = run_tracks(config, tmp_path)["rows"]
    assert [row["scene"] for row in rows] == ["kinect-rfid", "xovis-uwb"]
    for row in rows:
        assert set(row["accuracy"]) == set(METHODS)
        assert min(row["accuracy"].values()) == 1.0, row
        assert row["chance"] == pytest.approx(1 / row["candidates"])
    assert json.loads((tmp_path / "metrics.json").read_text()) == {"virtual_tags": rows}  # no real tags beside them
    assert (tmp_path / "accuracy.png").stat().st_size > 0
    assert "| kinect-rfid | 4 | 6 |" in (tmp_path / "tables.md").read_text()


@pytest.mark.real_data
@pytest.mark.ci
def test_longer_windows_identify_the_carrier_of_real_tracks_better(real_data, tmp_path):
    rows = run_tracks(TracksConfig(str(real_data / "tracks"), windows_s=(1.0, 4.0), max_windows=16), tmp_path)["rows"]
    assert {row["scene"] for row in rows} == {"kinect-rfid", "xovis-uwb"}
    for row in rows:
        assert row["accuracy"][METHODS[0]] > row["chance"]


ANTENNA_M, SCALE = np.array([4.5, 0.75]), 0.3
LAGS_S = (3.2, -6.5)


def _lines(path: Path, lines: list[str]) -> None:
    path.write_text("\n".join(lines) + "\n")


def _stamped(second: float) -> str:
    stamp = datetime(2020, 5, 1, 12, 0, 0) + timedelta(seconds=float(second))
    return stamp.strftime("%Y-%m-%d %H:%M:%S") + f":{stamp.microsecond // 1000:03d}"


@pytest.fixture(scope="module")
def tagged_folder(tmp_path_factory) -> Path:
    """Two recordings of 30 s: in each one walks with a tag; in the second somebody else walks, too."""
    home = tmp_path_factory.mktemp("tagged")
    (home / "kinect-rfid").mkdir()
    rng = np.random.default_rng(0)
    time_s = np.arange(0.0, 30.0, 1 / 30)
    wave = lambda *hz: sum(np.sin(2 * np.pi * f * time_s + 1.7 * i) for i, f in enumerate(hz)) / len(hz)  # noqa: E731
    carriers = (
        np.stack([3.5 + 0.8 * wave(0.11, 0.23), 2.2 + 0.9 * wave(0.09, 0.17)], axis=1),
        np.stack([4.2 + 0.9 * wave(0.13, 0.19), 3.0 + 0.8 * wave(0.08, 0.21)], axis=1),
    )
    other = np.stack([4.0 + 0.9 * wave(0.15, 0.07), 2.0 + 0.7 * wave(0.12, 0.26)], axis=1)
    for number, (carrier, lag_s) in enumerate(zip(carriers, LAGS_S, strict=True)):
        name = f"{number + 1}-5-2020.txt"
        walks = {f"7{number}": carrier} | ({"99": other} if number else {})
        begin = 1000.0 * number
        _lines(
            home / "kinect-rfid" / name,
            [
                f"{who}, {_stamped(begin + t)}, {100 * x}, {100 * z}"
                for who, walk in walks.items()
                for t, (x, z) in zip(time_s, walk, strict=True)
            ],
        )
        towards = -np.gradient(np.linalg.norm(carrier - ANTENNA_M, axis=1), time_s)
        read_s = np.sort(rng.uniform(0.0, 30.0, 900))
        speed = SCALE * np.interp(read_s, time_s, towards) + 0.1 * rng.normal(size=900)
        _lines(
            home / "kinect-rfid" / f"RFID_{name}",
            [f"0000 001E,{v},nan,{v},{_stamped(begin + t - lag_s)}" for t, v in zip(read_s, speed, strict=True)],
        )
    return home


def test_a_tag_s_speed_at_a_time_is_that_of_the_reads_around_it():
    speeds = Speeds(np.concatenate([np.arange(0, 4, 0.02), [9.0]]), np.concatenate([np.full(200, 0.7), [5.0]]))
    found = measured_speed(speeds, np.array([1.0, 2.0, 6.0, 9.0]))
    np.testing.assert_allclose(found[:2], 0.7)
    assert np.isnan(found[2:]).all()  # none near, and one alone


def test_the_antenna_and_the_clocks_come_out_of_a_tag_s_speeds(tagged_folder):
    first, second = load_tagged(tagged_folder / "kinect-rfid", RATE_HZ)
    assert [one.epc for one in (first, second)] == ["0000 001E"] * 2
    assert [len(one.walks) for one in (first, second)] == [1, 2]
    places = places_around([*first.walks, *second.walks])
    alone = align([(first.walks[0], first.speeds)], places)[0]
    assert alone.lag_s == pytest.approx(LAGS_S[0], abs=0.1)
    np.testing.assert_allclose(alone.antenna_m, ANTENNA_M, atol=0.4)
    assert alone.slope == pytest.approx(SCALE, abs=0.04)
    together = align([(one.walks[0], one.speeds) for one in (first, second)], places)
    assert together[0].antenna_m == together[1].antenna_m
    np.testing.assert_allclose(together[0].antenna_m, ANTENNA_M, atol=0.2)
    np.testing.assert_allclose([one.lag_s for one in together], LAGS_S, atol=0.1)
    # At that place a correlation is NumPy's own over the frames that both cover.
    (given,) = align([(first.walks[0], first.speeds)], ANTENNA_M[None])
    found = measured_speed(first.speeds, first.walks[0].time_s - given.lag_s)
    seen = first.walks[0].towards_m_s(ANTENNA_M)
    both = np.isfinite(found)
    assert given.correlation == pytest.approx(np.corrcoef(found[both], seen[both])[0, 1], abs=2e-3)
    assert given.slope == pytest.approx(np.polyfit(seen[both], found[both], 1)[0], rel=0.01)
    still = Walk("still", first.walks[0].time_s, np.zeros_like(first.walks[0].position_m))
    assert align([(still, first.speeds)], ANTENNA_M[None])[0].correlation == 0.0


def test_real_tags_are_identified_with_antennas_placed_by_other_recordings(tagged_folder, tmp_path):
    found = associate(load_tagged(tagged_folder / "kinect-rfid", RATE_HZ))
    for one, lag_s in zip(found, LAGS_S, strict=True):
        assert one.carrier == 0
        np.testing.assert_allclose(one.alignments[0].antenna_m, ANTENNA_M, atol=0.4)
        assert one.alignments[0].lag_s == pytest.approx(lag_s, abs=0.1)
        assert one.alignments[0].correlation > 0.85 > max(other.correlation for other in one.alignments[1:]) + 0.1
    assert [len(one.candidates) for one in found] == [3, 3]
    windows_4s = [window for one in found for window in speed_windows(one, 4.0, 0.16)]
    assert len(windows_4s) > 8
    for window in windows_4s:
        assert window.distance_m.shape == (3, 60)
        assert np.isfinite(window.towards_m_s).all()
        scores = speed_scores(window)
        straight = np.corrcoef(window.distance_m[1], -np.cumsum(window.towards_m_s))[0, 1]
        assert scores["Tagview, R^2"][1] == pytest.approx(max(straight, 0.0) ** 2, abs=1e-9)
    config = TracksConfig(str(tagged_folder), windows_s=(1.0, 4.0), frame_rate_hz=RATE_HZ)
    real = score_real_tags(config, tmp_path, unobserved)
    short, long = real["real_tags"]
    for name in SCORES:
        assert long["accuracy"][name] >= short["accuracy"][name] - 0.05
        assert long["accuracy"][name] > 0.8 > long["chance"] + 0.4
    assert (tmp_path / "real_tags.png").stat().st_size > 0
    text = real_tags_markdown(real)
    assert "| 2-5-2020 |" in text
    assert "|  |  |  | ...99 |" in text
    assert "...70, of another recording" in text
    assert score_real_tags(TracksConfig(str(tmp_path)), tmp_path, unobserved) == {}
    assert real_tags_markdown({}) == ""


def test_a_uwb_tag_s_positions_become_speeds_towards_a_place(tmp_path):
    """Positions in a frame of their own: turned, and stamped by another clock."""
    time_s = np.arange(0.0, 70.0, 0.2)
    path = np.stack([3.0 + np.sin(0.5 * time_s) + 0.5 * np.sin(1.1 * time_s), 2.0 + np.cos(0.7 * time_s)], axis=1)
    other = np.stack([3.0 + np.sin(0.37 * time_s) + 0.6 * np.sin(1.7 * time_s), 2.0 + np.cos(1.3 * time_s)], axis=1)
    rows = [";time;id;x;y;height;cam"]
    for who, walk in (("11", path), ("12", other), ("13", path[:20])):
        rows += [
            f"0;{1e3 * (500 + t)};{who};{x / 0.02};{y / 0.02};1;c" for t, (x, y) in zip(time_s, walk, strict=False)
        ]
    _lines(tmp_path / "raw_xovis.csv", rows)
    assert load_uwb(tmp_path, RATE_HZ, 0.02) == []
    noise = 0.05 * np.random.default_rng(1).normal(size=path.shape)
    turned = (path + noise) @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + np.array([5.0, -1.0])
    pairs = [";XOVIS_TIME;UWB_TIME;UWB_X;UWB_Y;XOVIS_X;XOVIS_Y;XOVIS_PERSON_ID"]
    pairs += [f"0;0;{1e3 * (500.7 + t)};{1e3 * x};{1e3 * y};0;0;11" for t, (x, y) in zip(time_s, turned, strict=True)]
    _lines(tmp_path / "XOVIS_UWB.csv", pairs)
    (tagged,) = load_uwb(tmp_path, RATE_HZ, 0.02)
    assert [walk.name for walk in tagged.walks] == ["11", "12"]  # the third is too short
    assert tagged.carrier == "11"
    (found,) = associate([tagged])
    assert found.carrier == 0
    assert found.own.lag_s == pytest.approx(-0.7, abs=0.15)
    assert found.own.correlation > 0.95 > found.alignments[1].correlation + 0.3
    assert [one["carrier"] for one in found.plain()["candidates"]] == [True, False]
    _lines(tmp_path / "XOVIS_UWB.csv", [";UWB_TIME;UWB_X"])
    with pytest.raises(RecordingError, match="columns UWB_Y, XOVIS_PERSON_ID are missing"):
        load_uwb(tmp_path, RATE_HZ, 0.02)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("001E,1,2,3\n", r"1 of 1 rows rejected \(1: the number of values is not 5 \(line 1\)\); expected EPC"),
        ("001E,1,2,fast,2020-05-01 12:00:00:000\n", "speed is not a number"),
        ("001E,1,2,nan,2020-05-01 12:00:00:000\n", "speed is not finite"),
        ("001E,1,2,101,2020-05-01 12:00:00:000\n", "speed is outside -100 to 100 m/s"),
        ("001E,1,2,0.3,noon\n", "time is not year-month-day"),
    ],
)
def test_speeds_that_are_none_are_named(tmp_path, line, message):
    (tmp_path / "1.txt").write_text("7, 2020-05-01 12:00:00:000, 1, 2\n7, 2020-05-01 12:00:01:000, 2, 2\n")
    (tmp_path / "RFID_1.txt").write_text(line)
    with pytest.raises(RecordingError, match=message):
        load_tagged(tmp_path, RATE_HZ)
    (tmp_path / "1.txt").write_text("7, 2020-05-01 12:00:00:000, 1, 2\n")
    with pytest.raises(RecordingError, match="no track of two samples"):
        load_tagged(tmp_path, RATE_HZ)


@pytest.mark.ci
@pytest.mark.real_data
def test_real_tags_are_carried_by_the_person_who_walks_alike(real_data):
    """Three recordings of other days agree on where the antenna stood, and each tag's carrier suits it best by far."""
    found = associate(load_tagged(real_data / "tracks" / "kinect-rfid", RATE_HZ))
    assert [one.carrier for one in found] == [0, 0, 0]
    for one in found:
        best, *others = sorted((each.correlation for each in one.alignments), reverse=True)
        assert best == one.alignments[0].correlation > 0.8
        assert max(others) < 0.7
        np.testing.assert_allclose(one.alignments[0].antenna_m, [4.4, 0.9], atol=0.4)
    uwb = associate(load_uwb(real_data / "tracks" / "xovis-uwb", RATE_HZ, 0.02))
    assert [one.candidates[one.carrier].name for one in uwb] == [one.tagged.carrier for one in uwb]
    assert all(one.alignments[one.carrier].correlation > 0.8 for one in uwb)
