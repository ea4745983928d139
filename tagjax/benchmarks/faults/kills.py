"""Commands that are killed at random moments (SIGKILL) and started again: the result is that of an undisturbed run.

Of a training run every checkpoint is compared bit by bit, of a simulation and an import every file of the recordings. What is
visible right after the kill is compared as well: no file may be half written.
"""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import cv2
import numpy as np

from ...recording.image_files import write_image
from ...recording.importers.rgbd_folder import TUM_SHAPE
from .outcome import Outcome
from .run_contents import DAMAGED, recording_contents, run_contents

_SETTINGS = {
    "train": (
        # The smallest to compile that learns.
        *("experiment=clips", "tracer=tagattention_literal", "tracer.cell=4", "tracer.softness=0.3", "~baselines"),
        *("data.clips.stride=2", "data.clips.length=6", "data.clips.estimator=literal", "data.clips.min_motion=0"),
        *("objective.span_frames=4", "objective.skip_frames=2", "objective.max_reads=64", "objective.num_channels=4"),
        *("loop.num_steps=24", "loop.batch_size=2", "loop.checkpoint_every=4", "loop.progress=false"),
        "logger=disabled",
    ),
    "train_flow": (
        *("flow.widths=[4,4]", "flow.radii=[1,1]", "flow.iterations=[1,1]", "flow.decoder_widths=[[4],[4]]"),
        *("data.drawn.num_pairs=32", "data.drawn.num_validation=16", "data.drawn.photographs=false"),
        *("data.drawn.pairs.height=48", "data.drawn.pairs.width=48"),
        *("data.variation.height=32", "data.variation.width=32", "data.variation.scale=[1.0,1.2]"),
        *("loss.data=photometric", "loss.occlusion=false", "loss.level_weights=[1.0,0.5]"),
        *("loop.num_steps=40", "loop.batch_size=2", "loop.checkpoint_every=8", "loop.validate_every=100"),
        *("loop.log_every=1", "loop.progress=false", "logger=disabled"),
    ),
    "simulate": ("suite=multi_4", "smoke=true", "workers=2", "progress=false"),
    "import_recording": (),
}
_TIMEOUT_S = 600
_NUM_IMAGES = 16


@dataclasses.dataclass(frozen=True)
class Job:
    """A command that writes into a folder, and what is compared of that folder."""

    kind: str
    command: str  # of experiments
    arguments: Callable[[Path], tuple[str, ...]]  # of the command, for a folder
    contents: Callable[[Path], Mapping[str, str]]  # of the folder at the end: a digest for each name
    once: bool = False  # whether the command refuses to write a result that is complete

    def argv(self, folder: Path) -> list[str]:
        """The command line for a folder."""
        start = f"import tagjax.cli; tagjax.cli.{self.command}()"
        return [sys.executable, "-c", start, *_SETTINGS[self.command], *self.arguments(folder)]


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """Kill training, flow training, a simulation and an import, each at `number` random moments; `folder` is for scratch."""
    folder.mkdir(parents=True, exist_ok=True)
    return [
        _job_trial(job, number, np.random.default_rng([seed, place]), folder) for place, job in enumerate(jobs(folder))
    ]


def jobs(folder: Path) -> list[Job]:
    """The four commands; their inputs are written into `folder`."""
    material = folder / "material"
    recordings = material / "recordings"
    if not recordings.exists():
        simulate = Job(
            "", "simulate", lambda out: (f"paths.recordings_dir={out}", f"hydra.run.dir={out}/.run"), recording_contents
        )
        _finish(simulate, recordings, folder)
    scene = min((recordings / "multi_4" / "test").glob("*.zarr"))
    video = material / "freiburg1_made"
    if not video.exists():
        _write_tum(video)
    return [
        Job(
            "kill: training",
            "train",
            lambda out: (f"data.recordings=[{scene}]", f"hydra.run.dir={out}"),
            run_contents,
        ),
        Job(
            "kill: flow training",
            "train_flow",
            lambda out: (f"data.drawn.folder={out}/.pairs", f"hydra.run.dir={out}"),
            run_contents,
        ),
        Job(
            "kill: simulation",
            "simulate",
            lambda out: (f"paths.recordings_dir={out}", f"hydra.run.dir={out}/.run"),
            recording_contents,
        ),
        Job(
            "kill: import",
            "import_recording",
            lambda out: (f"video={video}", f"out={out}/video.zarr", f"hydra.run.dir={out}/.run"),
            recording_contents,
            once=True,
        ),
    ]


