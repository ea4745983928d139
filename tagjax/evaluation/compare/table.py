"""Results by suite and system, and their table as Markdown and CSV."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from ...core.results import markdown_table, write_csv

MEASURES = ("identification", "iou", "cle_px", "error_mm", "p_d", "p_fa", "ms_a_frame")
HEADINGS = ("identification", "box IoU", "CLE, px", "error, mm", "P_D", "P_FA", "ms a frame")
SHORT_HEADINGS = ("ident", "IoU", "CLE", "error", "P_D", "P_FA", "ms")
"""Short headings for a terminal of 80 columns."""

LEGEND = (
    "identification, box IoU, CLE (px of a picture 512 wide): over frames in which the tagged object has moved and is visible.",
    "error: median distance in mm between the estimated position and the tag. P_D: fraction of those frames with a "
    "detection, right or wrong; P_FA: fraction of all frames with a detection of a stationary tag. ms: per frame.",
    "The papers' results are measured on their own recordings, and are other quantities: matching, accuracy, precision and "
    "recall of whole tracks or traces; TagVision's error is the mean distance from the centre of the tracked object; P_D and "
    "P_FA of Goller et al. are fractions of tags with an alarm. experiments.tagvision, experiments.tagview and "
    "experiments.goller measure those.",
)
"""The meaning of the columns, and how the papers' quantities differ."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """The results of one system on one suite; `reason` explains missing results. None stands for an undefined value.

    identification, iou, cle_px: over frames in which the tagged object has moved and is visible (`ScoreSettings`).
    error_mm: median distance between the estimated position and the tag. p_d: fraction of those frames with a detection.
    p_fa: fraction of all frames with a detection of a tag that never moves, labelled or not. ms_a_frame: time of a frame,
    with detection, radio and decision.
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
    settings: str | None = None  # name of the system's settings, where it has several
    paper: str | None = None  # result of the system's paper on similar recordings

    @property
    def name(self) -> str:
        """The system, and its settings where it has several."""
        return self.system if self.settings is None else f"{self.system} ({self.settings})"


def format_value(value: float | None, measure: str) -> str:
    """A measure as the tables show it."""
    if value is None:
        return "-"
    return f"{value:.0f}" if measure in ("error_mm", "ms_a_frame", "cle_px") else f"{value:.3f}"


def markdown(cells: Sequence[Cell]) -> str:
    """The table with one row per suite and system and the papers' results in a separate column; the legend below."""
    rows = []
    for cell in cells:
        values = [format_value(getattr(cell, measure), measure) for measure in MEASURES]
        if cell.reason is not None:
            values = [f"does not apply: {cell.reason}", *[""] * (len(MEASURES) - 1)]
        rows.append([f"`{cell.suite}`", cell.name, *values, cell.num_recordings or "", cell.paper or ""])
    table = markdown_table(["suite", "system", *HEADINGS, "recordings", "the paper's result"], rows)
    return "\n".join([table, "", "\n\n".join(LEGEND)])


def write_cells(path: Path, cells: Sequence[Cell]) -> None:
    """Write all cells as CSV, one row each."""
    names = [field.name for field in dataclasses.fields(Cell)]
    write_csv(path, names, ([getattr(cell, name) for name in names] for cell in cells))


def bars(cells: Sequence[Cell], measure: str) -> dict[str, dict[str, float | None]]:
    """One measure by system and suite."""
    values: dict[str, dict[str, float | None]] = {}
    for cell in cells:
        values.setdefault(cell.system, {})[cell.suite] = getattr(cell, measure)
    return values
