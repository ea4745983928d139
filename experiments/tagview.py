"""Tagview's experiments on simulated suites: identified toy trains, tables and plots; or its detector trained.

python -m experiments.simulate suite=ceiling_2         # and ceiling_3 to ceiling_6, separated_traces, half_wavelength
python -m experiments.tagview
python -m experiments.tagview max_recordings=4 'suites=[ceiling_4]' system.detector.kind=motion
python -m experiments.tagview command=train            # writes detector.npz to the run folder
python -m experiments.tagview system.detector.weights=<file>
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command, print_result, write_config
from .suites import suites_named


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.markdown import Markdown
    from rich.progress import Progress

    from tagjax.evaluation.tagview import TagviewExperiment, run_tagview, table, train_tagview

    asked, progress = values.pop("command"), values.pop("progress")
    if asked not in ("run", "train"):
        raise ValueError(f"command is {asked!r}; expected run or train.")
    suites_named(values["suites"])
    config, console = checked(TagviewExperiment, values, folder), Console()
    write_config({"command": asked, **values}, folder)
    with Progress(console=console, disable=not progress) as bar:
        task = bar.add_task("tagview", total=None)

        def report(name: str, number: int, total: int) -> None:
            bar.update(task, completed=number, total=total, description=name)

        if asked == "train":
            steps = config.training.recipe.num_steps
            metrics = train_tagview(config, folder, on_step=lambda step, loss: report(f"loss {loss:.3f}", step, steps))
        else:
            metrics = run_tagview(config, folder, on_progress=report)
            console.print(Markdown(table(metrics)))
    console.print(f"run folder: {folder}", soft_wrap=True, highlight=False)
    print_result(metrics)


if __name__ == "__main__":
    main()
