"""All systems on the same suites, in one table; the last line is the result as JSON.

python -m experiments.compare 'suites=[planar_tracks,ceiling_2]' max_recordings=2
python -m experiments.compare 'suites=[single_static]' 'only=[tagattention,tagattention_published]'
python -m experiments.compare 'suites=[shop_exit]' systems.goller_calibration=<calibration.json of experiments.goller>
python -m experiments.compare 'suites=[shop_exit]' systems.goller_grid=<recording of shop_grid>  # with unfitted widths
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from .command import command, print_result, write_config
from .suites import suites_named


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.compare import CompareConfig, console_table, run_comparison

    progress, console = values.pop("progress"), Console(markup=False)
    config = from_mapping(CompareConfig, {**values, "suites": suites_named(values["suites"])})
    write_config(values, folder)
    with progress_lines(shown=progress, console=console) as report:
        cells = run_comparison(config, folder, on_progress=report)
    console.print(console_table(cells))
    console.print(f"table.md, table.csv, table.json and comparison.png in {folder}", soft_wrap=True, highlight=False)
    print_result([dataclasses.asdict(cell) for cell in cells])


if __name__ == "__main__":
    main()
