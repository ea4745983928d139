"""Make the HTML page of a run again from the files in its folder; nothing is traced. The last line is its path.

python -m experiments.report run=outputs/evaluate/<time>
python -m experiments.report run=outputs/train/<time> out=page.html

`experiments.train` and `experiments.evaluate` make it at their end: report.html in the run folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from tagjax.core.folder_lock import locked_folder
    from tagjax.core.progress import progress_lines
    from tagjax.report.page import write_page

    run, out = Path(str(values["run"])), values["out"]
    if not run.is_dir():
        raise FileNotFoundError(f"run={run}: found no such folder; expected a run folder of train or evaluate.")
    with locked_folder(run), progress_lines(shown=bool(values["progress"])) as report:
        page = write_page(run, None if out is None else Path(str(out)), on_progress=report)
    print(page)


if __name__ == "__main__":
    main()
