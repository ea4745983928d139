"""Estimates with their intervals, as tables show them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from ..metrics.interval import Estimate


def estimate_text(estimate: Estimate, digits: int = 2) -> str:
    """`value [low, high]`; the value alone with one recording, and "-" for an undefined value."""
    if estimate.value is None:
        return "-"
    text = f"{estimate.value:.{digits}f}"
    if estimate.low is None or estimate.high is None:
        return text
    return f"{text} [{estimate.low:.{digits}f}, {estimate.high:.{digits}f}]"


def console_estimates(
    labels: Sequence[str],
    headings: Mapping[str, str],
    rows: Iterable[tuple[Sequence[str], Mapping[str, Estimate]]],
    legend: str,
) -> Table:
    """A table for a terminal: columns of labels, one column of estimates for each name in `headings`, the legend below."""
    table = Table(box=SIMPLE, show_edge=False, padding=0)
    for name in labels:
        table.add_column(name, no_wrap=True)
    for name in headings.values():
        table.add_column(name, justify="right")
    for texts, estimates in rows:
        table.add_row(*texts, *(estimate_text(estimates[name]) for name in headings))
    table.caption, table.caption_justify = Text(legend), "left"
    return table
