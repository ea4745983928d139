"""Tables of what other commands measure: values in the cells, what is run and what is stored, errors."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from experiments.reproduce import run_command
from tagjax.core.settings import ConfigError, from_mapping
from tagjax.evaluation.reproduce.commands import Command, CommandRecipe, filled_in, make_command_table
from tagjax.evaluation.reproduce.markdown import not_made
from tagjax.evaluation.reproduce.status import stale, status

RESULTS: dict[str, Any] = {
    "one": {
        "paper": {"error_mm": 10.33},
        "mean": {"value": 0.7, "low": 0.651, "high": 0.75, "count": 30},
        "one": {"value": 0.4, "low": None, "high": None, "count": 30},
        "parts": [{"name": "a", "num": 2, "iou": 0.7}, {"name": "b", "num": 2, "iou": None}],
    }
}
RECIPE: dict[str, Any] = {
    "name": "small",
    "title": "A small table",
    "pages": ["page.md"],
    "commands": {
        "tracks": {"command": "tagvision", "overrides": ["suite=planar_tracks"], "suites": ["planar_tracks"]},
        "lines": {"command": "tagvision"},
    },
    "columns": {"measure": "measure", "here": "here"},
    "rows": [
        {"label": "TagVision", "cells": {"measure": "error | mm", "here": "{tracks/error_mm:.2f} of {lines/num}"}},
        {"label": "", "cells": {"here": "{lines/found:.1%}"}},
    ],
    "depends": ["code.py"],
}  # fmt: skip


def _recipe(**changed: Any) -> CommandRecipe:
    return from_mapping(CommandRecipe, {**RECIPE, **changed}, where="table small")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A repository in small: code, and a page with markers."""
    (tmp_path / "code.py").write_text("one = 1\n")
    (tmp_path / "page.md").write_text(f"<!-- table: small -->\n{not_made('small')}\n<!-- /table -->\n")
    return tmp_path


class Runs:
    """Commands with fixed results, which are counted."""

    def __init__(self) -> None:
        self.lines: list[str] = []

    def __call__(self, name: str, command: Command) -> Any:
        self.lines.append(f"{name}: {command.line}")
        return {"error_mm": 5.194, "num": 24, "found": 0.0719, "several": [1]}


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("no value", "no value"),
        ("{one/paper/error_mm:.1f} mm", "10.3 mm"),
        ("{one/paper/error_mm}", "10.33"),
        ("{one/parts/0/name}: {one/parts/name=a,num=2/iou:.0%}", "a: 70 %"),
        ("{{as it is}}", "{as it is}"),
        ("{one/mean:.2f}, {one/one:.1%}", "0.70 [0.65, 0.75], 40.0 %"),
    ],
)
def test_values_stand_in_the_text(text: str, shown: str) -> None:
    assert filled_in(text, RESULTS) == shown


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{one/paper/error}", r"one/paper/error: found no error in one/paper; expected one of: error_mm\."),
        ("{one/parts/7/name}", r"found no 7 in one/parts; expected one of 2, by number or values\."),
        ("{one/parts/num=2/name}", r"found no num=2 in one/parts"),
        ("{one/paper/error_mm/x}", r"found no x in one/paper/error_mm; expected no further step, for it is 10\.33\."),
        ("{one/paper}", r"one/paper: found several values; expected the path of one\."),
        ("{one/parts/1/iou:.2f}", r"one/parts/1/iou: found None, which has no format '\.2f'\."),
        ("{one/paper", r"expected values in braces"),
        ("{one.__class__}", r"found no one\.__class__ in the results"),
    ],
)
def test_a_path_that_leads_nowhere_is_told(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        filled_in(text, RESULTS)


def test_a_table_of_commands_is_made_and_goes_stale(root: Path, tmp_path: Path) -> None:
    recipe, runs = _recipe(), Runs()
    assert recipe.suites() == ["planar_tracks"]
    make_command_table(recipe, root, runs, finished=tmp_path / "finished")
    assert runs.lines == [
        "tracks: python -m experiments.tagvision suite=planar_tracks",
        "lines: python -m experiments.tagvision",
    ]
    page = (root / "page.md").read_text()
    assert [line for line in page.splitlines() if line.startswith("|")] == [
        "| | measure | here |",
        "|---|---|---|",
        "| TagVision | error \\| mm | 5.19 of 24 |",
        "|  |  | 7.2 % |",
    ]
    assert "Made by `python -m experiments.reproduce table=small`" in page
    assert "It runs `python -m experiments.tagvision suite=planar_tracks`, `python -m experiments.tagvision`." in page
    assert status(recipe, root) == []

    make_command_table(recipe, root, runs, finished=tmp_path / "finished")
    assert len(runs.lines) == 2  # results are stored
    (root / "code.py").write_text("one = 2\n")
    assert stale(recipe, root) == ["code.py (changed)"]
    make_command_table(recipe, root, runs, finished=tmp_path / "finished")
    assert len(runs.lines) == 4
    assert stale(recipe, root) == []


def test_a_failure_loses_nothing_that_was_measured(root: Path, tmp_path: Path) -> None:
    done = Runs()

    def run(name: str, command: Command) -> Any:
        if name == "lines":
            raise ValueError("experiments.tagvision: exit status 1. no such suite")
        return done(name, command)

    with pytest.raises(ValueError, match="exit status 1"):
        make_command_table(_recipe(), root, run, finished=tmp_path / "finished")
    assert not (root / "docs").exists()
    again = Runs()
    make_command_table(_recipe(), root, again, finished=tmp_path / "finished")
    assert again.lines == ["lines: python -m experiments.tagvision"]


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"commands": {"a": {"command": "shell"}}}, "command.*'shell'"),
        ({"commands": {"a": {"command": "tagview", "overrides": ["hydra.run.dir=/"]}}}, "found hydra.run.dir=/"),
        ({"commands": {"a": {"command": "tagview", "overrides": ["--multirun"]}}}, "found --multirun"),
        ({"rows": [{"label": "a", "cells": {"there": "x"}}]}, "row 'a': found there; expected some of measure, here"),
        ({"rows": [{"label": "a", "cells": {"here": "{x/y}"}}]}, "row 'a': found x; expected some of tracks, lines"),
        ({"rows": [{"label": "a", "cells": {"here": "{x"}}]}, "expected values in braces"),
        ({"depends": ["../code.py"]}, "expected a path within the repository"),
    ],
)  # fmt: skip
def test_a_wrong_recipe_is_refused(changed: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        _recipe(**changed)


@pytest.mark.ci
def test_a_command_is_run_and_its_last_line_is_the_result(tmp_path: Path) -> None:
    few = Command("tagvision", ("lines=[]", "num_calibrations=1"))
    found = run_command(few, tmp_path / "recordings", tmp_path / "run")
    assert found["paper"]["blob_matching"] == 0.98
    assert found["calibration"]["one_place"]["transform_error_mm"] > 0
    wrong = Command("tagvision", ("num_calibrations=0",))
    with pytest.raises(
        ValueError, match=r"experiments\.tagvision num_calibrations=0: exit status 1\..*num_calibrations"
    ):
        run_command(wrong, tmp_path / "recordings", tmp_path / "run")
