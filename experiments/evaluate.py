"""Evaluate a training run, learned weights or an untrained tracer on recordings; the last line is the result as JSON.

python -m experiments.evaluate run=outputs/train/<time> 'recordings=[c.zarr]'
python -m experiments.evaluate weights=default 'recordings=[c.zarr]'                  # with the clips it was trained with
python -m experiments.evaluate tracer=tagattention_published suite=single_static        # its test split
python -m experiments.evaluate tracer=tagattention tracer@baselines.published=tagattention_published 'recordings=[c.zarr]'
python -m experiments.evaluate tracer=tagattention_rgb depth=none 'recordings=[c.zarr]'     # a colour camera, several antennas
python -m experiments.evaluate run=<folder> 'recordings=[c.zarr]' virtual_tag.tracks=tracks.csv 'virtual_tag.seeds=[0]'
python -m experiments.evaluate -m hparams_search=optuna_equations suite=corpus split=train  # a killed search resumes when started again
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import command, print_result, write_config
from .hparams_search import sweep_score
from .run_folder import read_configuration
from .suites import suite_recordings


def run_configuration(run: str | None) -> dict[str, Any] | None:
    """The configuration in a run folder's config.yaml."""
    if run is None:
        return None
    path = Path(run) / "config.yaml"
    if not path.is_file():
        raise FileNotFoundError(f"run={run}: found no {path}; expected a run folder of experiments.train.")
    return read_configuration(path)


@command
def main(values: dict[str, Any], folder: Path) -> float | None:
    from rich.console import Console

    from tagjax.core.settings import from_mapping
    from tagjax.evaluation.run import EvaluateConfig, run_evaluation
    from tagjax.report.page import PAGE
    from tagjax.report.report import score_table

    suite, options = values.pop("suite", None), {key: values.pop(key) for key in ("max_recordings", "smoke")}
    split, recordings_dir = values.pop("split"), values.pop("recordings_dir")
    config = from_mapping(EvaluateConfig, values)
    if suite is not None:
        values["recordings"] = [
            *config.recordings,
            *suite_recordings(suite, split, recordings_dir, **options, progress=config.progress),
        ]
        config = from_mapping(EvaluateConfig, values)
    write_config(values, folder)
    summary = run_evaluation(config, folder, run_values=run_configuration(config.run))
    console = Console(markup=False)
    console.print(score_table(summary))
    console.print(f"report: {folder / PAGE}", soft_wrap=True, highlight=False)
    print_result(summary)
    iou = next(iter(summary.values()))["all"].get("iou")
    return None if iou is None else sweep_score(float(iou))


if __name__ == "__main__":
    main()
