"""Bars of several systems on several suites. Needs viz."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from matplotlib.lines import Line2D

from .figure import blank, save_figure

_ENTRY_IN = 1.5
"""Width of an entry of the legend, inches."""


def bar_plot(path: Path, panels: Mapping[str, Mapping[str, Mapping[str, float | None]]]) -> None:
    """A panel a measure: its value by system and suite, 0 to 1; a cross where there is none."""
    by_system = next(iter(panels.values()))
    systems, suites = list(by_system), list(dict.fromkeys(suite for row in by_system.values() for suite in row))
    inches = max(5.5, 1.5 * len(suites) + 2.0)
    figure = blank(inches, 2.4 * len(panels) + 0.6)
    grid = np.atleast_1d(figure.subplots(len(panels), 1, sharex=True))
    width = 0.8 / len(systems)
    for axes, (measure, values) in zip(grid, panels.items(), strict=True):
        for number, system in enumerate(systems):
            at = np.arange(len(suites)) + (number - (len(systems) - 1) / 2) * width
            heights = np.array(
                [np.nan if values[system].get(suite) is None else values[system][suite] for suite in suites], float
            )
            drawn = axes.bar(at, np.nan_to_num(heights), 0.9 * width, label=system.replace("_", " "))
            axes.plot(
                at[np.isnan(heights)],
                np.full(np.isnan(heights).sum(), 0.03),
                "x",
                color=drawn.patches[0].get_facecolor(),
            )
        axes.set(ylim=(0, 1.02), ylabel=measure)
        axes.grid(axis="y", alpha=0.3)
        axes.set_axisbelow(True)
    grid[-1].set_xticks(np.arange(len(suites)), suites, rotation=20 if len(suites) > 4 else 0)
    handles, labels = grid[0].get_legend_handles_labels()
    cross = Line2D([], [], color="grey", marker="x", linestyle="none")
    figure.legend(
        [*handles, cross],
        [*labels, "does not apply"],
        loc="outside upper center",
        ncols=min(len(systems) + 1, int(inches / _ENTRY_IN)),
        fontsize=8,
    )
    save_figure(figure, path, dpi=120)
