r"""Calibrate a camera from pictures of a checkerboard, and find its pose over the plane on which the board lies.

python -m experiments.calibrate_camera pictures=<folder> board.columns=7 board.rows=5 board.square_m=0.041
python -m experiments.calibrate_camera pictures=<folder> 'poses=[{picture: table.png}]' out=camera.json
python -m experiments.calibrate_camera pictures=<folder> \
    'poses=[{picture: a.png}, {picture: b.png, origin_m: [0.8, 0.0], turn_deg: 90.0}]'
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.baselines.tagvision.picture_folder import (
        CalibrateSettings,
        calibrate_folder,
        write_calibration,
        write_corners,
    )
    from tagjax.core.progress import progress_lines

    if values["pictures"] is None:
        raise ValueError("found no pictures; expected pictures=<folder of pictures of the checkerboard>.")
    progress, console = values.pop("progress"), Console(soft_wrap=True, highlight=False, markup=False)
    settings = checked(CalibrateSettings, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        calibration = calibrate_folder(settings, on_progress=report)
    write_calibration(calibration, settings.out)
    drawn = write_corners(calibration, settings.out)
    hint = (
        f"a board looks the same from either end: {drawn} shows the first corner and the axes. If you meant the other end, "
        "give that corner's position as origin_m and add 180 to turn_deg."
    )
    for line in (*calibration.summary(), *([hint] if settings.poses else []), f"written to {settings.out} and {drawn}"):
        console.print(line, markup=False)


if __name__ == "__main__":
    main()
