"""Association of real tracks with virtual and real tags: accuracy of every method's score by window length.

python -m experiments.tracks folder=<folder with kinect-rfid/ and xovis-uwb/>
python -m experiments.tracks folder=<...> 'windows_s=[2,4]' max_windows=10 noise_m=0.05

Of kinect-rfid/ the files <date>.txt (skeletons) and RFID_<date>.txt (the reader's speeds) are read, of xovis-uwb/ the files
raw_xovis.csv (stereo tracks) and XOVIS_UWB.csv (positions of a UWB tag and its carrier); one of the two folders
suffices. One virtual tag is put on each track, and the real tags are scored as well: tables.md, real_tags.png and
metrics.json in the run folder.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.evaluation.tracks import TracksConfig, run_tracks

    if values.get("folder") is None:
        raise ValueError("found no folder; expected folder=<folder with kinect-rfid/ or xovis-uwb/>.")
    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(TracksConfig, values, folder)
    with progress_lines(shown=progress, console=console) as report:
        run_tracks(config, folder, on_progress=report)
    console.print((folder / "tables.md").read_text(), markup=False)
    console.print(f"run folder: {folder}")


if __name__ == "__main__":
    main()
