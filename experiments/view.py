"""Trace a recording and write a file for the Rerun viewer, or show it there live. The last line is the file's path.

python -m experiments.view recording=recordings/mine.zarr                      # mine.rrd, then: rerun <run folder>/mine.rrd
python -m experiments.view recording=recordings/mine.zarr live=true            # the viewer opens, depth as points in space
python -m experiments.view recording=recordings/mine.zarr smooth=true depth=true

Needs rerun-sdk: pip install -c constraints.txt -e ".[viewer]"
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.evaluation.view import ViewConfig, view_recording

    from .progress import counting_bar

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(ViewConfig, values, folder)
    with counting_bar(console, shown=progress) as bar:
        task = bar.add_task("trace", total=None)
        out = view_recording(config, folder, on_frame=lambda done, total: bar.update(task, completed=done, total=total))
    if out is not None:
        console.print(f"open it: rerun {out}", soft_wrap=True, highlight=False)
        print(out)


if __name__ == "__main__":
    main()
