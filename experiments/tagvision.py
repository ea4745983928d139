"""TagVision's experiments: parallel lines, calibration, objects that move over a table; the last line is JSON.

python -m experiments.tagvision                                # lines and calibration, a minute
python -m experiments.tagvision suite=planar_tracks            # and the suite, simulated first where missing
python -m experiments.tagvision suite=planar_tracks split=validation paths.recordings_dir=<folder of experiments.simulate>
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.markdown import Markdown

    from tagjax.baselines.tagvision.experiment import TagVisionExperiment, report_markdown, run_tagvision
    from tagjax.core.progress import progress_lines

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(TagVisionExperiment, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        metrics = run_tagvision(config, folder, on_progress=report)
    console.print(Markdown(report_markdown(metrics)))
    console.print(f"plots, table.md and metrics.json in {folder}", soft_wrap=True, highlight=False)
    print_result(metrics)


if __name__ == "__main__":
    main()
