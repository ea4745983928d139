"""Runs that are killed: what they resume to, with and without worker processes, and that nothing of them lives on."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import numpy as np
import orbax.checkpoint as ocp
import psutil
import pytest
import synthetic_clips as synthetic

from tagjax.core.stream import _begin_worker
from tagjax.recording.store import save_recording
from tagjax.training.clip_dataset import clip_dataset

ROOT = Path(__file__).parents[1]
NUM_STEPS = 16


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("recordings") / "scene.zarr"
    save_recording(synthetic.enlarged(synthetic.recording(40), 4), path)
    return str(path)


def _train(recording: str, run: Path, *more: str) -> list[str]:
    return [
        *(sys.executable, "-m", "experiments.train"),
        *("experiment=clips", f"data.recordings=[{recording}]"),
        *("data.clips.stride=4", "data.clips.length=8", "data.clips.estimator=literal"),
        # The smallest to compile that learns.
        *("tracer=tagattention_literal", "tracer.cell=4", "tracer.softness=1.0", "~baselines"),
        *(f"loop.num_steps={NUM_STEPS}", "loop.batch_size=2", "loop.checkpoint_every=4", "loop.progress=false"),
        *("objective.span_frames=4", "objective.skip_frames=3", "objective.max_reads=64", "objective.num_channels=4"),
        *("logger=disabled", f"hydra.run.dir={run}", *more),
    ]


def _train_flow(folder: Path, run: Path) -> list[str]:
    return [
        *(sys.executable, "-m", "experiments.train_flow"),
        *("flow.widths=[4,4]", "flow.radii=[1,1]", "flow.iterations=[1,1]", "flow.decoder_widths=[[4],[4]]"),
        *("data.drawn.num_pairs=32", "data.drawn.num_validation=16", "data.drawn.photographs=false"),
        *("data.drawn.pairs.height=48", "data.drawn.pairs.width=48", f"data.drawn.folder={folder}"),
        *("data.variation.height=32", "data.variation.width=32", "data.variation.scale=[1.0,1.2]"),
        *("loss.data=photometric", "loss.occlusion=false", "loss.level_weights=[1.0,0.5]"),
        *(f"loop.num_steps={NUM_STEPS}", "loop.batch_size=2", "loop.checkpoint_every=4", "loop.validate_every=100"),
        *("loop.log_every=1", "loop.progress=false", "logger=disabled", f"hydra.run.dir={run}"),
    ]


def _environment() -> dict[str, str]:
    return {**os.environ, "JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}


def _finish(command: list[str]) -> None:
    done = subprocess.run(command, cwd=ROOT, env=_environment(), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-3000:]


def _steps_logged(run: Path) -> list[int]:
    path = run / "metrics.jsonl"
    text = path.read_text() if path.exists() else ""
    return [json.loads(line)["step"] for line in text.splitlines() if line.endswith("}")]


def _kill_when(command: list[str], run: Path, step: int) -> list[psutil.Process]:
    """Start, wait until that step is logged, SIGKILL; the processes that it had started."""
    with subprocess.Popen(command, cwd=ROOT, env=_environment(), stdout=subprocess.DEVNULL) as process:
        while step not in _steps_logged(run):
            assert process.poll() is None, "the run ended before it could be killed"
            time.sleep(0.01)
        started = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(signal.SIGKILL)
        process.wait()
    return started


def _kept(run: Path) -> tuple[dict[str, np.ndarray], dict]:
    """The arrays of the newest checkpoint, and what is written beside them."""
    with ocp.CheckpointManager(run / "checkpoints") as manager:
        step = manager.latest_step()
        assert step == NUM_STEPS
        found = manager.restore(
            step, args=ocp.args.Composite(arrays=ocp.args.StandardRestore(), about=ocp.args.JsonRestore())
        )
    return {name: np.asarray(leaf) for name, leaf in found["arrays"].items()}, found["about"]


def _same(one: Path, two: Path) -> None:
    (arrays, about), (others, other_about) = _kept(one), _kept(two)
    assert arrays.keys() == others.keys()
    for name, leaf in arrays.items():
        np.testing.assert_array_equal(leaf, others[name])
    assert about == other_about  # the data iterator's state is in it
    assert about["data"] == {"samples": 2 * NUM_STEPS}
    lines = [[json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()] for run in (one, two)]
    assert lines[0] == lines[1]


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore")  # Orbax guesses shardings when told none
@pytest.mark.parametrize("workers", [0, 2])
def test_a_killed_run_resumes_bit_for_bit(recording: str, tmp_path: Path, workers: int) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    more = [f"data.clips.workers={workers}"]
    _finish(_train(recording, straight, *more))
    for step in (6, 11):  # between checkpoints 4 and 8, 8 and 12
        started = _kill_when(_train(recording, broken, *more), broken, step)
        assert len([one for one in started if "spawn_main" in " ".join(_command(one))]) >= workers or not workers
        gone, alive = psutil.wait_procs(started, timeout=20)
        assert not alive, f"{len(alive)} of {len(gone) + len(alive)} processes outlived the run"
    _finish(_train(recording, broken, *more))
    _same(straight, broken)


def _command(process: psutil.Process) -> list[str]:
    try:
        return process.cmdline()
    except psutil.Error:
        return ["spawn_main"]  # gone already


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore")
def test_a_killed_flow_run_resumes_bit_for_bit(tmp_path: Path) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    _finish(_train_flow(tmp_path, straight))
    _kill_when(_train_flow(tmp_path, broken), broken, 6)
    _finish(_train_flow(tmp_path, broken))
    _same(straight, broken)


def _clips(workers: int = 0, shard: tuple[int, int] = (0, 1)):
    held = synthetic.enlarged(synthetic.recording(12), 4)
    return iter(
        clip_dataset(
            [held], clip_length=4, stride=4, step=1, seed=3, flow="dis_ultrafast", workers=workers, shard=shard
        )
    )


def _worker(begun) -> None:
    _begin_worker(0, 1)
    begun.set()
    time.sleep(60)


def test_a_scheduler_s_sigterm_leaves_workers_time_for_the_last_step() -> None:
    context = multiprocessing.get_context("spawn")
    begun = context.Event()
    worker = context.Process(target=_worker, args=(begun,), daemon=True)
    worker.start()
    try:
        assert begun.wait(120)
        worker.terminate()
        worker.join(1.0)
        assert worker.is_alive()
    finally:
        worker.kill()
        worker.join()


@pytest.mark.ci
def test_shares_of_a_stream_are_the_stream_and_places_are_common() -> None:
    whole, parts = _clips(), [_clips(shard=(number, 2)) for number in range(2)]
    starts = [next(whole).start for _ in range(8)]
    assert len(set(starts)) > 4
    assert [next(parts[place % 2]).start for place in range(8)] == starts
    assert parts[0].get_state() == parts[1].get_state() == whole.get_state() == {"samples": 8}
    # Nine places: the second epoch has begun. One process goes on where two were.
    whole.set_state({"samples": 2})
    assert [next(whole).start for _ in range(6)] == starts[2:]
    with pytest.raises(ValueError, match="number drawn"):
        whole.set_state({"place": 3})


@pytest.mark.ci
def test_workers_load_the_same_clips_and_go_on_anywhere(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")  # as `conftest` has it: a worker compiles as this process
    plain, helped = _clips(), _clips(workers=2)
    for _ in range(5):
        one, two = next(plain), next(helped)
        assert jax.tree.structure(one) == jax.tree.structure(two)
        assert all(isinstance(leaf, jax.Array) for leaf in jax.tree.leaves(two))
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
            np.testing.assert_array_equal(a, b)
    place = helped.get_state()
    following = [next(helped) for _ in range(3)]
    helped.close()
    again = _clips(workers=1)
    again.set_state(place)
    for one in following:
        two = next(again)
        assert jax.tree.structure(one) == jax.tree.structure(two)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(two), strict=True):
            np.testing.assert_array_equal(a, b)
    again.close()
