"""Tagview's experiments on simulated suites: identification, tables and plots; or the training of its detector.

python -m experiments.simulate benchmark=ceiling_2     # and ceiling_3 to ceiling_6, separated_traces, half_wavelength
python -m experiments.tagview
python -m experiments.tagview max_recordings=4 'suites=[ceiling_4]' system.detector.kind=motion
python -m experiments.tagview command=train            # writes detector.npz to the run folder
python -m experiments.tagview system.detector.weights=<file>
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


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="tagview")
def main(config: DictConfig) -> None:
    from rich.console import Console
    from rich.markdown import Markdown
    from rich.progress import Progress

    from tagjax.baselines.tagview.experiment import TagviewExperiment, report_markdown, run_tagview, train_tagview
    from tagjax.config import from_mapping

    values = resolved(config)
    command, progress = values.pop("command"), values.pop("progress")
    if command not in ("run", "train"):
        raise SystemExit(f"tagview: command is {command!r}; expected run or train.")
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.save(OmegaConf.create({"command": command, **values}), folder / "config.yaml")
    console = Console()
    with in_a_line("tagview"):
        checked = from_mapping(TagviewExperiment, values)
        with Progress(console=console, disable=not progress) as bar:
            task = bar.add_task("tagview", total=None)
            if command == "train":
                total = checked.training.settings.num_steps
                metrics = train_tagview(
                    checked,
                    folder,
                    on_step=lambda step, loss: bar.update(
                        task, completed=step, total=total, description=f"loss {loss:.3f}"
                    ),
                )
            else:
                metrics = run_tagview(
                    checked,
                    folder,
                    on_progress=lambda name, number, total: bar.update(
                        task, completed=number, total=total, description=name
                    ),
                )
    if command == "run":
        console.print(Markdown(report_markdown(metrics)))
    console.print(f"tables, plots and metrics in {folder}", soft_wrap=True, highlight=False)
    print(json.dumps(metrics, allow_nan=False))


if __name__ == "__main__":
    answer_help(__doc__, "tagview")
    main()
