"""Trace a recording and write a file for the Rerun viewer, or show it there live. The last line is the file's path.

python -m experiments.view recording=recordings/mine.zarr                      # mine.rrd, then: rerun <run folder>/mine.rrd
python -m experiments.view recording=recordings/mine.zarr live=true            # the viewer opens, depth as points in space
python -m experiments.view recording=recordings/mine.zarr smooth=true depth=true
python -m experiments.view recording=recordings/mine.zarr run=outputs/train/<time>   # with what a training run learned

Needs rerun-sdk: pip install -c constraints.txt -e ".[viewer]"
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command
from .evaluate import run_configuration


def with_run(values: dict[str, Any]) -> dict[str, Any]:
    """The values with the tracer and the weights of their `run`, without that key."""
    run, others = values["run"], {key: value for key, value in values.items() if key != "run"}
    configuration = run_configuration(run)
    if configuration is None:
        return others
    if others.get("weights") is not None:
        raise ValueError(f"found both run={run} and weights={others['weights']}; expected one of them.")
    return others | {"tracer": configuration["tracer"], "weights": str(Path(run) / "weights.json")}


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.view import ViewConfig, view_recording

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(ViewConfig, with_run(values), folder)
    with progress_lines(shown=progress, console=console) as report:
        out = view_recording(config, folder, on_progress=report)
    if out is not None:
        console.print(f"open it: rerun {out}", soft_wrap=True, highlight=False)
        print(out)


if __name__ == "__main__":
    main()
