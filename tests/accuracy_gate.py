"""Two small simulated recordings, traced end to end by the command lines that users run, and the scores recorded for them.

python tests/accuracy_gate.py --record                        # simulate, trace, and write the scores of this code
python tests/accuracy_gate.py --record "hand-held object"     # of that one only

Programs are started anew with XLA's normal optimisations, which the tests' own process switches off.
"""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
RECORDED = Path(__file__).with_suffix(".json")
SCORES = ("iou", "identification")
MARGIN = 0.03
"""By how much a score may fall below its recorded value: more than compilers and machines differ by."""


@dataclasses.dataclass(frozen=True)
class Case:
    """One recording of a suite and the tracer that it is traced with."""

    suite: str
    changes: tuple[str, ...]  # of the suite: one short recording
    tracing: tuple[str, ...]


CASES = {
    "walking people": Case("walkers", ("duration_s=8.0",), ("tracer=tagattention",)),
    "hand-held object": Case(
        "single_static",
        ("duration_s=3.5", "variants=[{name: box, settings: {kinds: [box]}}]"),
        ("tracer=tagattention",),
    ),
}


def _environment() -> dict[str, str]:
    """This process's environment without what the tests tell XLA to leave out."""
    ours = ("XLA_FLAGS", "JAX_DISABLE_MOST_OPTIMIZATIONS")
    return {name: value for name, value in os.environ.items() if name not in ours} | {"JAX_PLATFORMS": "cpu"}


def _run(module: str, *arguments: str) -> str:
    command = [sys.executable, "-m", f"experiments.{module}", *arguments, "progress=false"]
    done = subprocess.run(command, cwd=ROOT, env=_environment(), capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(
            f"{' '.join(command)} ended with {done.returncode}:\n{done.stdout[-2000:]}{done.stderr[-4000:]}"
        )
    return done.stdout


def scores(case: Case, folder: Path) -> dict[str, float]:
    """Simulate the recording into a folder, trace it, and give its scores over all tags."""
    counts = [f"suite.counts.{split}={number}" for split, number in (("train", 0), ("validation", 0), ("test", 1))]
    changes = [f"++suite.{change}" for change in case.changes]
    simulated = (f"suite={case.suite}", *counts, *changes, f"recordings_dir={folder}", "workers=1")
    _run("simulate", *simulated, f"hydra.run.dir={folder / 'simulate'}")
    (recording,) = sorted((folder / case.suite / "test").glob("*.zarr"))
    printed = _run("evaluate", *case.tracing, f"recordings=[{recording}]", f"hydra.run.dir={folder / 'evaluate'}")
    (found,) = json.loads(printed.strip().splitlines()[-1]).values()
    return {name: round(float(found["all"][name]), 4) for name in SCORES} | {"frames": found["all"]["num_frames"]}


def main() -> None:
    """Write the scores of this code, of the named cases or of all, to `accuracy_gate.json`."""
    names = sys.argv[2:] or list(CASES)
    if sys.argv[1:2] != ["--record"] or not set(names) <= set(CASES):
        raise SystemExit(__doc__)
    recorded = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    for name in names:
        with tempfile.TemporaryDirectory() as folder:
            recorded[name] = scores(CASES[name], Path(folder))
        print(name, recorded[name], flush=True)
        RECORDED.write_text(json.dumps(recorded, indent=1) + "\n")


if __name__ == "__main__":
    main()
