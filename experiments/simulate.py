"""Simulate a suite: the same name and seed give the same recordings; existing recordings are kept.

python -m experiments.simulate suite=multi_4
python -m experiments.simulate suite=corpus suite.counts.train=200 paths.recordings_dir=recordings/corpus workers=8
python -m experiments.simulate suite=crowd smoke=true paths.recordings_dir=recordings/smoke
python -m experiments.simulate -m 'suite=glob(*)' sheet=docs/benchmark   # the pictures of docs/benchmark.md
python -m experiments.simulate suite=multi_4 budget=train   # how strongly each tag is read, and why
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, resumable_command


@resumable_command
def main(values: dict[str, Any], folder: Path) -> None:
    import os

    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.core.settings import from_mapping
    from tagjax.sim.contact_sheet import save_preview, save_sheet
    from tagjax.sim.suites import SimulateConfig, Suite, make_suite

    if values.get("suite") is None:
        raise ValueError("found no suite; expected suite=<name>. `--help` lists the names.")
    config = checked(SimulateConfig, values, folder)
    suite = from_mapping(Suite, config.suite, where="suite")
    suite = suite.smoke() if config.smoke else suite
    recordings_dir, console = Path(config.recordings_dir), Console(markup=False)
    if config.sheet is not None:
        with progress_lines(shown=config.progress, console=console) as report:
            sheet = save_preview(suite, Path(config.sheet), workers=config.workers or 1, on_progress=report)
        console.print(f"{suite.name}: {sheet}")
        return
    if config.budget is not None:
        from tagjax.sim.link_budgets import budget_lines

        with progress_lines(shown=config.progress, console=console) as report:
            lines = budget_lines(suite, config.budget, on_progress=report)
        console.print("\n".join(lines), soft_wrap=True, highlight=False)
        return
    items = suite.items()
    with progress_lines(shown=config.progress, console=console) as report:
        workers = config.workers or os.cpu_count() or 1
        made = make_suite(suite, recordings_dir, workers=workers, on_progress=report)
    frames, elapsed_s = sum(one.num_frames for one in made), sum(one.elapsed_s for one in made)
    speed = f", {frames / elapsed_s:.1f} frames/s a process" if frames else ""
    sheet = save_sheet(suite, recordings_dir)
    num_kept = len(items) - len(made)
    console.print(f"{suite.name}: {len(made)} made, {num_kept} kept, in {recordings_dir}{speed}; {sheet.name}")


if __name__ == "__main__":
    main()
