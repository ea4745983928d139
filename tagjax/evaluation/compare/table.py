"""One cell a suite and system, and the table of them as Markdown and CSV."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Sequence
from pathlib import Path

MEASURES = ("identification", "iou", "cle_px", "error_mm", "p_d", "p_fa", "ms_a_frame")
HEADS = ("identification", "box IoU", "CLE, px", "error, mm", "P_D", "P_FA", "ms a frame")
SHORT = ("ident", "IoU", "CLE", "error", "P_D", "P_FA", "ms")
"""The same where there is room for 80 columns: no wider than the figures below them."""

LEGEND = (
    "identification, box IoU, CLE (px of a picture 512 wide): of frames in which the tagged thing has moved and shows.",
    "error: median distance in mm of the claimed place and the tag. P_D: share of those frames with any claim, right or "
    "wrong; P_FA: share of all frames with any claim of a tag that lies still. ms: of a frame.",
    "The papers' own figures are of their own recordings, and of other quantities: matching, accuracy, precision and recall "
    "of whole tracks or traces, TagVision's error the mean from the middle of what is tracked, Goller et al.'s P_D and P_FA "
    "shares of tags that were alarmed. experiments.tagvision, experiments.tagview and experiments.goller measure those.",
)
"""What the columns are, and where the papers' quantities differ."""


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
    paper: str | None = None  # what the system's paper reports of such recordings

    @property
    def name(self) -> str:
        """The system, and its settings where it has several."""
        return self.system if self.settings is None else f"{self.system} ({self.settings})"


def said(value: float | None, measure: str) -> str:
    """A measure as the tables show it."""
    if value is None:
        return "-"
    return f"{value:.0f}" if measure in ("error_mm", "ms_a_frame", "cle_px") else f"{value:.3f}"


def markdown(cells: Sequence[Cell]) -> str:
    """The table: a row a suite and system, the papers' own figures in a column of their own; the legend below."""
    lines = [
        "| suite | system | " + " | ".join(HEADS) + " | recordings | the paper's own |",
        "|" + "---|" * (len(HEADS) + 4),
    ]
    for cell in cells:
        if cell.reason is None:
            values = " | ".join(said(getattr(cell, measure), measure) for measure in MEASURES)
        else:
            values = f"does not apply: {cell.reason}" + " |" * (len(HEADS) - 1)
        lines.append(f"| `{cell.suite}` | {cell.name} | {values} | {cell.num_recordings or ''} | {cell.paper or ''} |")
    return "\n".join([*lines, "", "\n\n".join(LEGEND)])


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
