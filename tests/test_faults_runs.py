"""Runs that are interrupted, that find a full or read-only disk, or that find their folder in use: nothing is lost."""

from __future__ import annotations

import errno
import os
import pickle
import re
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import textwrap
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import psutil
import pytest
import synthetic_clips as synthetic
from test_main_job import _values
from test_resume import NUM_STEPS, _environment, _finish, _same, _steps_logged, _train

from tagjax.core import files
from tagjax.core.files import WriteError, atomic_path, write_atomic
from tagjax.core.folder_lock import FolderLockedError, locked_folder
from tagjax.core.interruption import Terminated
from tagjax.core.settings import from_mapping
from tagjax.flow import cache
from tagjax.recording.image_files import write_image
from tagjax.recording.store import save_recording
from tagjax.training import loop
from tagjax.training import run as run_module
from tagjax.training.config import TrainConfig
from tagjax.training.loop import TrainingResult
from tagjax.training.run import run_training

ROOT = Path(__file__).parents[1]
STATUS = {signal.SIGINT: 130, signal.SIGTERM: 143}
TEXT = {signal.SIGINT: "interrupted by Ctrl-C.", signal.SIGTERM: "ended by SIGTERM."}
NO_WARNINGS = {"PYTHONWARNINGS": "ignore"}  # of a recording without reads
both_signals = pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=["ctrl_c", "sigterm"])


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("recordings") / "scene.zarr"
    save_recording(synthetic.enlarged(synthetic.recording(40), 4), path)
    return str(path)


def _start(command: list[str], **environment: str) -> subprocess.Popen[str]:
    pipes: dict[str, Any] = {
        "stdout": subprocess.PIPE,
        "stderr": subprocess.PIPE,
        "text": True,
        "start_new_session": True,
    }
    return subprocess.Popen(command, cwd=ROOT, env=_environment() | environment, **pipes)


def _signal_when(process: subprocess.Popen[str], ready: Callable[[], Any], number: int) -> str:
    """Send the signal, when the program is ready for it, to all its processes, and return what they write to stderr."""
    try:
        deadline = time.monotonic() + 200
        while not ready():
            assert process.poll() is None, process.communicate()[1][-3000:]
            assert time.monotonic() < deadline
            time.sleep(0.01)
        os.killpg(process.pid, number)  # as a terminal and a scheduler do
        return process.communicate(timeout=200)[1]
    finally:
        process.kill()


def _blocking_module(folder: Path, name: str) -> dict[str, str]:
    """A module that never finishes its import, and that turns Ctrl-C into an ImportError as extension modules may."""
    (folder / f"{name}.py").write_text(
        textwrap.dedent(f"""
        import pathlib, time
        pathlib.Path({str(folder / "importing")!r}).touch()
        try:
            time.sleep(300)
        except KeyboardInterrupt as error:
            raise ImportError("initialization failed") from error
        """)
    )
    return {"PYTHONPATH": str(folder)}


COMMANDS = {
    "module": [sys.executable, "-m", "experiments.train"],
    "console": [sys.executable, "-c", "import tagjax.cli; tagjax.cli.train()"],
}


@both_signals
@pytest.mark.parametrize("command", COMMANDS.values(), ids=COMMANDS)
def test_a_command_that_is_interrupted_before_hydra_is_there_ends_in_one_line(
    command: list[str], number: signal.Signals, tmp_path: Path
) -> None:
    process = _start(command, **_blocking_module(tmp_path, "hydra"))
    error = _signal_when(process, (tmp_path / "importing").exists, number)
    assert process.returncode == STATUS[number]
    assert error.strip() == TEXT[number][0].upper() + TEXT[number][1:]


@both_signals
@pytest.mark.ci
@pytest.mark.parametrize("more", [[], ["-m", "seed=0,1"]], ids=["run", "sweep"])
def test_a_command_that_is_interrupted_during_its_imports_ends_in_one_line(
    more: list[str], number: signal.Signals, tmp_path: Path
) -> None:
    folders = [f"hydra.run.dir={tmp_path / 'run'}", f"hydra.sweep.dir={tmp_path / 'sweep'}"]
    process = _start([*COMMANDS["module"], *more, *folders], **_blocking_module(tmp_path, "optax"))
    error = _signal_when(process, (tmp_path / "importing").exists, number)
    assert process.returncode == STATUS[number]
    folder = f"hydra.{'sweep' if more else 'run'}.dir={tmp_path / ('sweep' if more else 'run')}"
    assert error.strip().splitlines() == [
        f"train: {TEXT[number]}",
        f"resume with: {shlex.join(['python', '-m', 'experiments.train', *more, folder])}",
    ]
    assert not (tmp_path / "sweep" / "1").exists()  # later jobs do not start


