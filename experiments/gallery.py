"""A gallery of suites: of each one frame with the tracer's masks, boxes and names, for docs/benchmark.md.

python -m experiments.gallery                                    # every suite that has recordings, into the run folder
python -m experiments.gallery 'suites=[multi_4,walkers]' out=docs/gallery
python -m experiments.gallery weights=outputs/train/<time>/weights.json at_s=4
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.gallery import GalleryConfig, make_gallery

    progress, console = values.pop("progress"), Console(markup=False)
    values["out"] = values["out"] or str(folder)
    config = checked(GalleryConfig, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        for path in make_gallery(config, on_progress=report):
            console.print(f"{path}: {path.stat().st_size / 1e3:.0f} kB", soft_wrap=True, highlight=False)


if __name__ == "__main__":
    main()
