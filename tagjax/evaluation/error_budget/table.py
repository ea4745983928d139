"""Results of error budgets, and their tables for Markdown and the terminal."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

from rich.table import Table

from ...core.results import markdown_table
from ...metrics.interval import Estimate
from ..estimate_text import console_estimates, estimate_text

MEASURES = {"iou": "box IoU", "mask_j": "mask J", "identification": "identified"}
"""The scores of a budget, with their headings."""

LEGEND = (
    "Truth in place of: flow, the estimated optical flow; radio, the reads and the distances estimated from them; segments, "
    "the groups of pixels over which the tracer pools; cut, the threshold of the mask, chosen in each frame. Means over the "
    "frames since each tag's first motion in which its object is visible; square brackets: 95 % interval by recording."
)


@dataclasses.dataclass(frozen=True)
class BudgetRow:
    """One tracer on one suite with truth in some places (`none`, the name of a swap, or `all`); estimates by measure."""

    suite: str
    tracer: str
    truth: str
    estimates: Mapping[str, Estimate]


def markdown(rows: Sequence[BudgetRow]) -> str:
    """One row for each tracer and truth, columns for each suite and measure; the legend below."""
    suites = list(dict.fromkeys(row.suite for row in rows))
    by_key = {(row.tracer, row.truth, row.suite): row for row in rows}
    header = ["tracer", "truth in place of", *(f"`{suite}`: {name}" for suite in suites for name in MEASURES.values())]
    lines = []
    for tracer, truth in dict.fromkeys((row.tracer, row.truth) for row in rows):
        found = [by_key.get((tracer, truth, suite)) for suite in suites]
        cells = [None if one is None else estimate_text(one.estimates[name]) for one in found for name in MEASURES]
        lines.append([tracer, truth, *cells])
    counts = ", ".join(
        f"`{suite}` {next(row.estimates['iou'].num_recordings for row in rows if row.suite == suite)}"
        for suite in suites
    )
    return "\n\n".join([markdown_table(header, lines), f"{LEGEND} Recordings: {counts}."])


def console_table(rows: Sequence[BudgetRow]) -> Table:
    """The table for a terminal, with the legend below."""
    labelled = (((row.suite, row.tracer, row.truth), row.estimates) for row in rows)
    return console_estimates(("suite", "tracer", "truth"), MEASURES, labelled, LEGEND)