def test_an_interruption_that_python_ignores_in_a_callback_is_raised_again() -> None:
    script = """
        import gc, os, signal, time
        from tagjax.core.interruption import raise_on_signals

        calls = []
        def collected(phase, info):
            calls.append(phase)
            if len(calls) == 1:
                os.kill(os.getpid(), signal.SIGTERM)
        try:
            with raise_on_signals():
                gc.callbacks.append(collected)
                gc.collect()
                time.sleep(30)
        except BaseException as error:
            print(type(error).__name__)
    """
    process = _start([sys.executable, "-c", textwrap.dedent(script)])
    output, error = process.communicate(timeout=60)
    assert output.strip() == "Terminated"
    assert not error


def _tum_folder(folder: Path) -> Path:
    """Two images in TUM's layout."""
    for kind, picture in (("rgb", np.zeros((480, 640, 3), np.uint8)), ("depth", np.full((480, 640), 5000, np.uint16))):
        (folder / kind).mkdir(parents=True)
        for number in range(2):
            cv2.imwrite(str(folder / kind / f"{number}.png"), picture)
        (folder / f"{kind}.txt").write_text(
            "".join(f"{1e9 + number / 30:.4f} {kind}/{number}.png\n" for number in range(2))
        )
    return folder


@both_signals
def test_an_interrupted_import_leaves_nothing_half_written(number: signal.Signals, tmp_path: Path) -> None:
    video, out = _tum_folder(tmp_path / "freiburg3_test"), tmp_path / "out" / "a.zarr"
    slow = """
        import time
        import tagjax.cli, tagjax.recording.store as store

        def slowly(recording, root, progress=False):
            root.create_array("colour", shape=(2,), dtype="uint8")[:] = 1
            time.sleep(300)

        store.write_recording = slowly
        tagjax.cli.import_recording()
    """
    arguments = [f"video={video}", f"out={out}", f"hydra.run.dir={tmp_path / 'run'}"]
    process = _start([sys.executable, "-c", textwrap.dedent(slow), *arguments], **NO_WARNINGS)
    error = _signal_when(process, lambda: list(out.parent.glob(".a.zarr.*.partial/colour")), number)
    assert process.returncode == STATUS[number]
    assert error.strip() == f"import_recording: {TEXT[number]}"
    assert list(out.parent.iterdir()) == []


