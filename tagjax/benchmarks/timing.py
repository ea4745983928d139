"""Times of calls: medians after a warm-up, also of several calls that alternate."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Timing:
    """One measurement: ours and the peer's, milliseconds."""

    what: str
    ours_ms: float
    peer: str
    peer_ms: float
    compile_s: float = 0.0
    memory_mib: float = 0.0  # largest resident memory of a process that does only this; 0 = not measured

    @property
    def ratio(self) -> float:
        """Ours over the peer's: below 1 is faster."""
        return self.ours_ms / self.peer_ms


@dataclasses.dataclass(frozen=True)
class Figure:
    """One measurement beside the highest value that it should have."""

    what: str
    value: float
    unit: str  # empty for a ratio
    aim: float | None = None

    @property
    def reached(self) -> bool | None:
        """Whether the aim is reached; None without one."""
        return None if self.aim is None else self.value <= self.aim


def median_ms(function: Callable[[], Any], repeats: int) -> float:
    """Median time of a call, milliseconds, after one call to warm up."""
    return medians_ms({"": function}, repeats)[""]


def medians_ms(functions: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, float]:
    """Median times of alternating calls, so that other load on the machine affects all of them equally."""
    for function in functions.values():
        jax.block_until_ready(function())
    times: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(repeats):
        for name, function in functions.items():
            start = time.perf_counter()
            jax.block_until_ready(function())
            times[name].append((time.perf_counter() - start) * 1e3)
    return {name: float(np.median(values)) for name, values in times.items()}


def first_call_s(function: Callable[[], Any]) -> float:
    """Time of the first call, seconds, including compilation."""
    start = time.perf_counter()
    jax.block_until_ready(function())
    return time.perf_counter() - start


def in_separate_process(code: str, what: str, *, environment: Mapping[str, str] | None = None) -> dict[str, float]:
    """The JSON on the last line that Python code prints in a fresh process, so that its memory can be measured.

    `environment` None is that of this process. Raises `RuntimeError` with `what` in its message if the process fails.
    """
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, env=environment)
    if done.returncode:
        raise RuntimeError(f"{what} failed: {done.stderr.strip()[-500:]}")
    return json.loads(done.stdout.splitlines()[-1])
