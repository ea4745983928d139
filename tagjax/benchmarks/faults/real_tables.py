"""Tables of real readers, damaged: as `tables`, on the recordings of the environment variable `TAGJAX_REAL_DATA`."""

from __future__ import annotations

import os
import random
from pathlib import Path

from ...core.errors import RecordingError
from ...recording.importers.formats import recognise
from ...recording.importers.rows import text_lines
from .outcome import Outcome, joined, outcome
from .tables import damaged_table, fault_of

MAX_LINES = 120
"""Lines from the beginning of each table, so that thousands of damaged copies take minutes."""


def real_tables(folder: Path) -> dict[str, list[str]]:
    """The first lines of every table of reads below a folder, by file name."""
    tables = {path.name: text_lines(path)[:MAX_LINES] for path in sorted(folder.rglob("rfid/**/*.csv"))}
    return {name: lines for name, lines in tables.items() if recognise(lines) is not None}


def trial(number: int, seed: int, folder: Path) -> list[Outcome]:
    """Try damaged real tables, `number` in all; one outcome for each format. Raises `RecordingError` where there are none."""
    given = os.environ.get("TAGJAX_REAL_DATA")
    tables = real_tables(Path(given)) if given else {}
    if not tables:
        raise RecordingError(
            f"found no table of reads in TAGJAX_REAL_DATA={given}; expected a folder with rfid/*/*.csv. Set it, or leave out "
            "real_tables."
        )
    rng = random.Random(seed)
    found = []
    for _ in range(number):
        lines = tables[rng.choice(list(tables))]
        chosen = recognise(lines)
        assert chosen is not None
        content = damaged_table(lines, 1, rng)
        found.append(outcome(f"real tables, {chosen.name}", [fault_of(chosen.name, content, None, folder)]))
    return joined(found)