@pytest.mark.ci
@both_signals
def test_an_interrupted_simulation_ends_with_its_workers(number: signal.Signals, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    command = [sys.executable, "-m", "experiments.simulate", "suite=corpus", "suite.counts.train=6", "workers=2"]
    arguments = [f"paths.recordings_dir={tmp_path}", "progress=false", f"hydra.run.dir={tmp_path / 'run'}"]
    process, workers = _start([*command, *arguments]), []

    def writing() -> bool:
        workers[:] = psutil.Process(process.pid).children(recursive=True) if process.poll() is None else workers
        return bool(list(tmp_path.glob("corpus/*/.*.partial")))

    error = _signal_when(process, writing, number)
    assert process.returncode == STATUS[number]
    first, second = error.strip().splitlines()
    assert first == f"simulate: {TEXT[number]}"
    assert second.startswith("resume with: python -m experiments.simulate ")
    assert len(workers) >= 2
    assert psutil.wait_procs(workers, timeout=20)[1] == []
    assert not list(tmp_path.glob("corpus/*/.*.partial"))


@pytest.mark.parametrize(
    ("number", "expected"),
    [(signal.SIGTERM, Terminated), (signal.SIGINT, KeyboardInterrupt)],
    ids=["sigterm", "ctrl_c"],
)
def test_training_that_was_stopped_raises_after_its_checkpoint(
    number: signal.Signals, expected: type, scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    values = _values([scene, scene])
    values["data"]["validation"] = []
    monkeypatch.setattr(run_module, "train", lambda state, *_, **__: TrainingResult(state, number))
    with pytest.raises(KeyboardInterrupt) as stopped:
        run_training(from_mapping(TrainConfig, values), tmp_path)
    assert type(stopped.value) is expected
    with locked_folder(tmp_path):  # the lock was released
        pass


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore")  # Orbax guesses how arrays are placed on devices
def test_a_run_that_sigterm_stopped_does_not_start_the_next_command_and_resumes(scene: str, tmp_path: Path) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    _finish(_train(scene, straight))
    resume: list[str] = []
    for step, number in ((5, signal.SIGTERM), (10, signal.SIGINT)):
        process = _start(_train(scene, broken))
        error = _signal_when(process, lambda step=step: step in _steps_logged(broken), number)
        assert process.returncode == STATUS[number]
        first, second = error.strip().splitlines()[-2:]
        assert first == f"train: {TEXT[number]}"
        resume = shlex.split(second.removeprefix("resume with: "))
        assert resume[:3] == ["python", "-m", "experiments.train"]
        stopped = max(int(path.name) for path in (broken / "checkpoints").iterdir())
        assert step <= stopped < NUM_STEPS
        assert stopped == _steps_logged(broken)[-1]
    _finish([sys.executable, *resume[1:]])  # as it is printed
    _same(straight, broken)


@pytest.mark.ci
@both_signals
def test_training_that_is_interrupted_while_its_workers_import_ends_in_one_line(
    number: signal.Signals, scene: str, tmp_path: Path
) -> None:
    process = _start(_train(scene, tmp_path / "run", "data.clips.workers=2"))

    def started() -> bool:
        return process.poll() is None and len(psutil.Process(process.pid).children(recursive=True)) > 2

    error = _signal_when(process, started, number)
    assert process.returncode == STATUS[number]
    assert error.strip().splitlines()[-2] == f"train: {TEXT[number]}"
    assert "Traceback" not in error


@pytest.mark.parametrize(("status", "requeued"), [(0, False), (1, False), (130, False), (143, True)])
def test_the_slurm_recipe_starts_only_a_run_again_that_sigterm_ended(
    status: int, requeued: bool, tmp_path: Path
) -> None:
    recipe = re.search(r"```bash\n(#!/bin/bash\n.*?)```", (ROOT / "docs" / "clusters.md").read_text(), re.DOTALL)
    assert recipe is not None
    programs = {"srun": f"exit {status}", "scontrol": f'echo "$@" > {tmp_path / "requeued"}'}
    for name, line in programs.items():
        (tmp_path / name).write_text(f"#!/bin/sh\n{line}\n")
        (tmp_path / name).chmod(0o755)
    environment = {"PATH": f"{tmp_path}:{os.environ['PATH']}", "SLURM_JOB_ID": "17"}
    subprocess.run(["bash", "-c", recipe[1]], env=environment, cwd=tmp_path, check=True)
    assert (tmp_path / "requeued").exists() == requeued
    assert not requeued or (tmp_path / "requeued").read_text() == "requeue 17\n"


@pytest.mark.parametrize("number", [errno.ENOSPC, errno.EROFS, errno.EACCES, errno.EDQUOT, errno.EFBIG])
def test_a_refused_file_is_named_with_the_reason_and_nothing_is_left(
    number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "metrics.json"
    path.write_text("before")

    def refused(self: Path, content: bytes) -> int:
        with self.open("wb") as file:
            file.write(content[:3])
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "write_bytes", refused)
    with pytest.raises(WriteError) as found:
        write_atomic(path, "a new content")
    text = str(found.value)
    assert text.startswith(f"{path} could not be written: {os.strerror(number)}. ")
    assert "\n" not in text
    assert [one.name for one in tmp_path.iterdir()] == ["metrics.json"]
    assert path.read_text() == "before"
    copy = pickle.loads(pickle.dumps(found.value))  # as a worker process sends it
    assert (str(copy), copy.errno) == (text, number)


def test_errors_about_other_files_are_left_as_they_are(tmp_path: Path) -> None:
    with pytest.raises(PermissionError) as found, atomic_path(tmp_path / "out" / "a.zarr"):
        raise PermissionError(errno.EACCES, "Permission denied", "/elsewhere/source.png")
    assert not isinstance(found.value, WriteError)
    with pytest.raises(FileNotFoundError), atomic_path(tmp_path / "b"):
        (tmp_path / "gone").read_bytes()


def test_a_file_in_the_place_of_a_folder_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(WriteError, match=r"file/run could not be written: Not a directory"):
        write_atomic(tmp_path / "file" / "run" / "a.json", "")
    command = [*COMMANDS["module"], f"hydra.run.dir={tmp_path / 'file' / 'run'}"]
    process = _start(command)
    error = process.communicate(timeout=100)[1]
    assert process.returncode == 1
    assert re.fullmatch(r"train: \S+/file/run could not be written: Not a directory\. [^\n]+", error.strip())


def test_every_file_is_written_whole_or_not_at_all() -> None:
    written = re.compile(
        r"""\.write_(text|bytes)\(|imwrite\(|savefig\((?!partial)|\.tofile\(|np\.save|open\((\w+, )?["'][wax]b?["']"""
    )
    allowed = {
        "tagjax/core/files.py",
        "tagjax/training/logging.py",  # metrics.jsonl grows by lines; an incomplete last one is dropped
        "tagjax/evaluation/sweep.py",  # lines.jsonl as well
        "tagjax/live/stream.py",  # frames.jsonl and events.jsonl as well
        "tagjax/recording/capture/writer.py",  # chunks that no reader sees before the metadata names them
        "tagjax/evaluation/paper/traced.py",  # into a partial file of atomic_path
        "tagjax/report/paper/style.py",  # into memory
    }
    files = [path for folder in ("tagjax", "experiments") for path in (ROOT / folder).rglob("*.py")]
    found = {
        str(path.relative_to(ROOT))
        for path in files
        if written.search(path.read_text()) and "benchmarks/faults" not in str(path)  # makes the faults
    }
    assert found == allowed


SMALL_FILES = """
import resource, sys
sys.dont_write_bytecode = True  # Python 3.11 keeps .pyc files of which only a part could be written
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)), resource.RLIM_INFINITY))
"""
"""The start of a program that the system lets write no greater file; part of the file is written, as on a full disk."""


def test_pictures_and_figures_that_do_not_fit_leave_the_earlier_ones(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    script = """
        from pathlib import Path
        import numpy as np
        from tagjax.core.files import WriteError
        from tagjax.flow.flo_files import write_flo
        from tagjax.recording.image_files import write_image
        from tagjax.report.figure import blank, save_figure

        folder, noise = Path(sys.argv[1]), np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
        for write in (
            lambda: write_image(folder / "a.png", noise),
            lambda: write_image(folder / "a.jpg", noise),
            lambda: write_flo(folder / "a.flo", noise[..., :2].astype(np.float32)),
            lambda: save_figure(blank(3, 3), folder / "b.png", dpi=100),
        ):
            try:
                write()
            except WriteError as error:
                print(error)
    """
    names = ["a.png", "a.jpg", "a.flo", "b.png"]
    for name in names:
        (tmp_path / name).write_text("earlier")
    process = _start([sys.executable, "-c", SMALL_FILES + textwrap.dedent(script), "500", str(tmp_path)])
    lines = process.communicate(timeout=100)[0].splitlines()
    assert [line.partition(" could")[0] for line in lines] == [str(tmp_path / name) for name in names]
    assert all("File too large" in line for line in lines)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(names, "earlier")


@pytest.mark.ci
@pytest.mark.filterwarnings("ignore")
def test_a_run_on_a_full_disk_ends_in_one_line_and_resumes(scene: str, tmp_path: Path) -> None:
    straight, broken = tmp_path / "straight", tmp_path / "broken"
    command = _train(scene, straight)
    _finish(command)
    metrics = (straight / "metrics.jsonl").stat().st_size
    command = _train(scene, broken)
    limited = [sys.executable, "-c", f"{SMALL_FILES}\nimport tagjax.cli; tagjax.cli.train()", str(3 * metrics // 4)]
    process = _start([*limited, *command[3:]], JAX_ENABLE_COMPILATION_CACHE="false")
    error = process.communicate(timeout=400)[1]
    assert process.returncode == 1
    assert re.fullmatch(rf"train: {broken}/metrics.jsonl could not be written: File too large\. [^\n]+", error.strip())
    assert {path.name for path in (broken / "checkpoints").iterdir()} >= {"4", "8"}
    _finish(command)
    _same(straight, broken)


@pytest.mark.ci
def test_a_full_disk_leaves_the_checkpoints_before_it(tmp_path: Path) -> None:
    script = """
        import equinox as eqx, jax, jax.numpy as jnp
        from tagjax.core.files import WriteError
        from tagjax.training.checkpoint import Checkpoints

        class State(eqx.Module):
            step: jax.Array
            weights: jax.Array

        with Checkpoints(sys.argv[1]) as checkpoints:
            print(checkpoints.steps())
            for step, size in ((1, 10), (2, 30_000)):
                noise = jax.random.normal(jax.random.key(step), (size,))
                try:
                    checkpoints.save(State(jnp.asarray(step), noise), {"samples": step})
                except WriteError as error:
                    print(error)
            print(checkpoints.steps())
    """
    for limit, expected in ((30_000, ["[]", "[1]"]), (10**8, ["[1]", "[1, 2]"])):
        process = _start([sys.executable, "-c", SMALL_FILES + textwrap.dedent(script), str(limit), str(tmp_path)])
        lines = process.communicate(timeout=100)[0].splitlines()
        assert [lines[0], lines[-1]] == expected
        assert sorted(path.name for path in tmp_path.iterdir()) == list(expected[1].strip("[]").split(", "))
        refused = [f"{tmp_path / '2'} could not be written: File too large"] if limit < 10**8 else []
        assert [line.partition(". ")[0] for line in lines[1:-1]] == refused


def test_what_a_killed_run_left_of_a_checkpoint_is_removed_by_the_next_run_alone(tmp_path: Path) -> None:
    from tagjax.training.checkpoint import Checkpoints

    unfinished = tmp_path / "4.orbax-checkpoint-tmp"
    unfinished.mkdir()
    with Checkpoints(tmp_path, create=False):  # an evaluation of a run that is writing a checkpoint
        assert unfinished.exists()
    with Checkpoints(tmp_path):
        assert not unfinished.exists()


def test_a_suite_whose_description_could_not_be_written_is_simulated_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("mujoco")
    from test_suites import _tiny

    from tagjax.sim import suites

    def full(path: Path, content: str) -> None:
        raise WriteError(path, errno.ENOSPC)

    with monkeypatch.context() as patch:
        patch.setattr(suites, "write_atomic", full)
        with pytest.raises(WriteError, match=r"tiny/suite\.json could not be written: No space left"):
            suites.make_suite(_tiny(), tmp_path)
    assert [item.name for item in suites.prepare(_tiny(), tmp_path)] == [item.name for item in _tiny().items()]
    assert (tmp_path / "tiny" / "suite.json").is_file()


@pytest.mark.ci
def test_a_full_disk_is_reported_in_one_line_and_the_folder_is_usable_afterwards(tmp_path: Path) -> None:
    """On a file system that is really full; only root can make one."""
    disk, video = tmp_path / "disk", _tum_folder(tmp_path / "freiburg3_test")
    disk.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=48k", "tmpfs", str(disk)], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip("a small file system cannot be mounted here")
    try:
        command = [sys.executable, "-m", "experiments.import_recording", f"video={video}"]
        command += [f"out={disk / 'a.zarr'}", f"hydra.run.dir={tmp_path / 'run'}"]
        (disk / "large").write_bytes(bytes(30_000))
        process = _start(command, **NO_WARNINGS)
        error = process.communicate(timeout=100)[1]
        assert process.returncode == 1
        expected = f"import_recording: {disk / 'a.zarr'} could not be written: No space left on device. "
        assert error.strip().startswith(expected)
        assert len(error.strip().splitlines()) == 1
        assert [path.name for path in disk.iterdir()] == ["large"]
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        _finish(command)
        assert (disk / "a.zarr").is_dir()
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        process = _start([*command[:-2], f"out={disk / 'b.zarr'}", command[-1]], **NO_WARNINGS)
        error = process.communicate(timeout=100)[1]
        assert error.strip().startswith(
            f"import_recording: {disk / 'b.zarr'} could not be written: Read-only file system. "
        )
        assert len(error.strip().splitlines()) == 1
    finally:
        subprocess.run(["umount", str(disk)], check=True)


def test_the_flow_of_a_recording_on_a_read_only_disk_is_computed_without_storing_it(
    scene: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tagjax.recording.store import open_recording

    shutil.copytree(scene, tmp_path / "scene.zarr", ignore=shutil.ignore_patterns("cache"))
    recording = open_recording(tmp_path / "scene.zarr")

    def refused(number: int) -> Callable[..., None]:
        def raises(target: Path, *_: Any, **__: Any) -> None:
            raise WriteError(target, number)

        return raises

    monkeypatch.setattr(cache, "compute_once", refused(errno.ENOSPC))
    with pytest.raises(WriteError, match="No space left"):
        cache.pair_flow(recording, 2, 5, "dis_ultrafast")
    monkeypatch.setattr(cache, "compute_once", refused(errno.EROFS))
    found = cache.pair_flow(recording, 2, 5, "dis_ultrafast")
    monkeypatch.undo()
    stored = cache.pair_flow(recording, 2, 5, "dis_ultrafast")
    for one, other in zip(found, stored, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)  # float16 on the disk


def test_what_a_killed_process_left_of_a_file_is_removed_by_the_next_one(tmp_path: Path) -> None:
    script = """
        import os, signal, sys
        from tagjax.core.files import atomic_path
        with atomic_path(sys.argv[1]) as partial:
            partial.write_text("half")
            os.kill(os.getpid(), signal.SIGKILL)
    """
    path = tmp_path / "a.json"
    process = _start([sys.executable, "-c", textwrap.dedent(script), str(path)])
    process.communicate(timeout=60)
    assert process.returncode == -signal.SIGKILL
    assert len(list(tmp_path.glob(".a.json.*.partial"))) == 1
    with atomic_path(path) as mine:  # this process runs: what it writes is left alone
        mine.write_text("mine")
        write_atomic(path, "whole")
        assert list(tmp_path.glob(".a.json.*.partial")) == [mine]
        mine.unlink()
        mine.write_text("mine")
    assert [(one.name, one.read_text()) for one in tmp_path.iterdir()] == [("a.json", "mine")]


HOLDER = """
import sys, time
from pathlib import Path
from tagjax.core.folder_lock import locked_folder

with locked_folder(Path(sys.argv[1])):
    print("locked", flush=True)
    time.sleep(300)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """A process that holds the lock of the folder `run`."""
    process = _start([sys.executable, "-c", HOLDER, str(tmp_path / "run")])
    assert process.stdout is not None
    assert process.stdout.readline() == "locked\n"
    yield process
    process.kill()
    process.communicate()


def test_a_folder_in_use_is_refused_with_the_process_until_that_is_killed(
    holder: subprocess.Popen[str], tmp_path: Path
) -> None:
    expected = f"run is in use: process {holder.pid} on {re.escape(socket.gethostname())} writes to it"
    with pytest.raises(FolderLockedError, match=expected), locked_folder(tmp_path / "run"):
        pass
    with pytest.raises(FolderLockedError, match=expected), locked_folder(tmp_path / "run"):  # asking changed nothing
        pass
    holder.kill()
    holder.wait()
    with locked_folder(tmp_path / "run"), pytest.raises(FolderLockedError, match=f"process {os.getpid()} on"):  # noqa: SIM117
        with locked_folder(tmp_path / "run"):
            pass
    with locked_folder(tmp_path / "run"):
        pass


@pytest.mark.ci
@pytest.mark.parametrize("command", ["train", "train_flow", "evaluate", "sweep_paper", "simulate"])
def test_a_second_run_in_a_folder_ends_in_one_line_and_changes_nothing(
    command: str, holder: subprocess.Popen[str], scene: str, tmp_path: Path
) -> None:
    config = tmp_path / "run" / "config.yaml"
    config.write_text("of: the first run\n")
    more = [f"data.recordings=[{scene}]"] if command == "train" else []
    process = _start([sys.executable, "-m", f"experiments.{command}", f"hydra.run.dir={tmp_path / 'run'}", *more])
    error = process.communicate(timeout=200)[1]
    assert process.returncode == 1
    assert error.startswith(f"{command}: {tmp_path / 'run'} is in use: process {holder.pid} on ")
    assert len(error.strip().splitlines()) == 1
    assert config.read_text() == "of: the first run\n"
    assert not (tmp_path / "run" / ".hydra").exists()
    assert not (tmp_path / "run" / "checkpoints").exists()


@pytest.mark.ci
def test_commands_that_are_killed_and_started_again_end_with_the_same_result(tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from tagjax.benchmarks.faults.kills import trial

    outcomes = trial(1, 0, tmp_path)
    assert [one.tried for one in outcomes] == [1, 1, 1, 1]
    assert [one.examples for one in outcomes] == [()] * 4


def test_a_half_written_file_that_is_visible_is_found(tmp_path: Path) -> None:
    from tagjax.benchmarks.faults.kills import differences
    from tagjax.benchmarks.faults.run_contents import recording_contents

    picture = np.random.default_rng(0).integers(0, 256, (8, 8, 3), dtype=np.uint8)
    write_image(tmp_path / "a" / "one.png", picture)
    write_image(tmp_path / "a" / "two.png", picture)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    (tmp_path / "b" / ".two.png.host-1-0.partial").touch()
    whole = recording_contents(tmp_path / "a")
    assert differences(recording_contents(tmp_path / "b"), whole, complete=True) is None
    (tmp_path / "b" / "two.png").unlink()
    assert differences(recording_contents(tmp_path / "b"), whole, complete=False) is None
    assert differences(recording_contents(tmp_path / "b"), whole, complete=True) == "two.png is missing"
    (tmp_path / "b" / "two.png").write_bytes((tmp_path / "a" / "two.png").read_bytes()[:-1])
    assert differences(recording_contents(tmp_path / "b"), whole, complete=False) == "two.png differs"


def test_only_partial_files_of_this_machine_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Two machines whose names begin alike, or containers with one name, write to the same folder."""
    ended = subprocess.run([sys.executable, "-c", "import os; print(os.getpid())"], capture_output=True, text=True)

    def left_by(name: str) -> Path:
        monkeypatch.setattr(socket, "gethostname", lambda: name)
        files._machine.cache_clear()
        with atomic_path(tmp_path / "a.json") as partial:
            partial.touch()
            found = partial.with_name(partial.name.replace(f"-{os.getpid()}-", f"-{ended.stdout.strip()}-"))
        found.touch()
        return found

    try:
        other, mine = left_by("gpu-cluster-node-01"), left_by("gpu-cluster-node-02")
        assert (other.exists(), mine.exists()) == (True, True)
        write_atomic(tmp_path / "a.json", "b")
        assert (other.exists(), mine.exists()) == (True, False)
    finally:
        monkeypatch.undo()
        files._machine.cache_clear()


def test_partial_files_of_another_container_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    digests = set()
    for namespace in ("pid:[1]", "pid:[2]"):
        monkeypatch.setattr(files.os, "readlink", lambda path, namespace=namespace: namespace)
        files._machine.cache_clear()
        digests.add(files._machine())
    files._machine.cache_clear()
    assert len(digests) == 2


@pytest.mark.parametrize("process", ["9" * 30, "\u00b2", "x", ""])
def test_a_partial_file_with_an_odd_process_number_is_kept(process: str, tmp_path: Path) -> None:
    with atomic_path(tmp_path / "a.json") as partial:
        partial.touch()
        odd = partial.with_name(partial.name.replace(f"-{os.getpid()}-", f"-{process}-"))
        odd.touch()
    write_atomic(tmp_path / "a.json", "b")
    assert odd.exists()


@pytest.mark.parametrize(
    "name", ["x" * 255, "\u00e9" * 127, "x" + "\u4e2d" * 84], ids=["x", "two_bytes", "three_bytes"]
)
def test_the_longest_name_of_a_file_can_be_written(name: str, tmp_path: Path) -> None:
    write_atomic(tmp_path / name, "a")
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_name_that_is_too_long_is_refused_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(WriteError, match=r"File name too long\. Choose a shorter name"):
        write_atomic(tmp_path / ("x" * 256), "a")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", ["[]", '"x"', "5", "null", "[" * 100_000, '{"a": 1, "a": 1}', "", "\xff"])
def test_a_damaged_list_of_a_suite_is_refused_in_one_line(content: str, tmp_path: Path) -> None:
    pytest.importorskip("mujoco")
    from test_suites import _tiny

    from tagjax.recording import RecordingError
    from tagjax.sim import suites

    (tmp_path / "tiny").mkdir()
    (tmp_path / "tiny" / "suite.json").write_bytes(content.encode("latin-1"))
    with pytest.raises(RecordingError, match=r"tiny has no readable suite\.json; expected") as refusal:
        suites.prepare(_tiny(), tmp_path)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("link", ["cache", "cache/flow"])
def test_flow_is_not_stored_where_a_link_leads_out_of_the_recording(link: str, scene: str, tmp_path: Path) -> None:
    from tagjax.recording.store import open_recording

    shutil.copytree(scene, tmp_path / "scene.zarr", ignore=shutil.ignore_patterns("cache"))
    elsewhere = tmp_path / "elsewhere"
    for folder in ("", "flow"):  # partial caches as old as those that are removed
        (elsewhere / folder / ".old.partial").mkdir(parents=True)
        os.utime(elsewhere / folder / ".old.partial", (0, 0))
    before = sorted(elsewhere.rglob("*"))
    (tmp_path / "scene.zarr" / link).parent.mkdir(exist_ok=True)
    (tmp_path / "scene.zarr" / link).symlink_to(elsewhere)
    found = cache.pair_flow(open_recording(tmp_path / "scene.zarr"), 2, 5, "dis_ultrafast")
    assert sorted(elsewhere.rglob("*")) == before
    stored = cache.pair_flow(open_recording(scene), 2, 5, "dis_ultrafast")
    for one, other in zip(found, stored, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)  # float16 on the disk


def test_flow_is_stored_in_a_recording_that_a_link_leads_to(scene: str, tmp_path: Path) -> None:
    from tagjax.recording.store import open_recording

    shutil.copytree(scene, tmp_path / "scene.zarr", ignore=shutil.ignore_patterns("cache"))
    (tmp_path / "link.zarr").symlink_to(tmp_path / "scene.zarr")
    cache.pair_flow(open_recording(tmp_path / "link.zarr"), 2, 5, "dis_ultrafast")
    assert list((tmp_path / "scene.zarr" / "cache" / "flow").iterdir())


@pytest.mark.ci
def test_an_error_of_a_sweep_s_job_that_the_user_can_correct_is_one_line(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "experiments.evaluate", "-m", f"run={tmp_path / 'none'}"]
    process = _start([*command, f"hydra.sweep.dir={tmp_path / 'sweep'}"])
    output, error = process.communicate(timeout=100)
    assert process.returncode == 1
    assert "Traceback" not in output + error
    assert error.strip().splitlines()[-1].startswith("evaluate: ")
    assert len(error.strip().splitlines()) == 2  # Hydra's line before it names the job's settings


@pytest.mark.parametrize("value", [None, "", "0", "1"])
def test_programs_that_a_command_starts_inherit_the_user_s_environment(value: str | None) -> None:
    script = """
        import os
        from experiments.errors import ending_in_one_line, errors_in_one_line
        with ending_in_one_line("x"):
            with errors_in_one_line("x"):
                print(os.environ.get("HYDRA_FULL_ERROR"))
            print(os.environ.get("HYDRA_FULL_ERROR"))
        print(os.environ.get("HYDRA_FULL_ERROR"))
    """
    process = _start(
        [sys.executable, "-c", textwrap.dedent(script)], **({} if value is None else {"HYDRA_FULL_ERROR": value})
    )
    assert process.communicate(timeout=60)[0].splitlines() == [str(value), "1", str(value)]


def test_training_in_a_shell_s_background_does_not_end_with_ctrl_c() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with loop._stop_on_signals() as received:
            os.kill(os.getpid(), signal.SIGINT)
            assert received() == 0
            os.kill(os.getpid(), signal.SIGTERM)
            assert received() == signal.SIGTERM
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_folder_without_locks_gives_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_locks(*_: Any, **__: Any) -> None:
        raise NotImplementedError("FileSystem does not appear to support flock")

    monkeypatch.setattr("filelock.FileLock.acquire", no_locks)
    with pytest.warns(RuntimeWarning, match="run: its file system has no locks"), locked_folder(tmp_path / "run"):
        (tmp_path / "run" / "a").touch()
    assert [path.name for path in (tmp_path / "run").iterdir() if path.name != ".lock"] == ["a"]
