"""TagVision: the phase score, the simulation of Fig. 6, pairing and matching, and the experiments."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tagvision_scenes as scenes
from composed import composed

from tagjax.baselines.reads import hop_slope_rad_hz, range_phase_rad
from tagjax.baselines.tagvision import TagVisionSettings
from tagjax.baselines.tagvision.detection import BlobSettings
from tagjax.baselines.tagvision.experiment import TagVisionExperiment, run_tagvision
from tagjax.baselines.tagvision.experiment.lines import LineSettings, line_scores
from tagjax.baselines.tagvision.matching import MatchSettings, match_tags
from tagjax.baselines.tagvision.pairing import motion_direction, nearest_reads, pair_interpolated, pair_nearest
from tagjax.baselines.tagvision.phase_score import (
    Snapshots,
    draw_snapshots,
    match_scores,
    phase_score,
    residuals_rad,
    theory_rad,
)
from tagjax.baselines.tagvision.picture_folder import CalibrateSettings
from tagjax.baselines.tagvision.tracks import TrackSettings
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.image.checkerboard import Board

C = 299_792_458.0
SIGMA = 0.1 * np.sqrt(2.0)
ROOT = Path(__file__).parents[1]
QUICK = MatchSettings(num_rounds=20)


# the score


def _numpy_score(residual: np.ndarray, *, first: bool = True, sigma: float = SIGMA) -> float:
    theta = residual - residual[0] if first else residual
    theta = (theta + np.pi) % (2 * np.pi) - np.pi
    density = np.exp(-0.5 * (theta / sigma) ** 2) / (sigma * np.sqrt(2 * np.pi))
    return float(np.abs(np.mean(density * np.exp(1j * theta)))) * sigma * np.sqrt(2 * np.pi)


@pytest.mark.parametrize("reference", ["first", "absolute"])
def test_score_is_the_papers(reference: str) -> None:
    rng = np.random.default_rng(0)
    for spread in (0.1, 0.5, 5.0):
        residual = rng.normal(0, spread, 30)
        found = phase_score(
            jnp.asarray(residual, jnp.float32), jnp.ones(30, bool), sigma_rad=SIGMA, reference=reference
        )
        assert float(found) == pytest.approx(_numpy_score(residual, first=reference == "first"), abs=2e-6)


def test_score_is_invariant_to_an_offset_and_whole_turns() -> None:
    rng = np.random.default_rng(1)
    residual = jnp.asarray(rng.normal(0, 0.2, 20), jnp.float32)
    counted = jnp.ones(20, bool)
    base = phase_score(residual, counted, sigma_rad=SIGMA)
    turns = jnp.asarray(2 * np.pi * rng.integers(-3, 4, 20), jnp.float32)
    assert float(phase_score(residual + 1.7 + turns, counted, sigma_rad=SIGMA)) == pytest.approx(float(base), abs=1e-4)
    absolute = phase_score(residual + 1.7, counted, sigma_rad=SIGMA, reference="absolute")
    assert float(absolute) < 0.1 * float(base)


def test_doubled_angles_are_invariant_to_pi_flips() -> None:
    rng = np.random.default_rng(2)
    residual = rng.normal(0, 0.05, 40)
    flipped = residual + np.pi * rng.integers(0, 2, 40)
    counted = jnp.ones(40, bool)
    plain, turned = (jnp.asarray(r, jnp.float32) for r in (residual, flipped))
    twice = [float(phase_score(r, counted, sigma_rad=SIGMA, angle_multiple=2)) for r in (plain, turned)]
    assert twice[0] == pytest.approx(twice[1], abs=1e-4)
    assert float(phase_score(turned, counted, sigma_rad=SIGMA)) < 0.75 * twice[0]


def test_score_without_snapshots_is_zero() -> None:
    residual = jnp.asarray([0.3, 1.0, -2.0], jnp.float32)
    none, one = jnp.zeros(3, bool), jnp.asarray([False, True, False])
    for reference in ("first", "absolute"):
        assert float(phase_score(residual, none, sigma_rad=SIGMA, reference=reference)) == 0.0
    assert float(phase_score(residual, one, sigma_rad=SIGMA)) == 0.0
    known = phase_score(residual, one, sigma_rad=1.0, reference="absolute")
    assert float(known) == pytest.approx(np.exp(-0.5), abs=1e-6)
    for counted in (none, one, jnp.ones(3, bool)):
        gradient = jax.grad(lambda r, c=counted: phase_score(r, c, sigma_rad=SIGMA))(jnp.zeros(3))
        assert np.all(np.isfinite(gradient))


def test_uncounted_snapshots_may_have_any_value() -> None:
    residual, counted = jnp.asarray([0.0, 0.05, jnp.nan], jnp.float32), jnp.asarray([True, True, False])
    for reference in ("first", "absolute"):
        score = lambda r, c, by=reference: phase_score(r, c, sigma_rad=SIGMA, reference=by)  # noqa: E731
        assert float(score(residual, counted)) == pytest.approx(float(score(residual[:2], counted[:2])), abs=1e-6)
        gradient = np.asarray(jax.grad(score)(residual, counted))
        np.testing.assert_allclose(gradient[:2], jax.grad(score)(residual[:2], counted[:2]), atol=1e-5)
        assert gradient[2] == 0.0
    known = Snapshots(residual, jnp.full(3, 9e8), jnp.ones((2, 3)), jnp.broadcast_to(counted, (2, 3)))
    odd = Snapshots(residual, jnp.asarray([9e8, 9e8, jnp.nan]), jnp.ones((2, 3)).at[:, 2].set(jnp.nan), known.valid)
    scores = [match_scores(s, key=jax.random.key(0), num_rounds=2) for s in (known, odd)]
    np.testing.assert_allclose(scores[0], scores[1], atol=1e-6)
    assert scores[0][0] > 0.5
    slope = jax.grad(lambda s: jnp.sum(match_scores(odd, key=jax.random.key(0), num_rounds=2, hop_slope_rad_hz=s)))
    assert np.isfinite(slope(jnp.zeros(())))


def test_no_snapshots_and_no_candidates_are_defined() -> None:
    for reference in ("first", "absolute"):
        assert float(phase_score(jnp.zeros(0), jnp.zeros(0, bool), sigma_rad=SIGMA, reference=reference)) == 0.0
    assert jax.grad(lambda r: phase_score(r, jnp.zeros(0, bool), sigma_rad=SIGMA))(jnp.zeros(0)).shape == (0,)
    for candidates, number in ((3, 0), (0, 4), (0, 0)):
        shape = (candidates, number)
        some = Snapshots(jnp.zeros(number), jnp.full(number, 9e8), jnp.ones(shape), jnp.ones(shape, bool))
        scores = match_scores(some, key=jax.random.key(0), num_rounds=2)
        np.testing.assert_array_equal(scores, np.zeros(candidates))


def test_score_refuses_unknown_settings() -> None:
    counted = jnp.ones(3, bool)
    with pytest.raises(ValueError, match="angle_multiple is 3"):
        phase_score(jnp.zeros(3), counted, sigma_rad=SIGMA, angle_multiple=3)


@pytest.mark.parametrize("angle_multiple", [1, 2])
@pytest.mark.parametrize("reference", ["first", "absolute"])
def test_score_gradients(gradients_agree, reference: str, angle_multiple: int) -> None:
    residual = np.random.default_rng(3).normal(0, 0.4, 9)
    counted = jnp.asarray(np.arange(9) != 4)
    gradients_agree(
        lambda r, s: phase_score(r, counted, sigma_rad=s, reference=reference, angle_multiple=angle_multiple),
        (residual, np.array(0.3)),
    )


def test_gradient_reaches_the_places(gradients_agree) -> None:
    rng = np.random.default_rng(4)
    place = rng.normal(0, 0.3, (6, 3))
    measured = rng.uniform(0, 2 * np.pi, 6)

    def score(position, antenna):
        theory = theory_rad(position, antenna, jnp.full(6, 920e6, position.dtype))
        return phase_score(jnp.asarray(measured, theory.dtype) - theory, jnp.ones(6, bool), sigma_rad=1.0)

    gradients_agree(score, (place, np.array([1.0, 0.2, 0.5])), rtol=1e-4)
    at_antenna = jax.grad(lambda p: jnp.sum(theory_rad(p, jnp.zeros(3), jnp.full(2, 920e6))))(jnp.zeros((2, 3)))
    assert np.all(np.isfinite(at_antenna))


def _snapshots(seed: int = 0, *, candidates: int = 3, count: int = 60) -> Snapshots:
    rng = np.random.default_rng(seed)
    distance = 1.5 + np.cumsum(rng.normal(0, 0.03, (candidates, count)), axis=1)
    carrier = np.full(count, 920.625e6)
    phase = np.mod(4 * np.pi * carrier * distance[0] / C + rng.normal(0, 0.1, count) + 2.1, 2 * np.pi)
    valid = np.ones((candidates, count), bool)
    phases, carriers, distances = (jnp.asarray(x, jnp.float32) for x in (phase, carrier, distance))
    return Snapshots(phases, carriers, distances, jnp.asarray(valid))


def test_rounds_are_a_loop_over_scores_and_find_the_truth() -> None:
    snapshots, key = _snapshots(), jax.random.key(5)
    found = match_scores(snapshots, key=key, num_snapshots=12, num_rounds=4)
    residual = residuals_rad(snapshots, jnp.asarray(jnp.nan))
    loop = np.zeros(3)
    for part in jax.random.split(key, 4):
        index, counted = draw_snapshots(snapshots.valid[0], 12, key=part)
        assert counted.all()
        for number in range(3):
            loop[number] += _numpy_score(np.asarray(residual[number][index], np.float64)) / 4
    np.testing.assert_allclose(found, loop, atol=1e-4)
    eager = phase_score(residual[0], snapshots.valid[0], sigma_rad=SIGMA)
    jitted = jax.jit(lambda r, c: phase_score(r, c, sigma_rad=SIGMA))(residual[0], snapshots.valid[0])
    np.testing.assert_allclose(eager, jitted, atol=1e-6)
    assert int(jnp.argmax(found)) == 0
    assert float(found[0]) > 2 * float(jnp.max(found[1:]))


def test_snapshots_are_drawn_once_each_and_in_order() -> None:
    valid = jnp.asarray(np.arange(40) % 3 != 0)
    for seed in range(5):
        index, counted = draw_snapshots(valid, 15, key=jax.random.key(seed))
        assert counted.all()
        assert np.all(np.diff(index) > 0)
        assert np.all(np.asarray(valid)[index])
    index, counted = draw_snapshots(valid, 35, key=jax.random.key(0))
    assert int(counted.sum()) == int(valid.sum())
    assert sorted(np.asarray(index)[counted].tolist()) == np.flatnonzero(valid).tolist()
    drawn = [np.asarray(draw_snapshots(valid, 5, key=jax.random.key(seed))[0]).tolist() for seed in range(8)]
    assert len({tuple(one) for one in drawn}) == 8


def test_affine_channel_offsets_cancel() -> None:
    rng = np.random.default_rng(6)
    carrier = rng.choice(902.75e6 + 0.5e6 * np.arange(50), 80)
    distance = np.stack([rng.uniform(1, 2, 80), rng.uniform(1, 2, 80)])
    device = 0.4e-6
    off = carrier - carrier.mean()
    phase = 4 * np.pi * carrier * distance[0] / C + device * off + 0.7
    with jax.enable_x64(True):
        phases, carriers, distances = (
            jnp.asarray(x, jnp.float64) for x in (np.mod(phase, 2 * np.pi), carrier, distance)
        )
        snapshots = Snapshots(phases, carriers, distances, jnp.ones((2, 80), bool))
        slope = device + 4 * np.pi * distance[0].mean() / C
        right, wrong = np.exp(1j * np.asarray(residuals_rad(snapshots, jnp.asarray(slope))))
        untouched = np.exp(1j * np.asarray(residuals_rad(snapshots, jnp.asarray(jnp.nan)))[0])
    np.testing.assert_allclose(right, right[0], atol=1e-5)
    assert abs(wrong.mean()) < 0.5
    assert abs(untouched.mean()) < 0.5


# the simulation of Fig. 6


def test_planar_101_with_known_phases_is_as_the_paper_says() -> None:
    summary = line_scores(LineSettings(reference="absolute")).summary()
    assert summary["truth_is_maximum"] == 1.0
    assert summary["truth_is_maximum_fraction_of_rounds"] > 0.95
    assert summary["others_below_0.075"] >= 0.9
    # Not in the paper: neighbours, and lines half a wavelength away, are harder to distinguish.
    assert summary["neighbours"] > 0.3
    assert summary["others_max"] > 0.6


def test_planar_101_with_an_unknown_offset_needs_another_geometry() -> None:
    cases = {
        "stated": LineSettings(),
        "out of line": LineSettings(antenna_m=(1.018, -0.6)),
        "long": LineSettings(half_length_m=1.5),
        "circles": LineSettings(circle_m=1.0),
    }
    summary = {name: line_scores(settings).summary() for name, settings in cases.items()}
    assert summary["stated"]["others_min"] > 0.5
    assert summary["stated"]["others_below_0.075"] == 0.0
    assert summary["stated"]["truth_is_maximum_fraction_of_rounds"] < 0.1
    assert summary["stated"]["error_of_a_round_mm"] > 50
    for name, limit_mm in (("out of line", 25), ("long", 10), ("circles", 5)):
        assert summary[name]["truth_is_maximum"] == 1.0, name
        assert summary[name]["error_of_a_round_mm"] < limit_mm, name
        assert summary[name]["others_median"] < 0.45, name


# reads and frames


def test_the_nearest_read_is_the_nearest() -> None:
    rng = np.random.default_rng(12)
    frames, reads = np.sort(rng.uniform(0, 5, 40)), np.sort(rng.uniform(0.5, 4.5, 100))
    brute = np.argmin(np.abs(reads[None] - frames[:, None]), axis=1)
    np.testing.assert_array_equal(nearest_reads(frames, reads), brute)
    np.testing.assert_array_equal(nearest_reads(frames, reads[:1]), np.zeros(40, int))
    np.testing.assert_array_equal(nearest_reads(np.array([0.5]), np.array([0.0, 1.0])), [0])
    with pytest.raises(ValueError, match="no read"):
        nearest_reads(frames, reads[:0])


def test_pairing_excludes_unknown_positions_and_distant_frames() -> None:
    frames, reads = np.arange(10) / 10, np.array([0.04, 0.45, 0.9])
    place = np.column_stack([np.arange(10.0), np.zeros(10), np.zeros(10)])
    place[3] = np.nan
    index, where, counted = pair_nearest(frames, place, reads, max_gap_s=0.06)
    assert counted.tolist() == [
        abs(reads[i] - t) <= 0.06 and k != 3 for k, (i, t) in enumerate(zip(index, frames, strict=True))
    ]
    np.testing.assert_allclose(where[counted], place[counted])
    index, where, counted = pair_interpolated(frames, place, reads)
    assert index.tolist() == [0, 1, 2]
    np.testing.assert_allclose(where[:, 0], [0.4, 4.5, 9.0])
    assert counted.all()
    late = pair_interpolated(frames, place, np.array([0.25, 0.35, 1.2]))
    assert late[2].tolist() == [False, False, False]
    blank = pair_interpolated(frames, np.full_like(place, np.nan), reads)
    assert not blank[2].any()


def test_heading_is_along_the_path() -> None:
    time_s = np.arange(60) / 30
    angle = 1.5 * time_s
    circle = np.column_stack([np.cos(angle), np.sin(angle), np.full(60, 0.1)])
    found = motion_direction(time_s, circle)
    inner = slice(8, -8)
    np.testing.assert_allclose(found[inner, 0], -np.sin(angle)[inner], atol=0.01)
    np.testing.assert_allclose(found[inner, 1], np.cos(angle)[inner], atol=0.01)
    assert np.all(found[:, 2] == 0)
    assert np.all(np.isnan(motion_direction(time_s, np.broadcast_to([1.0, 2.0, 0.0], (60, 3)))))
    circle[20:30] = np.nan
    gap = motion_direction(time_s, circle)
    assert np.all(np.isnan(gap[20:30]))
    assert np.all(np.isfinite(gap[:20]))


# matching


@pytest.mark.parametrize("pairing", ["nearest", "interpolate"])
def test_tags_are_matched_to_their_paths(pairing: str) -> None:
    time_s, paths = scenes.curves(4)
    reads, when = scenes.make_reads({"A": paths[2], "B": paths[0]}, time_s, scenes.ANTENNA)
    settings = dataclasses.replace(QUICK, pairing=pairing)
    found = match_tags(("A", "B"), time_s, paths, reads, when, scenes.ANTENNA, settings)
    assert (found["A"].track, found["B"].track) == (2, 0)
    assert found["A"].confidence > 0.7
    assert set(found["A"].scores) == set(paths)


def test_the_offset_of_a_tag_ahead_of_its_host_is_found() -> None:
    time_s, paths = scenes.curves(3)
    ahead = motion_direction(time_s, paths[1], 0.05)
    reads, when = scenes.make_reads({"A": paths[1] + 0.1 * ahead}, time_s, scenes.ANTENNA)
    offsets = (0.0, 0.05, 0.1, 0.15)
    found = match_tags(
        ("A",), time_s, paths, reads, when, scenes.ANTENNA, dataclasses.replace(QUICK, tag_offsets_m=offsets)
    )["A"]
    middle = match_tags(("A",), time_s, paths, reads, when, scenes.ANTENNA, QUICK)["A"]
    assert found.track == 1
    assert found.tag_offset_m == pytest.approx(0.1)
    assert found.score > 1.5 * middle.scores[1]


def test_results_are_defined_for_unusual_input() -> None:
    time_s, paths = scenes.curves(2)
    reads, when = scenes.make_reads({"A": paths[0], "B": paths[0]}, time_s, scenes.ANTENNA)
    none = match_tags(("A",), time_s, {}, reads, when, scenes.ANTENNA, QUICK)["A"]
    assert (none.track, none.score, none.confidence) == (-1, 0.0, 0.0)
    unread = match_tags(("C",), time_s, paths, reads, when, scenes.ANTENNA, QUICK)["C"]
    assert unread.track == -1
    # More tags than blobs: one blob for both, or none for the tag that gains less.
    lone = {5: paths[0]}
    both = match_tags(("A", "B"), time_s, lone, reads, when, scenes.ANTENNA, QUICK)
    assert [both[epc].track for epc in "AB"] == [5, 5]
    assert both["A"].confidence == 1.0
    exclusive = match_tags(
        ("A", "B"), time_s, lone, reads, when, scenes.ANTENNA, dataclasses.replace(QUICK, exclusive=True)
    )
    assert sorted(exclusive[epc].track for epc in "AB") == [-1, 5]
    better = max("AB", key=lambda epc: both[epc].score)
    assert exclusive[better].track == 5
    # Equal traces: the older one, with confidence 1/2.
    equal = match_tags(("A",), time_s, {3: paths[0], 4: paths[0]}, reads, when, scenes.ANTENNA, QUICK)["A"]
    assert equal.track == 3
    assert equal.confidence == pytest.approx(0.5, abs=1e-6)
    # One sample, or none, is no evidence.
    once = match_tags(
        ("A",), time_s, paths, reads[:1], when[:1], scenes.ANTENNA, dataclasses.replace(QUICK, pairing="interpolate")
    )
    assert once["A"].track == -1
    hidden = {0: np.full_like(paths[0], np.nan), 1: paths[1]}
    assert match_tags(("A",), time_s, hidden, reads, when, scenes.ANTENNA, QUICK)["A"].track == 1


def test_a_short_track_is_no_candidate_with_a_minimum_fraction() -> None:
    time_s, paths = scenes.curves(2)
    reads, when = scenes.make_reads({"A": paths[0]}, time_s, scenes.ANTENNA)
    brief = np.full_like(paths[1], np.nan)
    brief[:24] = paths[1][:1] + 1e-4 * np.arange(24)[:, None]
    chosen = dataclasses.replace(QUICK, min_snapshot_fraction=0.5)
    found = match_tags(("A",), time_s, {0: paths[0], 1: brief}, reads, when, scenes.ANTENNA, chosen)["A"]
    assert set(found.scores) == {0}


def test_hop_slope_is_nan_without_hops() -> None:
    time_s, paths = scenes.curves(1)
    reads, when = scenes.make_reads({"A": paths[0]}, time_s, scenes.ANTENNA)
    slope = hop_slope_rad_hz(range_phase_rad(reads), when, np.asarray(reads.carrier_hz))
    assert np.isnan(slope)


def test_settings_are_checked() -> None:
    for wrong, message in (
        ({"num_snapshots": 1}, "num_snapshots is 1"),
        ({"tag_offsets_m": ()}, "tag_offsets_m is empty"),
        ({"sigma_rad": 0.0}, "sigma_rad 0.0"),
    ):
        with pytest.raises(ValueError, match=message):
            MatchSettings(**wrong)
    with pytest.raises(ValueError, match="antenna is 0"):
        TagVisionSettings(antenna=0)
    with pytest.raises(ValueError, match="confirm_frames 0"):
        TrackSettings(confirm_frames=0)


# the experiments


def test_configurations_fit_their_schemas(tmp_path: Path) -> None:
    values = composed("tagvision", "suite=planar_tracks")
    values.pop("progress")
    config = from_mapping(TagVisionExperiment, values)
    assert config.system.match == config.matching["adapted"]
    assert config.matching["paper"] == MatchSettings()
    assert config.system.blobs == BlobSettings()
    assert config.system.tracks == TrackSettings()
    values = composed("calibrate_camera", "pictures=here")
    values.pop("progress")
    assert from_mapping(CalibrateSettings, values).board == Board()
    lines = dataclasses.replace(config, suite=None, num_calibrations=1, lines=config.lines[:2])
    metrics = run_tagvision(lines, tmp_path)
    assert json.loads((tmp_path / "metrics.json").read_text()) == json.loads(json.dumps(metrics))
    assert set(metrics["lines"]) == {"stated", "stated with unknown offset"}
    assert "| stated |" in (tmp_path / "table.md").read_text()
    assert cv2.imread(str(tmp_path / "lines.png")) is not None
    with pytest.raises(ValueError, match="split is 'all'"):
        dataclasses.replace(config, split="all")


def test_a_suite_of_lines_is_refused(tmp_path: Path) -> None:
    values = composed("tagvision", "suite=planar_101", f"paths.recordings_dir={tmp_path / 'recordings'}")
    values.pop("progress")
    with pytest.raises(ConfigError, match=r"planar_101 has no pictures.*suite=planar_tracks"):
        run_tagvision(from_mapping(TagVisionExperiment, values), tmp_path / "out")
    assert not list(tmp_path.iterdir())


@pytest.mark.ci
def test_planar_tracks_run_whole(tmp_path: Path) -> None:
    values = composed(
        "tagvision", "suite=planar_tracks", "suite.duration_s=4.0", "suite.counts.test=1", "num_calibrations=1",
        f"paths.recordings_dir={tmp_path / 'recordings'}",
    )  # fmt: skip
    values["suite"]["counts"] |= {"train": 0, "validation": 0}
    values["suite"]["variants"] = [one for one in values["suite"]["variants"] if one["name"] == "three"]
    values.pop("progress")
    metrics = run_tagvision(from_mapping(TagVisionExperiment, values), tmp_path / "run")
    tracks = metrics["tracks"]
    assert tracks["transform_error_mm"]["mean"] <= 1.56
    assert tracks["matching"]["adapted"]["blob_matching"] == 1.0
    assert tracks["matching"]["adapted"]["tracking_error_mm"] <= 10.33
    for name in ("matching.png", "errors.png", "tags.csv", "table.md"):
        assert (tmp_path / "run" / name).is_file()
