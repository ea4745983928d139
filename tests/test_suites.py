"""Benchmark suites: every file under conf/benchmark is one, splits are apart, and runs resume and repeat exactly."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from tagjax.config import ConfigError, from_mapping
from tagjax.data.store import open_recording
from tagjax.recording import RecordingError
from tagjax.sim.planar import PlanarSettings, open_planar, planar_trials
from tagjax.sim.stories import STORIES
from tagjax.sim.suites import MANIFEST, PLANAR, SPLITS, Counts, Suite, Variant, make_suite, prepare, stage_item
from tagjax.viz.contact_sheet import save_sheet

FILES = sorted((Path(__file__).parents[1] / "conf" / "benchmark").glob("*.yaml"))


def _suite(path: Path) -> Suite:
    return from_mapping(Suite, yaml.safe_load(path.read_text()))


def _tiny(**changed) -> Suite:
    variants = (Variant("one", {"num_objects": 1}), Variant("two", {"num_objects": 2}))
    suite = Suite("tiny", "a test", "none", "tabletop", 5, variants=variants).smoke()
    return dataclasses.replace(suite, duration_s=0.8, **changed)


def _digest(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_file_is_a_suite(path):
    suite = _suite(path)
    assert suite.name == path.stem
    assert suite.about
    assert suite.story == PLANAR or suite.story in STORIES
    assert suite.items()
    for variant in suite.variants:
        dataclasses.replace(suite.capture, **variant.capture)


def test_the_documentation_lists_every_suite_with_its_counts():
    page = (FILES[0].parents[2] / "docs" / "benchmark.md").read_text()
    for path in FILES:
        suite = _suite(path)
        counts = [len(suite.variants) * count for count in dataclasses.astuple(suite.counts)]
        assert (
            f"| `{suite.name}` | {suite.about} | {len(suite.variants)} | {counts[0]} / {counts[1]} / {counts[2]} |"
            in page
        )
        assert (FILES[0].parents[2] / "docs" / "benchmark" / f"{suite.name}.jpg").exists()


def test_no_two_recordings_share_a_seed():
    seeds = [item.seed for path in FILES for item in _suite(path).items()]
    assert len(set(seeds)) == len(seeds)
    assert {item.split for path in FILES for item in _suite(path).items()} == set(SPLITS)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_suite_finds_room_for_its_story(path):
    suite = _suite(path)
    if suite.story == PLANAR:
        return
    suite = dataclasses.replace(suite, duration_s=min(suite.duration_s, 5.0), counts=Counts(0, 0, 1))
    for item in suite.items():
        stage_item(item).world.check()


def test_a_killed_run_goes_on_and_repeats_exactly(tmp_path):
    suite = _tiny()
    made = make_suite(suite, tmp_path / "a")
    assert [one.name for one in made] == ["tiny-one-test-0", "tiny-two-test-0"]
    whole = _digest(tmp_path / "a")
    # What a kill leaves: one recording finished, a half-written one beside it.
    first, second = (item.path(tmp_path / "b") for item in suite.items())
    prepare(suite, tmp_path / "b")
    (second.parent / f".{second.name}.0123.partial").mkdir(parents=True)
    first.parent.mkdir(exist_ok=True)
    (tmp_path / "a" / first.relative_to(tmp_path / "b")).rename(first)
    stamp = first.stat().st_mtime_ns
    assert [one.name for one in make_suite(suite, tmp_path / "b")] == ["tiny-two-test-0"]
    assert first.stat().st_mtime_ns == stamp
    assert _digest(tmp_path / "b") == whole
    assert make_suite(suite, tmp_path / "b") == []
    sheet = cv2.imread(str(save_sheet(suite, tmp_path / "b")))
    assert sheet is not None
    assert sheet.shape[1] > 6 * 190
    assert sheet.std() > 10
    recording = open_recording(second)
    assert recording.name == "tiny-two-test-0"
    assert recording.truth is not None
    assert len(recording.truth.tag_to_label) == 2


@pytest.mark.slow
def test_workers_change_nothing(tmp_path):
    make_suite(_tiny(), tmp_path / "one")
    make_suite(_tiny(), tmp_path / "two", workers=2)
    assert _digest(tmp_path / "one") == _digest(tmp_path / "two")


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_every_suite_in_small(path, tmp_path):
    suite = _suite(path).smoke()
    assert len(make_suite(suite, tmp_path)) == len(suite.variants)
    for item in suite.items():
        if suite.story == PLANAR:
            open_planar(item.path(tmp_path))
        else:
            open_recording(item.path(tmp_path)).check()


def test_a_folder_that_holds_something_else_is_left_alone(tmp_path):
    home = tmp_path / "tiny"
    home.mkdir()
    (home / "thesis.txt").write_text("precious")
    with pytest.raises(RecordingError, match="holds something else"):
        make_suite(_tiny(), tmp_path)
    assert [path.name for path in home.iterdir()] == ["thesis.txt"]
    (home / "thesis.txt").unlink()
    home.rmdir()
    prepare(_tiny(), tmp_path)
    with pytest.raises(RecordingError, match=r"other settings \(seed\)"):
        prepare(dataclasses.replace(_tiny(), seed=6), tmp_path)
    assert json.loads((home / MANIFEST).read_text())["seed"] == 5


def test_impossible_suites_are_refused():
    given = {"name": "x", "about": "x", "paper": "x", "story": "juggle", "seed": 1}
    with pytest.raises(ConfigError, match="unknown story 'juggle'"):
        from_mapping(Suite, given)
    with pytest.raises(ConfigError, match="duration_s is 0"):
        from_mapping(Suite, {**given, "story": "handheld", "duration_s": 0.0})
    with pytest.raises(ConfigError, match="unknown key 'durations'"):
        from_mapping(Suite, {**given, "durations": 3})
    full = Suite("x", "x", "x", "tabletop", 1, settings={"num_objects": 40}, counts=Counts(0, 0, 1))
    with pytest.raises(ValueError, match=r"x-all-test-0 .*draws in vain.*do not fit"):
        stage_item(full.items()[0])


def test_planar_trials_follow_the_geometry(tmp_path):
    """Without noise the phase is that of the true line, and of no other: TagVision's Fig. 6."""
    trials = planar_trials(PlanarSettings(noise_rad=0.0, num_rounds=3), seed=1)
    assert trials.line_m[trials.true_line] == 0
    np.testing.assert_allclose(np.diff(trials.line_m), 0.006)
    assert (trials.line_m[0], trials.line_m[-1]) == pytest.approx((-0.3, 0.3))
    for line, agrees in ((trials.true_line, True), (0, False)):
        distance = np.hypot(trials.line_m[line] - 1.018, trials.sample_m)
        apart = trials.phase_rad - 4 * np.pi * trials.carrier_hz * distance / 299792458.0
        score = np.abs(np.mean(np.exp(1j * apart), axis=1))
        np.testing.assert_allclose(np.angle(np.exp(1j * apart)) if agrees else score * 0, 0, atol=1e-9)
        assert agrees or score.max() < 0.999
    suite = Suite("planar", "a test", "none", PLANAR, 2, counts=Counts(0, 0, 1), settings={"num_rounds": 2})
    make_suite(suite, tmp_path)
    stored = open_planar(suite.items()[0].path(tmp_path))
    np.testing.assert_array_equal(
        stored.phase_rad, planar_trials(PlanarSettings(num_rounds=2), seed=suite.items()[0].seed).phase_rad
    )
    with pytest.raises(RecordingError, match="no readable planar trials"):
        open_planar(tmp_path / "nothing")
    with pytest.raises(ValueError, match="at least 1, 2 and 1"):
        PlanarSettings(num_samples=1)
