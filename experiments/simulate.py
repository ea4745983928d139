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

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    import os

    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.sim.contact_sheet import save_preview, save_sheet
    from tagjax.sim.suites import SimulateConfig, Suite, make_suite

    from .progress import counting_bar

    if values.get("suite") is None:
        raise ValueError("found no suite; expected suite=<name>. `--help` lists the names.")
    config = checked(SimulateConfig, values, folder)
    suite = from_mapping(Suite, config.suite, where="suite")
    suite = suite.smoke() if config.smoke else suite
    recordings_dir, console = Path(config.recordings_dir), Console(markup=False)
    if config.sheet is not None:
        console.print(f"{suite.name}: {save_preview(suite, Path(config.sheet), workers=config.workers or 1)}")
        return
    if config.budget is not None:
        from tagjax.sim.link_budgets import budget_lines

        console.print("\n".join(budget_lines(suite, config.budget)), soft_wrap=True, highlight=False)
        return
    items = suite.items()
    with counting_bar(console, shown=config.progress) as bar:
        task = bar.add_task(suite.name, total=len(items))
        bar.update(task, completed=sum(item.path(recordings_dir).exists() for item in items))
        made = make_suite(
            suite,
            recordings_dir,
            workers=config.workers or os.cpu_count() or 1,
            on_done=lambda one: bar.update(task, advance=1, description=one.name),
        )
    frames, elapsed_s = sum(one.num_frames for one in made), sum(one.elapsed_s for one in made)
    speed = f", {frames / elapsed_s:.1f} frames/s a process" if frames else ""
    sheet = save_sheet(suite, recordings_dir)
    num_kept = len(items) - len(made)
    console.print(f"{suite.name}: {len(made)} made, {num_kept} kept, in {recordings_dir}{speed}; {sheet.name}")


if __name__ == "__main__":
    main()
