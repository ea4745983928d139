"""Find an antenna's offset from the camera, from a recording in which one tag is moved about. The last line is the result as JSON.

python -m experiments.calibrate_antenna recording=recordings/moved.zarr epc=E28011000000000000000001
python -m experiments.calibrate_antenna recording=recordings/moved.zarr epc=E28011000000000000000001 path=traced antenna=2

Move the tag for 20 s through half a metre and more along all three axes, in view, near the antenna, nothing in between.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.antenna_position import AntennaConfig, calibrate_antenna

    progress, console = values.pop("progress"), Console(soft_wrap=True, highlight=False, markup=False)
    config = checked(AntennaConfig, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        found = calibrate_antenna(config, on_progress=report)
    console.print("\n".join(found.lines()))
    print_result(dataclasses.asdict(found))


if __name__ == "__main__":
    main()
