"""The benchmark measures what it names, and refuses what it does not know."""

from __future__ import annotations

import pytest

from tagjax.benchmarks.stages import CASES, BenchmarkSettings, run_benchmark
from tagjax.core.machine import machine
from tagjax.core.settings import ConfigError, from_mapping


def test_cases_give_times_of_both_and_their_ratio():
    result: list[str] = []
    settings = BenchmarkSettings(cases=("gather", "coherence"), height=48, width=64, repeats=2)
    running = run_benchmark(settings, on_case=result.append)
    timings = [next(running)]
    assert result == ["gather"]  # each figure comes when it is found
    timings += running
    assert result == ["gather", "coherence"]
    for timing in timings:
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
    assert set(CASES) - set(BenchmarkSettings().cases) == {"training", "tracer"}  # which take minutes
