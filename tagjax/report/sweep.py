"""Pictures of a sweep: IoU against frame number as TagAttention's Fig. 17, and by parameter. Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float

from .figure import blank, save_figure


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
