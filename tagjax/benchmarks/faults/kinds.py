"""The kinds of faults that the trial knows. To add one, write a module with `trial` and add it to `KINDS`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from . import clocks, kills, names, real_tables, tables, targets, weights
from .outcome import Outcome

KINDS: dict[str, Callable[[int, int, Path], list[Outcome]]] = {
    "clocks": clocks.trial,
    "names": names.trial,
    "targets": targets.trial,
    "tables": tables.trial,
    "real_tables": real_tables.trial,
    "weights": weights.trial,
    "kills": kills.trial,
}
"""By name the function that tries `number` faults, drawn from `seed`, in an empty folder: `trial(number, seed, folder)`."""
