"""Goller et al.: calibrate on a tag grid, run the scenarios, write both tables, metrics and plots to the run folder.

python -m experiments.simulate benchmark=shop_grid     # and shop_exit, shop_handover
python -m experiments.goller
python -m experiments.goller handover=<recording>      # instead of those of shop_handover beside the scenarios
python -m experiments.goller scenarios=<folder of the suite> max_recordings=3 fit_steps=0
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


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="goller")
def main(config: DictConfig) -> None:
    from rich.console import Console

    from tagjax.baselines.goller.experiment import GollerExperiment, run_goller
    from tagjax.config import from_mapping
    from tagjax.data.store import open_recording

    values = resolved(config)
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
    console = Console()
    with in_a_line("goller"), console.status("observing", spinner="line") as status:
        checked = from_mapping(GollerExperiment, values)
        metrics = run_goller(checked, folder, open_recording=open_recording, on_progress=status.update)
    console.print((folder / "tables.md").read_text(), markup=False)
    if metrics["handover"] is None:
        hint = "no hand-over: `python -m experiments.simulate benchmark=shop_handover` makes such recordings"
        console.print(hint, soft_wrap=True, highlight=False)
    console.print(f"run folder: {folder}")
    print(json.dumps(metrics, allow_nan=False))


if __name__ == "__main__":
    answer_help(__doc__, "goller")
    main()
