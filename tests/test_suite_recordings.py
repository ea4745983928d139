"""Recordings of suites as training data: simulated where missing, once, also by several processes."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import yaml

from tagjax.config import ConfigError, DataSettings
from tagjax.sim import suites
from tagjax.sim.suites import PLANAR, Counts, Suite, make_suite
from tagjax.training.sources import training_recordings

WALKERS = Path(__file__).parents[1] / "conf" / "benchmark" / "walkers.yaml"


def test_processes_that_make_one_suite_take_turns(tmp_path, monkeypatch):
    """Two threads stand for two jobs of a sweep: the lock is one of the open file, so it keeps threads apart as well."""
    suite = Suite("lines", "x", "x", PLANAR, 1, counts=Counts(1, 1, 1))
    made, real = [], suites.make_item

    def slow(item, folder):
        time.sleep(0.1)
        made.append(item.name)
        return real(item, folder)

    monkeypatch.setattr(suites, "make_item", slow)
    jobs = [threading.Thread(target=make_suite, args=(suite, tmp_path)) for _ in range(2)]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join()
    assert sorted(made) == ["lines-all-test-0", "lines-all-train-0", "lines-all-validation-0"]


def test_training_uses_the_splits_of_a_suite(tmp_path, monkeypatch):
    settings = yaml.safe_load(WALKERS.read_text())
    settings |= {"duration_s": 1.0, "capture": {"width": 32, "frame_rate_hz": 4.0}, "counts": {"train": 2, "test": 1}}
    data = DataSettings(suite=settings, suites_folder=str(tmp_path))
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    training, validation = training_recordings(data)
    assert [recording.name for recording in training] == ["walkers-all-train-0", "walkers-all-train-1"]
    assert [recording.name for recording in validation] == ["walkers-all-validation-0"]
    assert not (tmp_path / "walkers" / "test").exists()
    # Kept: the second time nothing is simulated.
    monkeypatch.setattr(suites, "make_item", None)
    again, _ = training_recordings(data)
    np.testing.assert_array_equal(np.asarray(again[0].colour[0]), np.asarray(training[0].colour[0]))


@pytest.mark.parametrize(
    ("suite", "message"),
    [
        (None, "data.suite is null; expected recordings to train on"),
        (
            {"name": "x", "about": "x", "paper": "x", "story": PLANAR, "seed": 1},
            "data.suite is x, which has no recordings",
        ),
        (
            {"name": "x", "about": "x", "paper": "x", "story": "walkers", "seed": 1, "counts": {"train": 0}},
            "counts.train of at least 1",
        ),
        ({"name": "x"}, "missing"),
    ],
)
def test_suites_that_cannot_be_trained_on_are_refused(suite, message, tmp_path):
    with pytest.raises(ConfigError, match=message):
        training_recordings(DataSettings(suite=suite, suites_folder=str(tmp_path)))
