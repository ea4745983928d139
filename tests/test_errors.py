"""How a command ends when something is wrong."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from experiments import errors
from experiments.errors import errors_in_one_line

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("error", [ValueError("no such tag"), FileNotFoundError("no such tag"), OSError("no such tag")])
def test_errors_that_the_user_can_correct_take_one_line(error: Exception) -> None:
    with pytest.raises(SystemExit, match=r"^trace: no such tag$") as ended, errors_in_one_line("trace"):
        raise error
    assert ended.value.__cause__ is error


def test_other_errors_keep_their_traceback_unless_listed() -> None:
    with pytest.raises(RuntimeError), errors_in_one_line("trace"):
        raise RuntimeError("a defect")
    with pytest.raises(SystemExit, match="trace: diverged"), errors_in_one_line("trace", RuntimeError):
        raise RuntimeError("diverged")


def test_the_place_is_shown_on_demand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "TRACEBACK_WANTED", True)
    with pytest.raises(ValueError, match="no such tag"), errors_in_one_line("trace"):
        raise ValueError("no such tag")


def test_the_command_ends_with_the_known_choices(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "experiments.evaluate", "tracer=tagvision", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    assert "Could not find 'tracer/tagvision'" in done.stderr
    assert "tagattention_published" in done.stderr


def test_a_command_ends_with_one_line(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "experiments.evaluate", f"run={tmp_path}", f"hydra.run.dir={tmp_path / 'out'}"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"evaluate: run={tmp_path}: found no {tmp_path}/config.yaml; expected a run folder")
