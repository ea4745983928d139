"""An animation of a traced recording: masks on the left; each tag's phase and change of distance growing on the right.

python -m experiments.picture recording=recordings/mine.zarr out=mine.webp
python -m experiments.picture recording=recordings/mine.zarr out=mine.gif 'shown=[30,90]' smooth=true

Needs matplotlib and Pillow: pip install -c constraints.txt -e ".[viz]"
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.picture import PictureConfig, make_picture

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(PictureConfig, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        path = make_picture(config, on_progress=report)
    console.print(f"{path}: {path.stat().st_size / 1e6:.1f} MB", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
