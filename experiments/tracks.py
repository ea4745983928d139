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

    from tagjax.evaluation.tracks import TracksConfig, run_tracks

    if values.get("folder") is None:
        raise ValueError("found no folder; expected folder=<folder with kinect-rfid/ or xovis-uwb/>.")
    config, console = checked(TracksConfig, values, folder), Console(markup=False)
    with console.status("scoring", spinner="line") as status:
        run_tracks(config, folder, on_done=status.update)
    console.print((folder / "tables.md").read_text(), markup=False)
    console.print(f"run folder: {folder}")


if __name__ == "__main__":
    main()
