"""Results of the reads' ceiling, and their tables for Markdown and the terminal."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from rich.table import Table

from ...core.results import markdown_table
from ...metrics.interval import Estimate
from ...metrics.tags import CLEAR, CLEAR_LINE_OF_SIGHT, CLEAR_READS
from ..estimate_text import console_estimates, estimate_text
from .candidates import Memory

HEADINGS = {
    "identification": "all tags",
    f"{CLEAR}identification": "clearly read",
    "iou": "box IoU, all tags",
}

LEGEND = (
    "Fraction of frames, from each tag's first motion while its object is visible, in which the tag's own true distance "
    "explains its reads best among the true distances of all tags of the recording; no tracer can identify more by reads "
    f"alone. Clearly read: frames with at least {CLEAR_READS} reads in the last second and a line of sight of at least "
    f"{CLEAR_LINE_OF_SIGHT:g}. Box IoU: with the true box of the winner. Square brackets: 95 % interval by recording."
)


@dataclasses.dataclass(frozen=True)
class Row:
    """The ceiling of one suite with one memory; estimates by measure."""

    suite: str
    memory: Memory
    estimates: Mapping[str, Estimate]


@dataclasses.dataclass(frozen=True)
class TagRow:
    """One tag of one recording: its ceilings in the order of the memories, and how it was read at the frames that count."""

    suite: str
    recording: str
    epc: str
    num_frames: int
    identified: tuple[float, ...]
    reads_1s: float | None
    rssi_dbm: float | None
    line_of_sight: float | None
    clearly_read: float | None

    @property
    def text(self) -> str:
        """The tag as the figure names it."""
        sight = "?" if self.line_of_sight is None else f"{self.line_of_sight:.2f}"
        return f"{self.recording.removeprefix(f'{self.suite}-')} tag {self.epc[-2:]}: {self.reads_1s or 0:.0f}, {sight}"


def markdown(rows: Sequence[Row], tags: Sequence[TagRow]) -> str:
    """Two tables: suites by memory, and every tag; the legend between them."""
    memories = list(dict.fromkeys(row.memory for row in rows))
    whole = markdown_table(
        ["suite", "memory", "offsets", *HEADINGS.values(), "recordings"],
        (
            [
                f"`{row.suite}`",
                row.memory.seconds_text,
                row.memory.offsets_text,
                *(estimate_text(row.estimates[name]) for name in HEADINGS),
                row.estimates["identification"].num_recordings,
            ]
            for row in rows
        ),
    )
    each = markdown_table(
        [
            "recording",
            "tag",
            "frames",
            "reads in 1 s",
            "RSSI, dBm",
            "line of sight",
            "clearly read",
            *(one.text for one in memories),
        ],
        (
            [
                tag.recording,
                tag.epc,
                tag.num_frames,
                *(_number(tag.reads_1s, 0), _number(tag.rssi_dbm, 0), _number(tag.line_of_sight, 2)),
                _number(tag.clearly_read, 2),
                *(f"{value:.2f}" for value in tag.identified),
            ]
            for tag in tags
        ),
    )
    return "\n\n".join([whole, LEGEND, each])


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def console_table(rows: Sequence[Row]) -> Table:
    """The table of suites for a terminal, with the legend below."""
    labelled = (((row.suite, row.memory.seconds_text, row.memory.offsets_text), row.estimates) for row in rows)
    return console_estimates(("suite", "memory", "offsets"), HEADINGS, labelled, LEGEND)
