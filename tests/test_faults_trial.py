"""The command `experiments.fault_trial` in small: results, pages, interruptions."""

from __future__ import annotations

import json
import random
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tagjax.benchmarks.faults import kinds, real_tables
from tagjax.benchmarks.faults.outcome import MAX_EXAMPLES, Outcome, joined
from tagjax.benchmarks.faults.run import FaultTrialSettings, num_failed, read_results, rendered, run_trial
from tagjax.benchmarks.faults.sound_tables import sound_lines, sound_reads
from tagjax.core.errors import RecordingError
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.reproduce.markdown import replaced

ROOT = Path(__file__).parents[1]


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A kind `counted` of which every hundredth fault fails; the list holds the numbers that were asked for."""
    calls: list[int] = []

    def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
        assert list(folder.iterdir()) == []
        calls.append(number)
        return [Outcome("a", number, number // 100, (f"seed {seed}",) * (number // 100)), Outcome("b", 1, 0)]

    monkeypatch.setitem(kinds.KINDS, "counted", trial)
    return calls


def test_outcomes_of_a_kind_are_added_with_the_first_examples() -> None:
    found = joined([Outcome("a", 2, 1, ("x",)), Outcome("b", 1, 0), Outcome("a", 9, 9, ("y",) * 9)])
    assert found == [Outcome("a", 11, 10, ("x", *["y"] * (MAX_EXAMPLES - 1))), Outcome("b", 1, 0)]


def test_a_kind_is_tried_in_parts_and_the_same_seed_gives_the_same_results(tmp_path: Path, counted: list[int]) -> None:
    shown: list[tuple[str, int, int]] = []
    settings = FaultTrialSettings(("counted",), 1200, 7)
    results = run_trial(settings, tmp_path / "a.json", on_progress=lambda *one: shown.append(one))
    assert counted == [500, 500, 200]
    assert shown == [("counted", done, 1200) for done in (0, 500, 1000, 1200)]
    (kind,) = results["kinds"].values()
    assert [(one["kind"], one["tried"], one["failed"]) for one in kind["outcomes"]] == [("a", 1200, 12), ("b", 3, 0)]
    again = run_trial(settings, tmp_path / "b.json")
    assert again["kinds"]["counted"]["outcomes"] == kind["outcomes"]
    assert num_failed(results) == 12
    seeds = {example for one in kind["outcomes"] for example in one["examples"]}
    other = run_trial(FaultTrialSettings(("counted",), 500, 8), tmp_path / "c.json")["kinds"]["counted"]["outcomes"]
    assert seeds.isdisjoint(other[0]["examples"])


def test_an_interrupted_trial_keeps_every_part_that_was_finished(
    tmp_path: Path, counted: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "results.json"
    run_trial(FaultTrialSettings(("counted",), 300), path)
    whole = kinds.KINDS["counted"]

    def interrupted(number: int, seed: int, folder: Path) -> list[Outcome]:
        if len(counted) == 3:
            raise KeyboardInterrupt
        return whole(number, seed, folder)

    monkeypatch.setitem(kinds.KINDS, "later", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_trial(FaultTrialSettings(("later",), 2000), path)
    results = read_results(path)
    assert [(name, kind["done"]) for name, kind in results["kinds"].items()] == [("counted", 300), ("later", 1000)]
    assert "| `later` | 2 | 1,002 | 10 | `number=2000 seed=0`, stopped after 1000 |" in rendered(results)


def test_results_are_a_table_of_kinds_with_failures_and_settings(tmp_path: Path, counted: list[int]) -> None:
    results = run_trial(
        FaultTrialSettings(("counted",), 200, 3),
        tmp_path / "results.json",
        about={"commit": "ab" * 20, "date_utc": "2026-01-02T03:04:05+00:00"},
    )
    text = rendered(results)
    made = "`number=200 seed=3`, revision `ababababab`, 2026-01-02"
    assert f"| `counted` | 2 | 201 | 2 | {made} |\n| all | 2 | 201 | 2 |  |" in text
    assert "- a: seed " in text
    assert "has not been run yet" in rendered(read_results(tmp_path / "none.json"))


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (
            {"kinds": ["tables", "nothing"]},
            "expected different ones of clocks, names, targets, tables, real_tables, weights, kills",
        ),
        ({"kinds": ["tables", "tables"]}, "expected different ones"),
        ({"number": 0}, "expected at least 1 and 0"),
        ({"seed": -1}, "expected at least 1 and 0"),
    ],
)
def test_settings_that_cannot_be_used_are_refused(values: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        from_mapping(FaultTrialSettings, values)


@pytest.mark.parametrize("content", ["[1", "[]", '{"format": "other"}'])
def test_a_file_of_other_results_is_refused(tmp_path: Path, content: str) -> None:
    (tmp_path / "results.json").write_text(content)
    with pytest.raises(ValueError, match=r"results\.json: .*Remove it, and try the faults again"):
        read_results(tmp_path / "results.json")


def test_the_page_shows_the_results_of_its_json() -> None:
    text = (ROOT / "docs" / "reliability.md").read_text()
    assert replaced(text, "faults", rendered(read_results(ROOT / "docs" / "reliability.json"))) == text


def test_real_tables_are_damaged_where_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("TAGJAX_REAL_DATA", raising=False)
    with pytest.raises(RecordingError, match="found no table of reads"):
        real_tables.trial(1, 0, tmp_path)
    folder = tmp_path / "data" / "rfid" / "reader"
    folder.mkdir(parents=True)
    (folder / "a.csv").write_text("\n".join(sound_lines("octane", sound_reads(200, random.Random(0)))))
    (folder / "b.csv").write_text("no,table,of,reads\n1,2,3,4\n")
    monkeypatch.setenv("TAGJAX_REAL_DATA", str(tmp_path / "data"))
    assert {name: len(lines) for name, lines in real_tables.real_tables(tmp_path / "data").items()} == {"a.csv": 120}
    assert real_tables.trial(20, 0, tmp_path) == [Outcome("real tables, octane", 20, 0)]


def test_the_command_writes_and_prints_its_results(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "experiments.fault_trial", "number=20", "progress=false", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.returncode == 0, done.stderr
    assert re.search(r"\| all \| \d+ \| 120 \| 0 \|", done.stdout)
    results = json.loads(done.stdout.splitlines()[-1])
    assert results == read_results(tmp_path / "fault_trial.json")
    assert list(results["kinds"]) == ["clocks", "names", "targets", "tables", "weights"]
    assert (tmp_path / "config.yaml").is_file()
