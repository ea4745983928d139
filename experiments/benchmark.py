"""Measure the stages against named peers in the same run; the last line printed is the result as JSON.

python -m experiments.benchmark
python -m experiments.benchmark flow
python -m experiments.benchmark training    # a training step against the clip's length; minutes
python -m experiments.benchmark 'cases=[gather,splat]' repeats=21
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from .errors import in_a_line
from .help import answer_help
from .train import CONFIGS, resolved


@hydra.main(version_base="1.3", config_path=CONFIGS, config_name="benchmark")
def main(config: DictConfig) -> None:
    from rich.console import Console
    from rich.table import Table

    from tagjax.benchmarks.stages import BenchmarkSettings, run_benchmark
    from tagjax.core.machine import machine
    from tagjax.core.settings import from_mapping

    console = Console(width=None if sys.stdout.isatty() else 140)  # a file has no width of its own
    timings = []
    with in_a_line("benchmark"):
        settings = from_mapping(BenchmarkSettings, resolved(config))
    written = Path(HydraConfig.get().runtime.output_dir) / "benchmark.json"
    table = Table("what", "ours, ms", "peer", "peer, ms", "ratio", "first call, s", "memory, MiB")
    with console.status("measuring") as status:
        for timing in run_benchmark(settings, on_case=lambda name: status.update(f"measuring {name}")):
            console.print(
                f"{timing.what}: {timing.ours_ms:.2f} ms; {timing.peer}: {timing.peer_ms:.2f} ms", soft_wrap=True
            )
            first = f"{timing.compile_s:.1f}" if timing.compile_s else ""
            memory = f"{timing.memory_mib:.0f}" if timing.memory_mib else ""
            row = timing.what, f"{timing.ours_ms:.2f}", timing.peer, f"{timing.peer_ms:.2f}", f"{timing.ratio:.2f}"
            table.add_row(*row, first, memory)
            timings.append({**dataclasses.asdict(timing), "ratio": timing.ratio})
            # After each, for a whole run takes minutes and may be stopped.
            written.write_text(json.dumps({"machine": machine(), "timings": timings}) + "\n")
    console.print(table)
    print(written.read_text(), end="")


def with_cases(arguments: list[str]) -> list[str]:
    """Arguments for Hydra: bare words name the cases."""
    names = [word for word in arguments if word.isidentifier()]
    rest = [word for word in arguments if word not in names]
    return [f"cases=[{','.join(names)}]", *rest] if names else rest


if __name__ == "__main__":
    answer_help(__doc__, "benchmark")
    sys.argv[1:] = with_cases(sys.argv[1:])
    main()
