"""One cell a suite and system, and the table of them as Markdown and CSV."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

MEASURES = ("identification", "iou", "cle_px", "error_mm", "p_d", "p_fa", "ms_a_frame")
HEADS = ("identification", "box IoU", "CLE, px", "error, mm", "P_D", "P_FA", "ms a frame")


@dataclasses.dataclass(frozen=True)
class Cell:
    """What one system reached on one suite; `reason` says why there is nothing. None is what cannot be said.

    identification, iou, cle_px: over frames in which the tagged thing has moved and shows (`ScoreSettings`).
    error_mm: median distance of the claimed place and the tag. p_d: share of those frames with any claim. p_fa: share
    of all frames with any claim of a tag that never moves, labelled or not. ms_a_frame: detection, radio and decision together.
    """

    suite: str
    system: str
    num_recordings: int = 0
    num_frames: int = 0
    identification: float | None = None
    iou: float | None = None
    cle_px: float | None = None
    error_mm: float | None = None
    p_d: float | None = None
    p_fa: float | None = None
    ms_a_frame: float | None = None
    reason: str | None = None
    settings: str | None = None  # which of several the system took

    @property
    def name(self) -> str:
        """The system, and its settings where it has several."""
        return self.system if self.settings is None else f"{self.system} ({self.settings})"


def said(value: float | None, measure: str) -> str:
    """A measure as the tables show it."""
    if value is None:
        return "-"
    return f"{value:.0f}" if measure in ("error_mm", "ms_a_frame", "cle_px") else f"{value:.3f}"


def markdown(cells: Sequence[Cell], papers: Mapping[str, str]) -> str:
    """The table: a row a suite and system, the papers' own figures in a column of their own."""
    lines = [
        "| suite | system | " + " | ".join(HEADS) + " | recordings | the paper's own |",
        "|" + "---|" * (len(HEADS) + 4),
    ]
    shown: set[str] = set()
    for cell in cells:
        paper = "" if cell.suite in shown else papers.get(cell.suite, "")
        shown.add(cell.suite)
        if cell.reason is None:
            values = " | ".join(said(getattr(cell, measure), measure) for measure in MEASURES)
        else:
            values = f"does not apply: {cell.reason}" + " |" * (len(HEADS) - 1)
        lines.append(f"| `{cell.suite}` | {cell.name} | {values} | {cell.num_recordings or ''} | {paper} |")
    return "\n".join(lines)


def write_csv(path: Path, cells: Sequence[Cell]) -> None:
    """All cells, one row each."""
    names = [field.name for field in dataclasses.fields(Cell)]
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(names)
        for cell in cells:
            values = (getattr(cell, name) for name in names)
            rows.writerow("" if value is None else value for value in values)


def bars(cells: Sequence[Cell], measure: str) -> dict[str, dict[str, float | None]]:
    """One measure by system and suite."""
    found: dict[str, dict[str, float | None]] = {}
    for cell in cells:
        found.setdefault(cell.system, {})[cell.suite] = getattr(cell, measure)
    return found
