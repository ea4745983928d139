"""Pictures of a search over parameters: every trial as a line across them, and how much each matters. Needs the viz extra."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize

from .figure import blank, save_figure

_NUM_TICKS = 5


@dataclasses.dataclass(frozen=True)
class Trial:
    """A finished trial."""

    number: int
    value: float  # its score
    parameters: Mapping[str, Any]


def parallel_coordinates(
    path: Path, trials: Sequence[Trial], names: Sequence[str], logarithmic: Collection[str]
) -> None:
    """Write a PNG with an axis for each parameter and a line for each trial, coloured by score, the best on top."""
    figure = blank(max(5.5, 1.9 * len(names) + 1.5), 4.0)
    axes = figure.subplots()
    scores = np.array([one.value for one in trials])
    colour = ScalarMappable(Normalize(scores.min(), scores.max()), colormaps["viridis"])
    heights = {name: _heights(axes, number, name, trials, name in logarithmic) for number, name in enumerate(names)}
    for index in np.argsort(scores):
        line = [heights[name][index] for name in names]
        axes.plot(range(len(names)), line, color=colour.to_rgba(scores[index]), linewidth=1.3, alpha=0.85)
    axes.set_xlim(-0.1, len(names) - 1 + 0.4)
    axes.set_ylim(-0.03, 1.03)
    axes.set_xticks(range(len(names)), [name.replace(".", ".\n") for name in names], fontsize=8)
    axes.set_yticks([])
    axes.spines[["top", "right", "left", "bottom"]].set_visible(False)
    figure.colorbar(colour, ax=axes, label="score", pad=0.02)
    save_figure(figure, path, dpi=90)


def _heights(axes: Axes, at: int, name: str, trials: Sequence[Trial], logarithmic: bool) -> np.ndarray:
    """Where each trial's value lies on the parameter's axis, from 0 to 1, NaN without one; draws the axis with its ticks."""
    values = [one.parameters.get(name) for one in trials]
    known = [value for value in values if value is not None]
    if any(isinstance(value, str | bool) for value in known):
        words = sorted({str(value) for value in known})
        ticks = {word: index / max(len(words) - 1, 1) for index, word in enumerate(words)}
        heights = np.array([np.nan if value is None else ticks[str(value)] for value in values])
    else:
        scaled = np.array([np.nan if value is None else float(value) for value in values])
        scaled = np.log10(scaled) if logarithmic else scaled
        low, high = float(np.nanmin(scaled)), float(np.nanmax(scaled))
        span = high - low if high > low else 1.0
        heights = (scaled - low) / span
        marks = np.linspace(low, high, _NUM_TICKS if high > low else 1)
        ticks = {f"{10**mark if logarithmic else mark:.2g}": (mark - low) / span for mark in marks}
    axes.axvline(at, color="0.3", linewidth=1, zorder=3)
    for text, height in ticks.items():
        axes.annotate(
            text, (at, height), (4, 0), textcoords="offset points", fontsize=8, va="center", zorder=4,
            bbox={"boxstyle": "round,pad=0.1", "facecolor": "white", "edgecolor": "none", "alpha": 0.75},
        )  # fmt: skip
    return heights


def importance_bars(path: Path, importance: Mapping[str, float]) -> None:
    """Write a PNG with the share of each parameter in what the score varies by, the largest on top."""
    names = sorted(importance, key=lambda name: importance[name])
    figure = blank(6.5, 0.45 * len(names) + 1.1)
    axes = figure.subplots()
    bars = axes.barh(range(len(names)), [importance[name] for name in names], color="C0")
    axes.bar_label(bars, fmt="%.2f", padding=3, fontsize=8)
    axes.set_yticks(range(len(names)), names, fontsize=8)
    axes.set_xlim(0, 1.1 * max(importance.values()))
    axes.set_xlabel("importance (mean decrease in impurity)", fontsize=9)
    axes.spines[["top", "right"]].set_visible(False)
    save_figure(figure, path, dpi=120)
