"""Estimates with their intervals: rows of markers, and groups of horizontal bars. Needs the viz extra."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..metrics.interval import Estimate
from .figure import blank, save_figure

_MARKERS = "osD^vP"
_ROW_IN = 0.24
_HEADING_IN = 0.34
_INTERVAL: dict[str, Any] = {"elinewidth": 1.1, "capsize": 2.0, "capthick": 1.1}


@dataclasses.dataclass(frozen=True)
class MarkedRow:
    """A row of `marker_plot`: its label, and a value by series, with an interval where it is an estimate."""

    label: str
    values: Mapping[str, Estimate | float | None]
    heading: bool = False  # larger, and apart from what comes before


def marker_plot(path: Path, rows: Sequence[MarkedRow], *, xlabel: str) -> None:
    """Write a figure with a row for each label and a marker for each series, from 0 to 1; intervals are lines."""
    series = list(dict.fromkeys(name for row in rows for name in row.values))
    heights = np.array([_HEADING_IN if row.heading else _ROW_IN for row in rows])
    at = np.cumsum(heights) - 0.5 * heights
    figure = blank(7.6, float(heights.sum()) + 1.1)
    axes = figure.subplots()
    shifts = np.linspace(-0.3, 0.3, len(series)) if len(series) > 1 else np.zeros(1)
    for number, name in enumerate(series):
        places, values, low, high = [], [], [], []
        for row, place, height in zip(rows, at, heights, strict=True):
            value, *ends = _with_ends(row.values.get(name))
            places.append(place + shifts[number] * height)
            values.append(value)
            low.append(ends[0])
            high.append(ends[1])
        x, y = np.array(values), np.array(places)
        errors = np.stack([x - np.array(low), np.array(high) - x])  # NaN, and not drawn, without an interval
        marker = _MARKERS[number % len(_MARKERS)]
        axes.errorbar(x, y, xerr=errors, fmt=marker, markersize=4, label=name, clip_on=False, **_INTERVAL)
    for place, height, row in zip(at, heights, rows, strict=True):
        if row.heading:
            axes.axhspan(place - 0.5 * height, place + 0.5 * height, color="0.94", zorder=0)
    axes.set_yticks(at, [row.label for row in rows], fontsize=8)
    axes.set(xlim=(0, 1), ylim=(float(heights.sum()), 0), xlabel=xlabel)
    axes.grid(axis="x", alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside upper center", ncols=min(len(series), 2), fontsize=8, frameon=False)
    save_figure(figure, path, dpi=120)


def interval_bars(
    path: Path, panels: Mapping[str, Mapping[str, Mapping[str, Estimate]]], *, columns: int, ylabel: str = ""
) -> None:
    """Write a figure of panels, row by row: a group of horizontal bars a label, one bar a series, from 0 to 1.

    `panels` maps a title to the estimates by series and label. A dotted line goes on from each series' first bar, and a
    cross stands for an undefined value.
    """
    first = next(iter(panels.values()))
    series, labels = list(first), list(next(iter(first.values())))
    rows = -(-len(panels) // columns)
    inches = 0.17 * len(labels) * len(series) + 0.12 * len(labels) + 0.75
    figure = blank(1.7 + 2.5 * columns, rows * inches + 0.5)
    grid = figure.subplots(rows, columns, sharey=True, sharex=True, squeeze=False)
    thick = 0.8 / len(series)
    for axes, (title, by_series) in zip(grid.ravel(), panels.items(), strict=False):
        for number, name in enumerate(series):
            at = np.arange(len(labels)) + (number - (len(series) - 1) / 2) * thick
            value, low, high = np.array([_with_ends(by_series.get(name, {}).get(label)) for label in labels]).T
            errors = np.stack([value - low, high - value])  # NaN, and not drawn, without an interval
            bars = axes.barh(at, np.nan_to_num(value), 0.9 * thick, xerr=errors, label=name, error_kw=_INTERVAL)
            if np.isfinite(value[0]):
                axes.axvline(value[0], color=bars.patches[0].get_facecolor(), linestyle=":", linewidth=1.0, zorder=0)
            axes.plot(np.full(np.isnan(value).sum(), 0.02), at[np.isnan(value)], "x", color="0.5", markersize=5)
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_xlim(0, 1)
        axes.grid(axis="x", alpha=0.3)
        axes.set_axisbelow(True)
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid.ravel()[len(panels) :]:
        axes.set_axis_off()
    for axes in grid[:, 0]:
        axes.set_yticks(np.arange(len(labels)), labels)
        axes.set_ylabel(ylabel, fontsize=9)
    for axes in grid.ravel():
        axes.tick_params(labelsize=8)
    grid[0, 0].invert_yaxis()
    if len(series) > 1:
        handles, names = grid[0, 0].get_legend_handles_labels()
        figure.legend(handles, names, loc="outside upper center", ncols=len(series), fontsize=9, frameon=False)
    save_figure(figure, path, dpi=120)


def _with_ends(value: Estimate | float | None) -> tuple[float, float, float]:
    """A value and the ends of its interval; NaN where there is none."""
    if isinstance(value, Estimate):
        numbers = (value.value, value.low, value.high)
        return tuple(np.nan if one is None else one for one in numbers)  # type: ignore[return-value]
    return (np.nan if value is None else value, np.nan, np.nan)
