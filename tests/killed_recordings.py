"""What a killed recording loses: python tests/killed_recordings.py <recording.zarr> [<number of recordings>]

`experiments.record` plays the recording with an emulated reader. It is killed 0.5 to 2.5 s after its 20th frame (SIGKILL). Printed is how
long before that the last frame and the last read came that the folder shows.
"""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import zarr

from tagjax.recording.store import open_recording

ROOT = Path(__file__).parents[1]


def lost_s(played: str, folder: Path, wait_s: float) -> tuple[float, float]:
    """Seconds of frames and of reads that one killed recording lost."""
    out = folder / "a.zarr"
    words = [f"recording={played}", "reader=llrp", "emulate=true", f"out={out}", f"hydra.run.dir={folder / 'run'}"]
    child = subprocess.Popen(
        [sys.executable, "-m", "experiments.record", *words, "progress=false"], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    while not (out / "colour" / "c" / "20").exists():
        assert child.poll() is None
        time.sleep(0.01)
    time.sleep(wait_s)
    child.kill()
    killed_ns = time.time_ns()
    child.wait()
    found = open_recording(out)
    frame_ns = np.asarray(zarr.open_group(out, mode="r")["capture/frame_arrival_time_ns"])[: found.num_frames]
    assert found.reads.arrival_time_ns is not None
    return (killed_ns - frame_ns.max()) * 1e-9, (killed_ns - found.reads.arrival_time_ns.max()) * 1e-9


def main() -> None:
    played, number = sys.argv[1], int(sys.argv[2]) if len(sys.argv) > 2 else 15
    chosen, every = random.Random(0), []
    for _ in range(number):
        with tempfile.TemporaryDirectory() as folder:
            every.append(lost_s(played, Path(folder), chosen.uniform(0.5, 2.5)))
        print("frames of the last {:.2f} s, reads of the last {:.2f} s".format(*every[-1]), flush=True)
    print(f"at most {np.max(every):.2f} s, median {np.median(every):.2f} s")


if __name__ == "__main__":
    main()
