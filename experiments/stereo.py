"""Make a recording of two colour cameras: depth by semi-global matching in place of an RGB-D camera.

python -m experiments.stereo left=<video or folder> right=<video or folder> camera=stereo.json reads=reads.csv out=recordings/a.zarr
python -m experiments.stereo left=left.mp4 right=right.mp4 camera=stereo.json    # describe, check the pair, write nothing
python -m experiments.stereo recording=recordings/two.zarr out=recordings/two-stereo.zarr    # of a recording with a second camera

The pair is calibrated by experiments.calibrate_stereo.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.stereo.conversion import StereoSettings, stereo_recording

    progress, console = values.pop("progress"), Console(soft_wrap=True, highlight=False, markup=False)
    settings = checked(StereoSettings, values, folder)
    with progress_lines(shown=progress, console=console):
        _, lines = stereo_recording(settings, progress=progress)  # frames are counted where they are written
    for line in lines:
        console.print(line, markup=False)


if __name__ == "__main__":
    main()
