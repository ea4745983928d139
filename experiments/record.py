"""Record an RGB-D camera and a UHF RFID reader at the same time. The last line is the recording's summary as JSON.

python -m experiments.record camera=realsense reader=llrp address=192.168.1.10 'antennas_m=[[0.2,0.0,0.0]]' out=recordings/a.zarr
python -m experiments.record camera=k4a reader=r700 address=https://192.168.1.10 'antennas_m=[[0.2,0.0,0.0]]' out=recordings/b.zarr
python -m experiments.record recording=recordings/a.zarr reader=llrp emulate=true out=recordings/c.zarr     # no hardware at all
python -m experiments.record finish=recordings/a.zarr             # complete a recording that was cut off

Ctrl-C ends the recording. The folder opens as a recording at any moment; a process that is killed loses the last half second.
preview.jpg in the run folder is the last frame. Needs packages: pip install -c constraints.txt -e ".[reader]", and for the camera
the extra realsense, orbbec or k4a. These cameras and real readers are untested on hardware.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.recording.capture.record import record
    from tagjax.recording.capture.settings import RecordConfig

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(RecordConfig, values, folder)
    with console.status("connecting") as status:
        summary = record(config, folder, on_status=status.update if progress else None)
    for note in summary["notes"]:
        console.print(note, soft_wrap=True, highlight=False)
    print_result(summary)


if __name__ == "__main__":
    main()
