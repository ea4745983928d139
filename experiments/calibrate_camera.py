"""Calibrate a camera from pictures of a checkerboard, and find its pose over the plane on which the board lies.

python -m experiments.calibrate_camera pictures=<folder> board.columns=7 board.rows=5 board.square_m=0.041
python -m experiments.calibrate_camera pictures=<folder> 'poses=[{picture: table.png}]' out=camera.json
python -m experiments.calibrate_camera pictures=<folder> \
    'poses=[{picture: a.png}, {picture: b.png, origin_m: [0.8, 0.0], turn_deg: 90.0}]'
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="calibrate_camera")
def main(config: DictConfig) -> None:
    from rich.console import Console

    from tagjax.baselines.tagvision.picture_folder import (
        CalibrateSettings,
        calibrate_folder,
        write_calibration,
        write_corners,
    )
    from tagjax.config import from_mapping

    values = resolved(config)
    if values["pictures"] is None:
        raise SystemExit("calibrate_camera: give pictures=<folder of pictures of the checkerboard>.")
    console = Console(soft_wrap=True, highlight=False)
    with in_a_line("calibrate_camera"):
        settings = from_mapping(CalibrateSettings, values)
        found = calibrate_folder(settings)
        write_calibration(found, settings.out)
        drawn = write_corners(found, settings.out)
    hint = (
        f"a board looks the same from either end: {drawn} shows the first corner and the axes. If you meant the other end, "
        "give that corner's position as origin_m and add 180 to turn_deg."
    )
    for line in (*found.summary(), *([hint] if settings.poses else []), f"written to {settings.out} and {drawn}"):
        console.print(line, markup=False)


if __name__ == "__main__":
    answer_help(__doc__, "calibrate_camera")
    main()
