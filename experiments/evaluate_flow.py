"""Compare optical flows on synthetic pairs, recordings with exact flow, Middlebury's scenes, FlyingChairs, and videos.

python -m experiments.evaluate_flow 'flows=[zero,dis,pyramid]'
python -m experiments.evaluate_flow 'suites=[corpus]' max_pairs=8   # whose recordings hold their exact flow
python -m experiments.evaluate_flow 'flows=[dis,outputs/train_flow/<time>/weights.safetensors]' 'recordings=[a.zarr,b.zarr]'
python -m experiments.evaluate_flow 'flows=[dis,pyramid]' num_pairs=0 'folders=[middlebury]' 'sequences=[my_video.mp4]'
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

from .command import checked, command, print_result
from .suites import suite_recordings, suites_named

_log = logging.getLogger(__name__)


@command
def main(values: dict[str, Any], folder: Path) -> float:
    from rich.console import Console

    from tagjax.evaluation.flow import FlowEvaluationSettings, evaluate_flows, flow_tables

    console = Console(markup=False)
    suites, split, recordings_dir = (values.pop(name) for name in ("suites", "split", "recordings_dir"))
    for suite in suites_named(suites).values():
        values["recordings"] += suite_recordings(suite, split, recordings_dir, progress=values["progress"])
    summary = evaluate_flows(checked(FlowEvaluationSettings, values, folder), folder)
    for table in flow_tables(summary):
        console.print(table)
    _draw(summary["materials"], folder)
    console.print(f"report: {folder}", soft_wrap=True, highlight=False)
    scores = {name: {flow: s["all"] for flow, s in flows.items()} for name, flows in summary["materials"].items()}
    print_result(scores)
    # The objective of a sweep: end-point error in pixels of the last flow on the first material.
    errors_px = [one.get("epe_px") for one in next(iter(scores.values()), {}).values()]
    return float("nan") if not errors_px or errors_px[-1] is None else float(errors_px[-1])


def _draw(materials: dict[str, Any], folder: Path) -> None:
    try:
        from tagjax.report.flow_speed import error_by_time
    except ImportError:
        _log.warning("error_by_time.png was not drawn: matplotlib is not installed. Install the viz extra.")
        return
    error_by_time(folder / "error_by_time.png", materials)


if __name__ == "__main__":
    main()
