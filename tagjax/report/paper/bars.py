"""Bars with intervals (Tagview, Figs. 9 and 11). Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...metrics.interval import Estimate
from .style import FONT, LINES, OTHER, TRUTH, save_small, sheet, tidy


def bar_figure(path: Path, bars: Mapping[str, Estimate], *, ylabel: str, reported: Mapping[str, float]) -> None:
    """A bar for each name from 0 to 1 with its interval by recording, how many of how many; the paper's values are lines."""
    figure = sheet(3.2)
    axes = figure.subplots()
    for number, (name, one) in enumerate(bars.items()):
        if one.value is None:
            continue
        axes.bar(number, one.value, width=0.6, color=LINES[number % len(LINES)], alpha=0.85)
        if one.low is not None and one.high is not None:
            ends = [[one.value - one.low], [one.high - one.value]]
            axes.errorbar(number, one.value, yerr=np.maximum(ends, 0.0), color=TRUTH, capsize=4, linewidth=1.2)
        text = f"{one.total:.0f} of {one.count}"
        axes.annotate(text, (number, 0.03), ha="center", fontsize=FONT, color="white", fontweight="bold")
        if name in reported:
            axes.plot([number - 0.4, number + 0.4], [reported[name]] * 2, "--", color=OTHER, linewidth=1.8)
    tidy(axes, ylabel=ylabel)
    axes.set_xticks(range(len(bars)), list(bars))
    axes.set_ylim(0, 1.06)
    if reported:
        axes.plot([], [], "--", color=OTHER, linewidth=1.8, label="the paper's")
        axes.legend(fontsize=FONT, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    save_small(figure, path)
