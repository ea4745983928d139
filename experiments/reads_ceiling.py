"""The identification that no tracer can exceed by reads alone; the last line is the result as JSON.

python -m experiments.reads_ceiling 'suites=[multi_4]'
python -m experiments.reads_ceiling 'suites=[multi_2,multi_4]' split=train max_recordings=2 'memories_s=[null,2.5,1]'
python -m experiments.reads_ceiling 'suites=[multi_4]' evidence.hop_spread_rad=0.3
python -m experiments.reads_ceiling 'suites=[walkers]' num_antennas=4 'antennas=[1,3]' recordings_dir=recordings/antennas_4

The candidates of a tag are the true distances of all tags of its recording; the one with the highest likelihood of the
tag's reads wins (docs/ceilings.md). Recordings of one tag are refused: nothing competes there.
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
    from tagjax.evaluation.reads_ceiling import CeilingConfig, console_table, run_ceiling

    progress, console = values.pop("progress"), Console(markup=False)
    config = from_mapping(CeilingConfig, {**values, "suites": suites_named(values["suites"])})
    write_config(values, folder)
    with progress_lines(shown=progress, console=console) as report:
        rows, _ = run_ceiling(config, folder, on_progress=report)
    console.print(console_table(rows))
    console.print(f"table.md, table.csv, result.json and ceiling.png in {folder}", soft_wrap=True, highlight=False)
    print_result([dataclasses.asdict(row) for row in rows])


if __name__ == "__main__":
    main()
