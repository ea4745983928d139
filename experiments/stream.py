"""Trace a recording as if its sensors were running, or running sensors; the last line is the result as JSON.

python -m experiments.stream recording=a.zarr                            # in real time: frames that are late are dropped
python -m experiments.stream recording=a.zarr replay.real_time=false      # as fast as it goes, every frame
python -m experiments.stream recording=a.zarr replay.real_time=false replay.loops=100
python -m experiments.stream recording=a.zarr events=stdout events.webhook=http://127.0.0.1:9000/tags 'events.regions=[{name: exit, floor_m: [[-1,0],[1,0],[1,2],[-1,2]]}]'
python -m experiments.stream recording=a.zarr page.port=8080      # a web page: http://127.0.0.1:8080/
python -m experiments.stream camera=realsense reader=llrp address=192.168.1.10 'antennas_m=[[0.2,0.0,0.0]]' record=recordings/a.zarr
python -m experiments.stream camera=playback reader=llrp emulate=true recording=a.zarr     # the same without any hardware

frames.jsonl has a line a frame: time, and for each tag box, place, confidence, and status: detected, or the reason why not. events.jsonl has
a line an event: a tag was detected, was lost, raised an alarm in a region, or left through it. Ctrl-C ends the stream and keeps all lines.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console

    from tagjax.core.progress import progress_lines
    from tagjax.live.config import StreamConfig
    from tagjax.live.stream import run_stream

    progress, console = values.pop("progress"), Console(markup=False)
    config = checked(StreamConfig, values, folder)

    def shown(address: str) -> None:
        console.print(f"the page: {address}", soft_wrap=True, highlight=False)

    console.print("The tracer is compiled first: half a minute, more on a busy machine.", highlight=False)
    with progress_lines(shown=progress, console=console) as report:
        summary = run_stream(config, folder, on_progress=report, on_page=shown)
    console.print(
        f"{summary['frames']} frames at {summary['frames_per_s']:.1f}/s, {summary['dropped_frames']} dropped; a frame took "
        f"{summary['process_ms']['p50']:.1f} ms (median), {summary['process_ms']['p99']:.1f} ms (99 %); its result came "
        f"{summary['latency_ms']['p50']:.1f} ms after it (median). frames.jsonl, events.jsonl and stream.json are in {folder}",
        soft_wrap=True,
        highlight=False,
    )
    print_result(summary)


if __name__ == "__main__":
    main()
