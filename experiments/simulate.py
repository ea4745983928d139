"""Simulate a benchmark suite: the same name and seed give the same recordings; what is there already is kept.

python -m experiments.simulate benchmark=multi_4
python -m experiments.simulate benchmark=corpus benchmark.counts.train=200 out=recordings/corpus workers=8
python -m experiments.simulate benchmark=crowd smoke=true out=recordings/smoke
python -m experiments.simulate -m 'benchmark=glob(*)' sheet=docs/benchmark   # the pictures of docs/benchmark.md again
"""

from __future__ import annotations

import hydra
from omegaconf import DictConfig

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="simulate")
def main(config: DictConfig) -> None:
    import os
    from pathlib import Path

    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.sim.contact_sheet import save_preview, save_sheet
    from tagjax.sim.suites import SimulateConfig, Suite, make_suite

    from .progress import counting_bar

    values = resolved(config)
    sheets = values.pop("sheet", None)
    if values.get("benchmark") is None:
        raise SystemExit("simulate: name a suite: benchmark=<name>. `--help` lists them.")
    with in_a_line("simulate"):
        checked = from_mapping(SimulateConfig, values)
        suite = from_mapping(Suite, checked.benchmark, where="benchmark")
    suite = suite.smoke() if checked.smoke else suite
    console = Console()
    if sheets is not None:
        console.print(f"{suite.name}: {save_preview(suite, Path(sheets), workers=checked.workers or 1)}")
        return
    total = len(suite.items())
    with counting_bar(console, shown=checked.progress) as bar:
        task = bar.add_task(suite.name, total=total)
        here = sum(item.path(Path(checked.out)).exists() for item in suite.items())
        bar.update(task, completed=here)
        with in_a_line("simulate"):
            made = make_suite(
                suite,
                Path(checked.out),
                workers=checked.workers or os.cpu_count() or 1,
                on_done=lambda one: bar.update(task, advance=1, description=one.name),
            )
    frames, elapsed_s = sum(one.num_frames for one in made), sum(one.elapsed_s for one in made)
    pace = f", {frames / elapsed_s:.1f} frames/s a process" if frames else ""
    sheet = save_sheet(suite, Path(checked.out))
    console.print(
        f"{suite.name}: {len(made)} made, {total - len(made)} there already, in {checked.out}{pace}; {sheet.name}"
    )


if __name__ == "__main__":
    answer_help(__doc__, "simulate")
    main()
