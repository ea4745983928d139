"""Draw the papers' figures from suites, the published tracer beside the learnable one; each with its numbers as CSV.

python -m experiments.paper figure=10                                  # TagAttention's Fig. 10; missing recordings are simulated
python -m experiments.paper 'figure=[2,3,4]' max_recordings=1
python -m experiments.paper figure=tagview_8                           # a figure of Tagview; tagvision_5 is one of TagVision
python -m experiments.paper figure=all                                 # all whose recordings are there; simulate=true: all
python -m experiments.paper figure=all simulate=true 'splits=[train,validation]' width=256 paths.recordings_dir=recordings/small

Traces are kept in the run folder, so that a command that was stopped goes on where it was.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from .command import print_result, resumable_command, write_config
from .suites import suites_named


@resumable_command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.paper import PaperConfig, run_paper, suites

    progress, console = values.pop("progress"), Console(markup=False)
    config = from_mapping(PaperConfig, {**values, "suites": suites_named(suites())})
    write_config(values, folder)
    with progress_lines(shown=progress, console=console) as report:
        drawn = run_paper(config, folder, on_progress=report)
    for one in drawn:
        console.print(f"{one.title}: {one.picture or one.seen}", soft_wrap=True, highlight=False)
    console.print(f"figures.md, figures.json and the figures in {folder}", soft_wrap=True, highlight=False)
    print_result([dataclasses.asdict(one) for one in drawn])


if __name__ == "__main__":
    main()
