"""Evaluate a training run (or an untrained tracer) on recordings; the last line printed is the result as JSON.

python -m experiments.evaluate run=outputs/train/<time> 'recordings=[c.zarr]'
python -m experiments.evaluate tracer=tagattention_paper 'recordings=[c.zarr]' 'frames=[0,200]' stride=2
python -m experiments.evaluate run=<folder> 'recordings=[c.zarr]' virtual_tag.tracks=tracks.csv 'virtual_tag.seeds=[0]'
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .errors import in_a_line, refuse_dropped_choices
from .help import answer_help
from .train import CONFIGS, resolved

FORERUNNERS = {
    f"tracer={name}": f"{name} sees pictures, not clips. On a recording of your own: tagjax.baselines.host_trace (README, "
    f"The forerunners); on simulated suites: python -m experiments.{name}, and experiments.compare beside TagAttention."
    for name in ("tagvision", "tagview", "goller")
}


def run_configuration(run: str | None) -> dict[str, Any] | None:
    """What the run folder's config.yaml says."""
    if run is None:
        return None
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"run={run}: there is no {path}; expected a run folder of experiments.train.")
    config = OmegaConf.load(path)
    assert isinstance(config, DictConfig)
    return resolved(config)


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="evaluate")
def main(config: DictConfig) -> float:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.run import EvaluateConfig, run_evaluation
    from tagjax.report.report import plain, score_table

    values = resolved(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    with in_a_line("evaluate"):
        refuse_dropped_choices(FORERUNNERS)
        checked = from_mapping(EvaluateConfig, values)
        OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
        summary = run_evaluation(checked, folder, run_values=run_configuration(checked.run))
    Console().print(score_table(summary, title=f"report: {folder}"))
    print(json.dumps(plain(summary), allow_nan=False))
    first = next(iter(summary.values()))["all"].get("iou")
    return float("nan") if first is None else float(first)


if __name__ == "__main__":
    answer_help(__doc__, "evaluate")
    main()
