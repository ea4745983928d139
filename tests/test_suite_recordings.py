"""Recordings of suites: simulated where missing, once, also by several processes, and used as training data."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import pytest
import yaml

from experiments.suites import suite_recordings
from tagjax.sim import suites
from tagjax.sim.suites import PLANAR, Counts, Suite, make_suite

WALKERS = Path(__file__).parents[1] / "conf" / "suite" / "walkers.yaml"


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


def test_recordings_of_a_split_are_simulated_once(tmp_path, monkeypatch):
    settings = yaml.safe_load(WALKERS.read_text())
    settings |= {"duration_s": 1.0, "capture": {"width": 32, "frame_rate_hz": 4.0}, "counts": {"train": 2, "test": 0}}
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    paths = suite_recordings(settings, "train", str(tmp_path))
    assert [Path(path).name for path in paths] == ["walkers-all-train-0.zarr", "walkers-all-train-1.zarr"]
    assert all(Path(path).is_dir() for path in paths)
    assert not (tmp_path / "walkers" / "validation").exists()
    # The second time nothing is simulated.
    monkeypatch.setattr(suites, "make_item", None)
    assert suite_recordings(settings, "train", str(tmp_path)) == paths
    with pytest.raises(ValueError, match=r"walkers has no test recording; .*suite\.counts\.test"):
        suite_recordings(settings, "test", str(tmp_path))
