"""An interrupted command prints the command that resumes it."""

from __future__ import annotations

import shlex
import signal
from pathlib import Path

import pytest
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from experiments.errors import ending_in_one_line, errors_in_one_line
from experiments.resumption import resumable, resume_command
from tagjax.core.interruption import Terminated

FOLDER = "hydra.run.dir=outputs/train/a"


@pytest.mark.parametrize(
    ("argv", "expected"),
    [
        (["/x/experiments/train.py"], f"python -m experiments.train {FOLDER}"),
        (["/x/bin/tagjax-train", "seed=1"], f"tagjax-train seed=1 {FOLDER}"),
        (["-c", "-m", "seed=0,1"], f"python -m experiments.train -m seed=0,1 {FOLDER}"),
        (["train.py", "data.recordings=[a.zarr,b.zarr]"], f"python -m experiments.train 'data.recordings=[a.zarr,b.zarr]' {FOLDER}"),
        (["train.py", "hydra.run.dir=x", "++hydra.sweep.dir=y", "resume=false", "retune=true"], f"python -m experiments.train retune=true {FOLDER}"),
    ],
)  # fmt: skip
def test_the_same_arguments_with_the_folder_of_the_run(argv: list[str], expected: str) -> None:
    assert resume_command("train", argv, FOLDER) == expected


def _job(monkeypatch: pytest.MonkeyPatch, folder: Path, mode: str = "RUN") -> None:
    config = OmegaConf.create(
        {"hydra": {"mode": mode, "runtime": {"output_dir": str(folder / "0" if mode == "MULTIRUN" else folder)},
                   "sweep": {"dir": str(folder)}}}
    )  # fmt: skip
    monkeypatch.setattr(HydraConfig, "get", lambda: config.hydra)
    monkeypatch.setattr(HydraConfig, "initialized", lambda: True)
    monkeypatch.setattr("experiments.resumption.sweeping", lambda: mode == "MULTIRUN")


@pytest.mark.parametrize(
    "name", ["run", "a b", "lr=0.1,seed=2", "it's", "back\\slash", "end\\", "{x}", "[a]", "öl", "null"]
)
@pytest.mark.parametrize(("mode", "key"), [("RUN", "hydra.run.dir"), ("MULTIRUN", "hydra.sweep.dir")])
def test_hydra_reads_the_folder_as_it_is(
    name: str, mode: str, key: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    _job(monkeypatch, tmp_path / "outputs" / name, mode)
    monkeypatch.setattr("sys.argv", ["train.py", "seed=1"])
    with pytest.raises(SystemExit) as ended, ending_in_one_line("train"), resumable("train"):
        raise KeyboardInterrupt
    assert ended.value.code == 130
    first, second = capsys.readouterr().err.strip().splitlines()
    assert first == "train: interrupted by Ctrl-C."
    *words, override = shlex.split(second.removeprefix("resume with: "))
    assert words == ["python", "-m", "experiments.train", "seed=1"]
    (read,) = OverridesParser.create().parse_overrides([override])
    assert (read.key_or_group, read.value()) == (key, f"outputs/{name}")


def test_a_folder_elsewhere_is_given_in_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    _job(monkeypatch, tmp_path / "there")
    monkeypatch.setattr("sys.argv", ["train.py"])
    with (
        pytest.raises(SystemExit) as ended,
        ending_in_one_line("train"),
        resumable("train"),
        errors_in_one_line("train"),
    ):
        raise Terminated
    assert ended.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err.endswith(
        f"\nresume with: python -m experiments.train hydra.run.dir={tmp_path}/there\n"
    )


def test_an_error_is_no_interruption(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    _job(monkeypatch, tmp_path)
    with pytest.raises(SystemExit, match=r"^train: no such tag$"), ending_in_one_line("train"), resumable("train"), errors_in_one_line("train"):  # fmt: skip
        raise ValueError("no such tag")


def test_commands_that_resume_are_those_that_say_so() -> None:
    """The others begin again; recordings that they have simulated, and cached flow, are there then."""
    root = Path(__file__).parents[1] / "experiments"
    found = {path.stem for path in root.glob("*.py") if "\n@resumable_command\n" in path.read_text()}
    assert found == {"train", "train_flow", "simulate", "sweep_paper", "reproduce", "paper"}
