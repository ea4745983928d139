"""Check what limits a recording: one page about its reads, clock and camera, with what to change. The last line is the page's path.

python -m experiments.check recording=recordings/mine.zarr                     # text here, and check.html
python -m experiments.check recording=recordings/mine.zarr out=check.html 'epcs=[E28011000000000000000001]'
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.check import CheckConfig, check_recording
    from tagjax.report.check_page import check_text

    progress, console = values.pop("progress"), Console(soft_wrap=True, highlight=False, markup=False)
    config = checked(CheckConfig, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        limits, page = check_recording(config, folder, on_frame=lambda done, total: report("frames", done, total))
    console.print(check_text(limits))
    print(page)


if __name__ == "__main__":
    main()