def _job_trial(job: Job, number: int, rng: np.random.Generator, folder: Path) -> Outcome:
    scratch = folder / job.command
    shutil.rmtree(scratch, ignore_errors=True)
    _finish(job, scratch / "first", folder)  # compiles what the others take from the cache
    begun = time.monotonic()
    _finish(job, scratch / "undisturbed", folder)
    elapsed_s = time.monotonic() - begun
    expected = job.contents(scratch / "undisturbed")
    if not expected or job.contents(scratch / "first") != expected:
        return Outcome(job.kind, number, number, ("two undisturbed runs differ",))
    failures = []
    for one in range(number):
        out = scratch / str(one)
        while not _killed(job, out, moment_s := float(rng.uniform(0.0, elapsed_s)), folder):
            shutil.rmtree(out)  # it ended before that moment: another one is drawn
        found = _wrong_after_kill(job, out, expected, folder)
        if found is not None:
            failures.append(f"{job.command} killed after {moment_s:.2f} s of {elapsed_s:.2f} s: {found}")
        else:
            shutil.rmtree(out, ignore_errors=True)
    return Outcome(job.kind, number, len(failures), tuple(failures[:5]))


def _killed(job: Job, out: Path, moment_s: float, folder: Path) -> bool:
    """Start the command and kill it after a time; False if it has ended before."""
    with subprocess.Popen(
        job.argv(out), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, **_place(folder)
    ) as process:
        try:
            process.wait(timeout=moment_s)
        except subprocess.TimeoutExpired:
            process.kill()
    return process.returncode == -signal.SIGKILL


def _wrong_after_kill(job: Job, out: Path, expected: Mapping[str, str], folder: Path) -> str | None:
    """What is wrong with what a killed command has left, and with the result of a second start; None if nothing is."""
    left = job.contents(out) if out.is_dir() else {}
    if damaged := differences(left, expected, complete=False):
        return f"visible after the kill: {damaged}"
    if not (job.once and left == expected):
        try:
            _finish(job, out, folder)
        except subprocess.CalledProcessError as error:
            return f"started again, it ended with {error.returncode}: {error.stderr.strip()[-300:]}"
        except subprocess.TimeoutExpired:
            return f"started again, it did not end within {_TIMEOUT_S} s"
    return differences(job.contents(out), expected, complete=True)


def differences(found: Mapping[str, str], expected: Mapping[str, str], *, complete: bool) -> str | None:
    """What is wrong with contents, None if nothing is; those that are not `complete` may also hold earlier checkpoints."""
    wrong = [name for name, digest in found.items() if expected.get(name) != digest]
    missing = [name for name in expected if name not in found]
    if not complete:
        wrong = [name for name in wrong if name in expected or found[name] == DAMAGED or "checkpoint" not in name]
        missing = []
    parts = [f"{name} differs" for name in wrong[:3]] + [f"{name} is missing" for name in missing[:3]]
    return "; ".join(parts) or None


def _finish(job: Job, out: Path, folder: Path) -> None:
    """Run the command to its end. Raises `subprocess.CalledProcessError` where it fails."""
    subprocess.run(job.argv(out), check=True, capture_output=True, text=True, timeout=_TIMEOUT_S, **_place(folder))


def _place(folder: Path) -> dict:
    """Where a command runs: beside the package, on the CPU, with one cache of compiled programs for all."""
    environment = {
        **os.environ,
        "JAX_PLATFORMS": "cpu",
        "JAX_COMPILATION_CACHE_DIR": str(folder / "compiled"),
        "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.1",
    }
    return {"cwd": Path(__file__).parents[3], "env": environment}


def _write_tum(folder: Path) -> None:
    """An RGB-D video in TUM's layout: a square that moves before a slanted wall."""
    rng = np.random.default_rng(0)
    height, width = TUM_SHAPE
    wall = np.broadcast_to(np.linspace(9000, 12000, width), TUM_SHAPE)
    texture = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    for kind in ("rgb", "depth"):
        (folder / kind).mkdir(parents=True)
    for number in range(_NUM_IMAGES):
        depth, colour, left = wall.astype(np.uint16), texture.copy(), 20 + 10 * number
        depth[100:300, left : left + 120] = 6000
        colour[100:300, left : left + 120] = (200, 60, 30)
        write_image(folder / "rgb" / f"{number:04d}.png", colour)
        cv2.imwrite(str(folder / "depth" / f"{number:04d}.png"), depth)
    for kind in ("rgb", "depth"):
        lines = [f"{1e9 + number / 30:.6f} {kind}/{number:04d}.png" for number in range(_NUM_IMAGES)]
        (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
