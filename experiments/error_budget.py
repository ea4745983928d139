"""Error budget: scores with truth in place of flow, radio, segments or cut; the last line is the result as JSON.

python -m experiments.error_budget 'suites=[single_static]'
python -m experiments.error_budget 'suites=[walkers]' tracer@tracers.learnable=tagattention   # walking people
python -m experiments.error_budget 'suites=[single_static,multi_4]' split=train max_recordings=1 'swaps=[flow,cut]'
python -m experiments.error_budget 'suites=[multi_4]' tracers.published=null                  # the learnable tracer only

Each swap is tried alone, and all together. docs/ceilings.md explains them.
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
    from tagjax.evaluation.error_budget import BudgetConfig, console_table, run_budget

    progress, console = values.pop("progress"), Console(markup=False)
    config = from_mapping(BudgetConfig, {**values, "suites": suites_named(values["suites"])})
    write_config(values, folder)
    with progress_lines(shown=progress, console=console) as report:
        rows = run_budget(config, folder, on_progress=report)
    console.print(console_table(rows))
    console.print(f"table.md, table.csv, result.json and error_budget.png in {folder}", soft_wrap=True, highlight=False)
    print_result([dataclasses.asdict(row) for row in rows])


if __name__ == "__main__":
    main()
