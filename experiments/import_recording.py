"""Import an RGB-D video, a table of tag reads, or both, as one recording.

python -m experiments.import_recording reads=table.csv                          # only report what a table holds
python -m experiments.import_recording video=take1.mp4 reads=table.csv out=recordings/a.zarr     # depth/ and camera.json beside it
python -m experiments.import_recording video=<folder of colour/, depth/, camera.json> out=recordings/a.zarr
python -m experiments.import_recording video=take1.bag reads=table.csv out=recordings/a.zarr      # or .mcap, .db3, .mkv
python -m experiments.import_recording video=<TUM folder> reads=table.csv out=recordings/a.zarr
python -m experiments.import_recording video=<jpg+mat folder> calibration=cam.mat fps=7 tracks=tracks.csv out=b.zarr
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.recording.importers.settings import ImportSettings, import_recording

    console = Console(soft_wrap=True, highlight=False, markup=False)
    _, lines = import_recording(checked(ImportSettings, values, folder))
    for line in lines:
        console.print(line, markup=False)


if __name__ == "__main__":
    main()
