"""TagAttention's Fig. 17 again, and any other grid of a tracer's parameters over benchmark suites.

python -m experiments.sweep_paper                                      # v0 0.01, 0.1, 0.5 m/s, slow and fast
python -m experiments.sweep_paper width=256 clips.stride=2 most=2 out=recordings/small hydra.run.dir=outputs/sweep_small   # in small
python -m experiments.sweep_paper 'suites=[single_static,single_dynamic]' 'splits=[train,validation]' \\
    '+grid={alpha_m2:[1e-4,5e-4,5e-3],beta:[0.2,0.8],v0_m_s:[0.05,0.1,0.2]}' hydra.run.dir=outputs/grid

A killed sweep goes on when it is started again.
"""

from __future__ import annotations

import json
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .compare import suites_named
from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="sweep_paper")
def main(config: DictConfig) -> float:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.sweep import SweepConfig, run_sweep, table
    from tagjax.report.report import plain

    from .progress import counting_bar

    values = resolved(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
    progress, names = values.pop("progress"), values.pop("suites")
    console = Console()
    with counting_bar(console, shown=progress) as bar:
        task = bar.add_task("sweep", total=None)

        def tell(done: int, total: int, name: str) -> None:
            bar.update(task, completed=done, total=total or None, description=name)

        with in_a_line("sweep_paper"):
            checked = from_mapping(SweepConfig, {**values, "suites": suites_named(names)})
            lines = run_sweep(checked, folder, on_progress=tell)
    rows = table(lines)
    console.print((folder / "table.md").read_text(), soft_wrap=True, highlight=False)
    console.print(f"table.md, table.csv, sweep.png, lines.jsonl in {folder}", soft_wrap=True, highlight=False)
    print(json.dumps(plain(rows), allow_nan=False))
    return float(rows[0]["IoU"])


if __name__ == "__main__":
    answer_help(__doc__, "sweep_paper")
    main()
