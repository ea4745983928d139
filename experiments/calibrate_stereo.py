"""Calibrate two cameras side by side from pictures of a checkerboard that both took at the same times.

python -m experiments.calibrate_stereo left=<folder> right=<folder> board.columns=7 board.rows=5 board.square_m=0.041
python -m experiments.calibrate_stereo left=<folder> right=<folder> out=stereo.json num_radial=3

Ten pairs or more, the board tilted in different ways, near and far, up to the pictures' edges. experiments.stereo uses the file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.stereo.calibration import CalibrateStereoSettings, calibrate_stereo_folders

    for side in ("left", "right"):
        if values[side] is None:
            raise ValueError(f"found no {side}; expected {side}=<folder of pictures of the checkerboard>.")
    progress, console = values.pop("progress"), Console(soft_wrap=True, highlight=False, markup=False)
    settings = checked(CalibrateStereoSettings, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        _, lines = calibrate_stereo_folders(settings, on_progress=report)
    for line in (*lines, f"written to {settings.out}"):
        console.print(line, markup=False)


if __name__ == "__main__":
    main()
