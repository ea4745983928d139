"""Measure the speed of the stages against peers in the same run; the last line is the result as JSON.

python -m experiments.benchmark
python -m experiments.benchmark tracer                # the tracer, live: frames, parts, start, memory; minutes
python -m experiments.benchmark tracer tracer.recording=a.zarr tracer.processes=false
python -m experiments.benchmark memory                # memory of a process over 20,000 live frames; minutes
python -m experiments.benchmark flow                  # the same as 'cases=[flow]'
python -m experiments.benchmark training              # a training step against the clip's length; minutes
python -m experiments.benchmark gather splat repeats=21
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def run(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from tagjax.benchmarks.stages import BenchmarkSettings, run_benchmark
    from tagjax.benchmarks.timing import Timing
    from tagjax.core.machine import machine
    from tagjax.core.progress import progress_lines
    from tagjax.core.results import write_json

    console = Console(width=None if sys.stdout.isatty() else 140, markup=False)  # a file has no terminal width
    progress = values.pop("progress")
    settings = checked(BenchmarkSettings, values, folder)
    timings, figures = [], []
    table = Table("what", "ours, ms", "peer", "peer, ms", "ratio", "first call, s", "memory, MiB")
    aims = Table("what", "measured", "aim: at most", "reached")
    with progress_lines(shown=progress, console=console) as report:
        result: dict[str, Any] = {}
        for found in run_benchmark(settings, on_progress=report):
            if isinstance(found, Timing):
                line = f"{found.what}: {found.ours_ms:.2f} ms; {found.peer}: {found.peer_ms:.2f} ms"
                first = f"{found.compile_s:.1f}" if found.compile_s else ""
                memory = f"{found.memory_mib:.0f}" if found.memory_mib else ""
                row = found.what, f"{found.ours_ms:.2f}", found.peer, f"{found.peer_ms:.2f}", f"{found.ratio:.2f}"
                table.add_row(*row, first, memory)
                timings.append({**dataclasses.asdict(found), "ratio": found.ratio})
            else:
                line = f"{found.what}: {found.value:.2f} {found.unit}".rstrip()
                aim = (
                    ("", "") if found.aim is None else (f"{found.aim:g} {found.unit}", "yes" if found.reached else "no")
                )
                aims.add_row(found.what, f"{found.value:.2f} {found.unit}", *aim)
                figures.append({**dataclasses.asdict(found), "reached": found.reached})
            console.print(line, soft_wrap=True)
            # Written after each case, because a whole run takes minutes and may be stopped.
            result = {"machine": machine(), "timings": timings, "figures": figures}
            write_json(folder / "benchmark.json", result)
    for one in (table, aims):
        if one.row_count:
            console.print(one)
    print_result(result)


def main() -> None:
    """`run`, with names at the beginning of the arguments taken for `cases=[...]`."""
    given = list(itertools.takewhile(str.isidentifier, sys.argv[1:]))
    if given:
        sys.argv[1:] = [f"cases=[{','.join(given)}]", *sys.argv[1 + len(given) :]]
    run()


if __name__ == "__main__":
    main()
