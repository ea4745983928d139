"""Pictures of a sweep: IoU against frame number as TagAttention's Fig. 17, and by parameter. Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from ..metrics.interval import Estimate
from .figure import blank, save_figure

_WIDE = 20.0  # the axis is logarithmic where the largest value is more than so many times the smallest


def value_text(value: int | float | str | bool) -> str:
    """A parameter's value as text."""
    return str(value) if isinstance(value, str | bool) else f"{value:.6g}"


def curve_panels(path: Path, curves: Mapping[str, Mapping[str, Float[np.ndarray, " time"]]]) -> None:
    """Write a PNG with a panel for each condition: mean box IoU against frame number, one line a point."""
    columns = min(2, len(curves))
    rows = -(-len(curves) // columns)
    figure = blank(5.5 * columns, 3.2 * rows + 0.5)
    panels = np.atleast_1d(figure.subplots(rows, columns, sharey=True, squeeze=False)).ravel()
    for axes, (condition, lines) in zip(panels, curves.items(), strict=False):
        for name, iou in lines.items():
            axes.plot(np.arange(len(iou)), iou, label=name, linewidth=1.4)
        axes.set(title=condition, xlabel="frame number", ylim=(-0.02, 1.02))
        axes.grid(alpha=0.3)
    for axes in panels[len(curves) :]:
        axes.set_axis_off()
    panels[0].set_ylabel("box IoU")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=9)
    save_figure(figure, path, dpi=120)


def parameter_panels(path: Path, best: Mapping[str, Mapping[int | float | str | bool, float]]) -> None:
    """Write a PNG with a panel for each parameter: the best mean box IoU over all points with each of its values."""
    figure = blank(3.6 * len(best), 3.2)
    panels = figure.subplots(1, len(best), sharey=True, squeeze=False)[0]
    for axes, (name, values) in zip(panels, best.items(), strict=True):
        words = any(isinstance(value, str) for value in values)
        at = sorted(values, key=str if words else None)
        axes.plot(range(len(at)), [values[value] for value in at], "o-", linewidth=1.4)
        axes.set_xticks(range(len(at)), [value_text(value) for value in at])
        axes.set(xlabel=name)
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("best mean box IoU")
    save_figure(figure, path, dpi=120)


def one_at_a_time_panels(
    path: Path,
    against_best: Mapping[str, Mapping[Any, Estimate]],
    own: Mapping[str, Any],
    ways: Mapping[str, Sequence[tuple[float, float]]],
    *,
    best_iou: float,
) -> None:
    """Write a PNG with a panel for each parameter: box IoU at its values, the others being the tracer's own.

    The dashed line is the best point of all. A bar is the interval of a point's difference from it; where the bar reaches the
    line, the point may be as good. Arrows at the bottom lead from the values with which runs began to those that they learned.
    """
    columns = min(2, len(against_best))
    rows = -(-len(against_best) // columns)
    figure = blank(4.2 * columns, 3.1 * rows)
    grid = figure.subplots(rows, columns, sharey=True, squeeze=False)
    panels = grid.ravel()
    for axes in panels[len(against_best) :]:
        axes.set_axis_off()
    for axes, (name, found) in zip(panels, against_best.items(), strict=False):
        words = any(isinstance(value, str | bool) for value in found)
        values = sorted(found, key=str if words else None)
        at = np.arange(len(values)) if words else np.array(values, float)
        iou = best_iou + np.array([found[value].value or 0.0 for value in values])
        low, high = (
            best_iou + np.array([np.nan if end is None else end for end in ends])
            for ends in ([found[value].low for value in values], [found[value].high for value in values])
        )
        errors = np.nan_to_num(np.stack([iou - low, high - iou]))
        axes.errorbar(at, iou, yerr=np.maximum(errors, 0.0), fmt="o-", markersize=4, linewidth=1.2, capsize=2.5)
        axes.axhline(best_iou, color="0.4", linestyle="--", linewidth=1)
        if words:
            axes.set_xticks(at, [value_text(value) for value in values])
        elif at.min() > 0 and at.max() / at.min() > _WIDE:
            axes.set_xscale("log")
        bottom = axes.get_xaxis_transform()
        for number, (begun, ended) in enumerate(ways.get(name, ())):
            height = 0.05 + 0.05 * number
            colour = f"C{number + 1}"
            axes.annotate(
                "", (ended, height), (begun, height), xycoords=bottom, textcoords=bottom,
                arrowprops={"arrowstyle": "->", "color": colour, "shrinkA": 0, "shrinkB": 0},
            )  # fmt: skip
            axes.plot([begun], [height], "o", color=colour, fillstyle="none", markersize=5, transform=bottom)
        if not words:
            axes.axvline(float(own[name]), color="0.8", linewidth=1, zorder=0)
        axes.set(xlabel=name)
        axes.grid(alpha=0.3)
    if any(ways.values()):  # room for the arrows
        low, high = panels[0].get_ylim()
        panels[0].set_yticks([tick for tick in panels[0].get_yticks() if max(low, 0.0) <= tick <= high])
        panels[0].set_ylim(low - 0.25 * (high - low), high)
    for axes in grid[:, 0]:
        axes.set_ylabel("box IoU")
    save_figure(figure, path, dpi=120)
