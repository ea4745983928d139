"""Tagview's experiments on simulated suites: identification, tables and plots; or the training of its detector.

python -m experiments.simulate suite=ceiling_2         # and ceiling_3 to ceiling_6, separated_traces, half_wavelength
python -m experiments.tagview
python -m experiments.tagview max_recordings=4 'suites=[ceiling_4]' system.detector.kind=motion
python -m experiments.tagview command=train            # writes detector.safetensors to the run folder
python -m experiments.tagview system.detector.weights=<file>
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import command, print_result, write_config
from .suites import suites_named


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.markdown import Markdown

    from tagjax.baselines.tagview.experiment import TagviewExperiment, report_markdown, run_tagview, train_tagview
    from tagjax.core.progress import progress_lines
    from tagjax.core.settings import from_mapping

    command_name, progress = values.pop("command"), values.pop("progress")
    if command_name not in ("run", "train"):
        raise ValueError(f"command is {command_name!r}; expected run or train.")
    suites_named(values["suites"])
    config, console = from_mapping(TagviewExperiment, values), Console(markup=False)
    write_config({"command": command_name, **values}, folder)
    with progress_lines(shown=progress, console=console) as report:
        if command_name == "train":
            metrics = train_tagview(config, folder, on_progress=report)
        else:
            metrics = run_tagview(config, folder, on_progress=report)
            console.print(Markdown(report_markdown(metrics)))
    console.print(f"run folder: {folder}", soft_wrap=True, highlight=False)
    print_result(metrics)


if __name__ == "__main__":
    main()
