"""Try damaged and hostile inputs: how many of each kind were tried and failed; the last line is the result as JSON.

python -m experiments.fault_trial
python -m experiments.fault_trial 'kinds=[tables]' number=100000 seed=1    # minutes
python -m experiments.fault_trial page=true                                # also into docs/reliability.md

The exit status is 1 if any fault failed.
"""

from __future__ import annotations

import datetime
from pathlib import Path
from typing import Any

from .command import CONF, checked, command, print_result

DOCS = CONF.parent / "docs"


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.benchmarks.faults.run import FaultTrialSettings, num_failed, rendered, run_trial
    from tagjax.core.files import write_atomic
    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.reproduce.markdown import replaced
    from tagjax.evaluation.reproduce.provenance import revision

    page, progress = values.pop("page"), values.pop("progress")
    settings = checked(FaultTrialSettings, values, folder)
    if page and not (DOCS / "reliability.md").is_file():
        raise ValueError(
            f"found no {DOCS / 'reliability.md'}; expected a clone of the repository. Leave out page=true."
        )
    path = DOCS / "reliability.json" if page else folder / "fault_trial.json"
    console = Console(soft_wrap=True, highlight=False, markup=False)
    about = {
        "commit": revision(CONF.parent, {})["commit"],
        "date_utc": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    with progress_lines(shown=progress, console=console) as report:
        results = run_trial(settings, path, about=about, on_progress=report)
    if page:
        text = (DOCS / "reliability.md").read_text(encoding="utf-8")
        write_atomic(DOCS / "reliability.md", replaced(text, "faults", rendered(results)))
    console.print(rendered(results))
    print_result(results)
    if num_failed(results):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
