"""Two processes on one machine learn what one process learns; only the first of them writes."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
import synthetic_clips as synthetic
from test_resume import _kept, _steps_logged, _train, _train_flow

ROOT = Path(__file__).parents[1]
pytestmark = [pytest.mark.ci, pytest.mark.filterwarnings("ignore")]


def _free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def _start(commands: list[list[str]]) -> list[subprocess.Popen]:
    """As many processes as commands, which find each other on loopback."""
    environment = {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    together = [f"distributed.coordinator=127.0.0.1:{_free_port()}", f"distributed.num_processes={len(commands)}"]
    if len(commands) == 1:
        together = []
    return [
        subprocess.Popen(
            [*command, *together, *([f"distributed.process_id={number}"] if together else [])],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for number, command in enumerate(commands)
    ]


def _finish(*commands: list[str]) -> list[str]:
    processes = _start(list(commands))
    try:
        found = [process.communicate(timeout=550)[0] for process in processes]
    finally:
        for process in processes:
            process.kill()
    for process, text in zip(processes, found, strict=True):
        assert process.returncode == 0, text[-3000:]
    return found


def _rows(run: Path) -> list[dict]:
    return [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]


def _alike(one: Path, two: Path) -> None:
    """Two clips a step: their mean is one sum of two, whichever process took which. Measured: not one bit differs."""
    rows, others = _rows(one), _rows(two)
    assert [row["step"] for row in rows] == [row["step"] for row in others]
    for mine, theirs in zip(rows, others, strict=True):
        assert mine.keys() == theirs.keys()
        for name in mine:
            assert theirs[name] == pytest.approx(mine[name], rel=1e-5, abs=1e-8), name
    (arrays, about), (others, other_about) = _kept(one), _kept(two)
    assert about == other_about
    for name, leaf in arrays.items():
        np.testing.assert_allclose(others[name], leaf, rtol=1e-5, atol=1e-8)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    return synthetic.stored(tmp_path_factory.mktemp("recordings"), 40)


def test_two_processes_learn_tracing_as_one_does(recordings: list[str], tmp_path: Path) -> None:
    more = [f"data.validation=[{recordings[1]}]", "loop.validate_every=8", "scores.num_pictures=2"]
    one, first, second = (tmp_path / name for name in ("one", "first", "second"))
    _finish(_train(recordings[0], one, *more))
    found = _finish(*(_train(recordings[0], run, *more) for run in (first, second)))
    _alike(one, first)
    assert (first / "report" / "frames.csv").is_file()
    assert (first / "metrics.json").is_file()
    assert {path.name for path in second.iterdir()} <= {"config.yaml", "train.log"}
    assert "IoU" in found[0]
    assert "IoU" not in found[1]


def test_two_processes_learn_flow_as_one_does(tmp_path: Path) -> None:
    one, first, second = (tmp_path / name for name in ("one", "first", "second"))
    _finish(_train_flow(tmp_path, one))
    _finish(*(_train_flow(tmp_path, run) for run in (first, second)))
    rows, others = _rows(one), _rows(first)
    assert [row["step"] for row in rows] == [row["step"] for row in others]
    # Sums in another order differ in their last bits, and each step of training lets that grow: later ones say less.
    for mine, theirs in zip(rows[:5], others[:5], strict=True):
        assert theirs["loss"] == pytest.approx(mine["loss"], rel=1e-5)
        assert theirs["gradient_norm"] == pytest.approx(mine["gradient_norm"], rel=2e-4)
    for mine, theirs in zip(rows[5:16], others[5:16], strict=True):
        assert theirs["loss"] == pytest.approx(mine["loss"], rel=0.01)
    assert (first / "weights.safetensors").is_file()
    assert {path.name for path in second.iterdir()} <= {"config.yaml", "train_flow.log"}


def test_when_one_is_killed_none_hangs_and_all_resume(recordings: list[str], tmp_path: Path) -> None:
    one, first, second = (tmp_path / name for name in ("one", "first", "second"))
    _finish(_train(recordings[0], one))
    processes = _start([_train(recordings[0], run) for run in (first, second)])
    while 6 not in _steps_logged(first):
        assert all(process.poll() is None for process in processes)
        time.sleep(0.005)
    processes[1].send_signal(signal.SIGKILL)
    assert processes[0].wait(timeout=300) != 0  # the other one notices
    for process in processes:
        process.communicate()
    assert max(_steps_logged(first)) < 16
    # One process goes on where two were: the place in the data is common to all.
    _finish(_train(recordings[0], first))
    _alike(one, first)
