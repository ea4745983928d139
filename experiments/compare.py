"""All four systems on the same suites, in one table; the last line printed is the result as JSON.

python -m experiments.compare benchmark=planar_tracks,ceiling_2 most=2
python -m experiments.compare benchmark=single_static 'only=[tagattention,tagattention_paper]'
python -m experiments.compare benchmark=shop_exit systems.goller_calibration=<calibration.json of experiments.goller>
python -m experiments.compare benchmark=shop_exit systems.goller_grid=<recording of shop_grid>  # widths as they start
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


def suites_named(names: str | list[str] | None) -> dict[str, Any]:
    """The settings of suites by name, from `conf/benchmark`. Raises `SystemExit` for a name that is none."""
    folder = Path(CONFIGS) / "benchmark"
    known = sorted(path.stem for path in folder.glob("*.yaml"))
    chosen = [names] if isinstance(names, str) else list(names or [])
    if unknown := [name for name in chosen if name not in known]:
        raise SystemExit(f"compare: unknown suite {', '.join(unknown)}; known are {', '.join(known)}.")
    return {name: OmegaConf.to_container(OmegaConf.load(folder / f"{name}.yaml"), resolve=True) for name in chosen}


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="compare")
def main(config: DictConfig) -> None:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.compare import CompareConfig, console_table, run_comparison
    from tagjax.report.report import plain

    values = resolved(config)
    progress, names = values.pop("progress"), values.pop("suites")
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create({"suites": names, **values}), folder / "config.yaml")
    console = Console()
    with in_a_line("compare"):
        checked = from_mapping(CompareConfig, {**values, "suites": suites_named(names)})
        with console.status("comparing") as status:
            cells = run_comparison(checked, folder, on_progress=status.update if progress else None)
    console.print(console_table(cells))
    console.print(f"table.md, table.csv, table.json and comparison.png in {folder}", soft_wrap=True, highlight=False)
    print(json.dumps(plain([dataclasses.asdict(cell) for cell in cells]), allow_nan=False))


def with_suites(arguments: list[str]) -> list[str]:
    """Arguments for Hydra, to which `benchmark=` would be one file of the group of that name.

    Names with commas between them are a list, brackets or not, unless a sweep is asked for, which has a run for each.
    """
    sweeps = not {"-m", "--multirun"}.isdisjoint(arguments)
    found = []
    for word in arguments:
        if word.startswith("benchmark="):
            names = word.removeprefix("benchmark=")
            bare = "," in names and not any(mark in names for mark in "[]()'\"")
            word = f"suites=[{names}]" if bare and not sweeps else f"suites={names}"
        found.append(word)
    return found


if __name__ == "__main__":
    answer_help(__doc__, "compare")
    sys.argv[1:] = with_suites(sys.argv[1:])
    main()
