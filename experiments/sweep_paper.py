"""TagAttention's Fig. 17, and any other grid of a tracer's parameters over suites.

python -m experiments.sweep_paper                                      # v0 0.01, 0.1, 0.5 m/s, slow and fast
python -m experiments.sweep_paper width=256 clips.stride=2 max_recordings=2 paths.recordings_dir=recordings/small hydra.run.dir=outputs/sweep_small   # a small version
python -m experiments.sweep_paper 'suites=[single_static,single_dynamic]' 'splits=[train,validation]' \\
    '+grid={alpha_m2:[1e-4,5e-4,5e-3],beta:[0.2,0.8],v0_m_s:[0.05,0.1,0.2]}' hydra.run.dir=outputs/grid

A killed sweep resumes when it is started again.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import print_result, resumable_command, write_config
from .suites import suites_named


@resumable_command
def main(values: dict[str, Any], folder: Path) -> float:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.sweep import SweepConfig, run_sweep, table

    progress, console = values.pop("progress"), Console(markup=False)
    config = from_mapping(SweepConfig, {**values, "suites": suites_named(values["suites"])})
    with progress_lines(shown=progress, console=console) as report:
        write_config(values, folder)
        rows = table(run_sweep(config, folder, on_progress=report))
    console.print((folder / "table.md").read_text(), soft_wrap=True, highlight=False)
    console.print(f"table.md, table.csv, sweep.png, lines.jsonl in {folder}", soft_wrap=True, highlight=False)
    print_result(rows)
    return float(rows[0]["IoU"])


if __name__ == "__main__":
    main()
