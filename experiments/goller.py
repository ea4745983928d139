"""Goller et al.: calibrate on a tag grid, run the scenarios, write both tables, metrics and plots to the run folder.

python -m experiments.simulate suite=shop_grid         # and shop_exit, shop_handover
python -m experiments.goller
python -m experiments.goller handover=<recording>      # instead of those of shop_handover beside the scenarios
python -m experiments.goller scenarios=<folder of the suite> max_recordings=3 fit_steps=0
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.baselines.goller.experiment import GollerExperiment, run_goller
    from tagjax.core.progress import progress_lines
    from tagjax.recording.store import open_recording

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(GollerExperiment, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        metrics = run_goller(config, folder, open_recording=open_recording, on_progress=report)
    console.print((folder / "tables.md").read_text(), markup=False)
    if metrics["handover"] is None:
        hint = "found no hand-over; `python -m experiments.simulate suite=shop_handover` makes recordings of some"
        console.print(hint, soft_wrap=True, highlight=False)
    console.print(f"run folder: {folder}")
    print_result(metrics)


if __name__ == "__main__":
    main()
