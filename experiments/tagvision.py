"""TagVision's experiments: parallel lines, calibration, objects that move over a table; the last line is JSON.

python -m experiments.tagvision                                    # lines and calibration, a minute
python -m experiments.tagvision benchmark=planar_tracks            # and the suite, simulated first where missing
python -m experiments.tagvision benchmark=planar_tracks split=validation out=<folder of experiments.simulate>
"""

from __future__ import annotations

import json
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from .errors import in_a_line, refuse_dropped_choices
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="tagvision")
def main(config: DictConfig) -> None:
    from rich.console import Console
    from rich.markdown import Markdown

    from tagjax.baselines.tagvision.experiment import TagVisionExperiment, report_markdown, run_tagvision
    from tagjax.config import from_mapping

    values = resolved(config)
    progress = values.pop("progress")
    folder = Path(HydraConfig.get().runtime.output_dir)
    console = Console()
    with in_a_line("tagvision"):
        refuse_dropped_choices()
        OmegaConf.save(OmegaConf.create(values), folder / "config.yaml")
        checked = from_mapping(TagVisionExperiment, values)
        with console.status("TagVision") as status:
            metrics = run_tagvision(checked, folder, on_progress=status.update if progress else None)
    console.print(Markdown(report_markdown(metrics)))
    console.print(f"plots, table.md and metrics.json in {folder}", soft_wrap=True, highlight=False)
    print(json.dumps(metrics, allow_nan=False))


if __name__ == "__main__":
    answer_help(__doc__, "tagvision")
    main()
