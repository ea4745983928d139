"""How a command ends when something is wrong."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from hydra import compose, initialize_config_dir
from hydra.core.hydra_config import HydraConfig

from experiments.errors import in_a_line, refuse_dropped_choices
from experiments.evaluate import FORERUNNERS

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize("error", [ValueError("no such tag"), FileNotFoundError("no such tag")])
def test_what_can_be_mended_is_said_in_a_line(error: Exception) -> None:
    with pytest.raises(SystemExit, match=r"^trace: no such tag$") as said, in_a_line("trace"):
        raise error
    assert said.value.__cause__ is error


def test_other_errors_are_not_hidden_but_for_those_named() -> None:
    with pytest.raises(RuntimeError), in_a_line("trace"):
        raise RuntimeError("a defect")
    with pytest.raises(SystemExit, match="trace: diverged"), in_a_line("trace", RuntimeError):
        raise RuntimeError("diverged")


def test_the_place_is_shown_on_demand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HYDRA_FULL_ERROR", "1")
    with pytest.raises(ValueError, match="no such tag"), in_a_line("trace"):
        raise ValueError("no such tag")


def test_ctrl_c_ends_with_its_own_status(capsys: pytest.CaptureFixture) -> None:
    with pytest.raises(SystemExit) as said, in_a_line("trace"):
        raise KeyboardInterrupt
    assert said.value.code == 130
    assert "trace: interrupted" in capsys.readouterr().out


@contextmanager
def _composed(name: str, *overrides: str) -> Iterator[None]:
    with (
        initialize_config_dir(str((ROOT / "conf").resolve()), version_base="1.3"),
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setattr(HydraConfig.instance(), "cfg", compose(name, list(overrides), return_hydra_config=True))
        yield


@pytest.mark.parametrize(
    ("name", "override", "known"),
    [
        ("tagvision", "benchmark=planar_trcks", "planar_tracks"),
        ("evaluate", "tracer=magic", "tagattention, tagattention_handheld, tagattention_paper"),
        ("evaluate", "tracer@baselines.paper=magic", "tagattention_paper"),
        ("train", "experiment=handhold", "handheld"),
        ("train", "joint=pyramids", "pyramid"),
        ("train", "debug=on", "default"),
        ("train_flow", "recipe=rafft", "raft"),
        ("train", "search=optun", "optuna"),
    ],
)
def test_a_choice_that_hydra_drops_is_refused(name: str, override: str, known: str) -> None:
    with _composed(name, override), pytest.raises(ValueError, match=rf"^{override}: there is no such .*{known}"):
        refuse_dropped_choices()


@pytest.mark.parametrize(
    ("name", "overrides"),
    [
        ("tagvision", ["benchmark=planar_tracks"]),
        ("tagvision", []),
        ("evaluate", ["tracer=tagattention", "tracer@baselines.paper=tagattention_paper"]),
        ("train", ["experiment=handheld", "joint=pyramid", "logger=disabled"]),
        ("train", ["debug=default"]),
        ("train_flow", ["recipe=raft"]),
    ],
)
def test_choices_that_exist_are_taken(name: str, overrides: list[str]) -> None:
    with _composed(name, *overrides):
        refuse_dropped_choices(FORERUNNERS)


def test_the_command_ends_with_what_to_do(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "experiments.evaluate", "tracer=tagvision", f"hydra.run.dir={tmp_path}"]
    done = subprocess.run(run, capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 1
    assert "evaluate: tracer=tagvision: there is no such choice; tagvision sees pictures" in done.stderr
    assert "host_trace" in done.stderr
