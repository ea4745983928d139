"""Measure the speed of the stages against peers in the same run; the last line is the result as JSON.

python -m experiments.benchmark
python -m experiments.benchmark 'cases=[flow]'
python -m experiments.benchmark 'cases=[training]'    # a training step against the clip's length; minutes
python -m experiments.benchmark 'cases=[gather,splat]' repeats=21
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path
from typing import Any

from .command import checked, command, print_result


@command
def main(values: dict[str, Any], folder: Path) -> None:
    from rich.console import Console
    from rich.table import Table

    from tagjax.benchmarks.stages import BenchmarkSettings, run_benchmark
    from tagjax.core.machine import machine
    from tagjax.core.results import write_json

    console = Console(width=None if sys.stdout.isatty() else 140, markup=False)  # a file has no terminal width
    settings, timings = checked(BenchmarkSettings, values, folder), []
    table = Table("what", "ours, ms", "peer", "peer, ms", "ratio", "first call, s", "memory, MiB")
    with console.status("measuring") as status:
        result: dict[str, Any] = {}
        for timing in run_benchmark(settings, on_case=lambda name: status.update(f"measuring {name}")):
            console.print(
                f"{timing.what}: {timing.ours_ms:.2f} ms; {timing.peer}: {timing.peer_ms:.2f} ms", soft_wrap=True
            )
            first = f"{timing.compile_s:.1f}" if timing.compile_s else ""
            memory = f"{timing.memory_mib:.0f}" if timing.memory_mib else ""
            row = timing.what, f"{timing.ours_ms:.2f}", timing.peer, f"{timing.peer_ms:.2f}", f"{timing.ratio:.2f}"
            table.add_row(*row, first, memory)
            timings.append({**dataclasses.asdict(timing), "ratio": timing.ratio})
            # Written after each case, because a whole run takes minutes and may be stopped.
            result = {"machine": machine(), "timings": timings}
            write_json(folder / "benchmark.json", result)
    console.print(table)
    print_result(result)


if __name__ == "__main__":
    main()
