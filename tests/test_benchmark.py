"""The benchmark measures what it names, and refuses what it does not know."""

from __future__ import annotations

import itertools
import sys

import numpy as np
import pytest
from synthetic_clips import recording

from experiments import benchmark
from tagjax.benchmarks.stages import CASES, BenchmarkSettings, run_benchmark
from tagjax.benchmarks.timing import Figure, Timing
from tagjax.benchmarks.tracer_speed import MemorySettings, TracerSpeedSettings, tracer_figures
from tagjax.benchmarks.tracer_speed.memory import growth_figures
from tagjax.benchmarks.tracer_speed.swing import Swing
from tagjax.core.machine import machine, peak_memory_mib, resident_memory_mib
from tagjax.core.settings import ConfigError, from_mapping


def test_cases_give_times_of_both_and_their_ratio():
    result: list[tuple] = []
    settings = BenchmarkSettings(cases=("gather", "coherence"), height=48, width=64, repeats=2)
    running = run_benchmark(settings, on_progress=lambda *one: result.append(one))
    timings = [next(running)]
    assert result == [("measure", 0, 2, "gather")]  # each figure comes when it is found
    timings += running
    assert result[1:] == [("measure", 1, 2, "coherence"), ("measure", 2, 2)]
    for timing in timings:
        assert isinstance(timing, Timing)
        assert timing.ours_ms > 0
        assert timing.peer_ms > 0
        assert timing.ratio == pytest.approx(timing.ours_ms / timing.peer_ms)
    assert "64x48" in timings[0].what
    assert machine()["cores"] >= 1


def test_unknown_cases_and_empty_pictures_are_refused():
    with pytest.raises(ConfigError, match="cases: found warp; expected some of gather, splat"):
        from_mapping(BenchmarkSettings, {"cases": ["warp"]})
    with pytest.raises(ValueError, match="at least 32x32"):
        BenchmarkSettings(height=1)
    assert set(CASES) - set(BenchmarkSettings().cases) == {"training", "tracer", "memory"}  # which take minutes


def test_a_swing_has_every_read_of_every_tag_and_no_jump():
    one = recording(12, rate_hz=10.0)
    swing = Swing.of(one, num_tags=5)
    shots = list(swing.shots(50))
    assert len(swing.epcs) == 5
    assert np.diff([shot.time_ns for shot in shots]) == pytest.approx(1e8)
    for before, shot in itertools.pairwise(shots):
        assert np.all((shot.reads.time_ns > before.time_ns) & (shot.reads.time_ns <= shot.time_ns))
        assert np.max(np.abs(shot.depth_m - before.depth_m)) < 0.2
    np.testing.assert_array_equal(shots[22].depth_m, shots[0].depth_m)  # a period of forth and back
    np.testing.assert_array_equal(shots[15].depth_m, shots[7].depth_m)
    stamps = np.concatenate([shot.reads.time_ns for shot in shots])
    assert np.all(np.diff(stamps) >= 0)
    # 60 reads a second and tag of which a swing of 1.1 s has 66 each way.
    assert len(stamps) == pytest.approx(4.9 * 60 * 5, rel=0.05)


def test_figures_stand_beside_their_aims():
    assert [Figure("a", value, "ms", 2.0).reached for value in (2.0, 2.1)] == [True, False]
    assert Figure("a", 1.0, "ms").reached is None
    with pytest.raises(ValueError, match="part_frames is 2; expected at least 8"):
        TracerSpeedSettings(part_frames=2)
    with pytest.raises(ValueError, match="frames is 3000; expected at least 4000"):
        MemorySettings(frames=3000)


def test_growth_of_memory_is_that_of_the_medians():
    grows = 100.0 + 0.5 * np.arange(40)
    grows[[3, 35]] += 30.0  # what the allocator has yet to return
    *after, growth = growth_figures(grows, 500)
    assert [one.value for one in after] == grows.tolist()
    assert after[-1].what == "resident memory after 20000 frames"
    assert growth.value == pytest.approx(1.0, rel=0.05)  # MiB in 1000 frames
    assert growth.reached is False
    assert list(growth_figures(np.full(8, 77.0), 1000))[-1].value == 0.0


def test_resident_memory_counts_what_is_held():
    before = resident_memory_mib()
    held = np.ones(2**24)  # 128 MiB
    assert resident_memory_mib() - before == pytest.approx(held.nbytes / 2**20, abs=20)
    assert resident_memory_mib() <= peak_memory_mib()


def test_names_of_cases_are_arguments(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(benchmark, "run", lambda: None)
    monkeypatch.setattr(sys, "argv", ["benchmark", "tracer", "flow", "repeats=3", "--help"])
    benchmark.main()
    assert sys.argv == ["benchmark", "cases=[tracer,flow]", "repeats=3", "--help"]
    monkeypatch.setattr(sys, "argv", ["benchmark", "repeats=3"])
    benchmark.main()
    assert sys.argv == ["benchmark", "repeats=3"]


@pytest.mark.ci
def test_the_tracer_is_measured_in_small():
    pytest.importorskip("mujoco", reason="needs the sim extra")
    small = TracerSpeedSettings(width=64, simulated_frames=45, stride=1, frames=12, part_frames=8)
    found = list(tracer_figures(small, 0))
    figures = {one.what: one for one in found if isinstance(one, Figure)}
    assert all(np.isfinite(one.value) and one.value > 0 for one in figures.values())
    assert {one.aim for one in figures.values()} >= {25.0, 40.0, 2.5, 1.0, 0.5, 12.0, 4.0, 1024.0}
    assert sum(isinstance(one, Timing) for one in found) == 3
    first = [figures[f"first mask of a process, {state}"].value for state in ("nothing compiled", "compilation cache")]
    assert first[1] < first[0]
