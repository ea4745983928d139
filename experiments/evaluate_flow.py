"""Evaluate optical flows side by side: drawn pairs, recordings with exact flow, Middlebury's scenes, any video.

python -m experiments.evaluate_flow 'flows=[zero,dis,pyramid]'
python -m experiments.evaluate_flow 'flows=[dis,outputs/train_flow/<time>/weights.safetensors]' 'recordings=[a.zarr,b.zarr]'
python -m experiments.evaluate_flow 'flows=[dis,pyramid]' num_pairs=0 'folders=[middlebury]' 'sequences=[my_video.mp4]'
"""

from __future__ import annotations

import json
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="evaluate_flow")
def main(config: DictConfig) -> float:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.flow import FlowEvaluationSettings, evaluate_flows, flow_tables
    from tagjax.report.report import plain

    values = resolved(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
    console = Console()
    with in_a_line("evaluate_flow"):
        summary = evaluate_flows(from_mapping(FlowEvaluationSettings, values), folder)
    for table in flow_tables(summary):
        console.print(table)
    console.print(f"report: {folder}", soft_wrap=True, highlight=False)
    found = {name: {flow: s["all"] for flow, s in flows.items()} for name, flows in summary["materials"].items()}
    print(json.dumps(plain(found), allow_nan=False))
    # The objective of a sweep: the last flow named, on the first material, end-point error in pixels.
    errors_px = [scores.get("epe_px") for scores in next(iter(found.values()), {}).values()]
    return float("nan") if not errors_px or errors_px[-1] is None else float(errors_px[-1])


if __name__ == "__main__":
    answer_help(__doc__, "evaluate_flow")
    main()
