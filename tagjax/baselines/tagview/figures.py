"""Plots: R^2 and slope (Fig. 8), accuracy by number of tags (Fig. 10), tracks (Fig. 7). Needs matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Shaped
from matplotlib.axes import Axes

from ...report.figure import blank, save_figure
from ..boxes import box_centre_px
from .experiment.scoring import RecordingScore

PAPER_ACCURACY = {2: 0.99, 6: 0.96}
"""Fig. 10: the two values that the text gives."""


def pair_plot(path: Path, scores: Sequence[RecordingScore]) -> None:
    """Box plots of R^2 and slope of correct and incorrect pairs; the slopes that do not fit into the panel are counted there."""
    figure = blank(7.0, 3.6)
    both = figure.subplots(1, 2)
    for axes, kind, label in zip(both, ("r_squared", "slope"), ("R$^2$", "slope / (4$\\pi$h/$\\lambda$)"), strict=True):
        rows = np.concatenate([getattr(one, kind) for one in scores] or [np.zeros((2, 0))], axis=1)
        parts = [rows[0, rows[1] == 1], rows[0, rows[1] == 0]]
        axes.boxplot([part if len(part) else [np.nan] for part in parts], widths=0.5, flierprops={"markersize": 3})
        axes.set_xticks([1, 2], [f"correct ({len(parts[0])})", f"incorrect ({len(parts[1])})"])
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    bottom, top = -3.0, 4.0
    both[1].set_ylim(bottom, top)
    slopes = np.concatenate([one.slope[0] for one in scores] or [np.zeros(0)])
    if outside := int(np.sum((slopes < bottom) | (slopes > top))):
        text = f"{outside} of {len(slopes)} slopes lie outside"
        both[1].annotate(text, (0.02, 0.02), xycoords="axes fraction", fontsize=8)
    save_figure(figure, path, dpi=110)


def accuracy_plot(path: Path, accuracy: Mapping[str, Mapping[int, float]]) -> None:
    """Accuracy by number of tags, one line per setting, slightly shifted so that equal ones are visible, and the
    paper's.
    """
    figure = blank(5.5, 4.0)
    axes: Axes = figure.subplots()
    for number, (name, values) in enumerate(accuracy.items()):
        counts = np.array(sorted(values))
        shift = 0.04 * (number - (len(accuracy) - 1) / 2)
        axes.plot(
            counts + shift, [values[count] for count in counts.tolist()], "o-", label=name, alpha=0.8, markersize=4
        )
    axes.set_xticks(sorted({count for values in accuracy.values() for count in values} | set(PAPER_ACCURACY)))
    axes.plot(list(PAPER_ACCURACY), list(PAPER_ACCURACY.values()), "k+--", markersize=10, label="the paper's Tagview")
    axes.set(xlabel="tags", ylabel="identification accuracy", ylim=(-0.02, 1.05))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path, dpi=110)


def track_plot(
    path: Path,
    name: str,
    truth_px: Shaped[np.ndarray, "objects frames 4"],
    box_px: Shaped[np.ndarray, "traces frames 4"],
    picture: Shaped[np.ndarray, "height width 3"],
) -> None:
    """True centres (black +) and those of the traces (green o) over a picture, every third frame (Fig. 7)."""
    figure = blank(7.0, 6.0)
    axes: Axes = figure.subplots()
    axes.imshow(picture)
    true, found = (box_centre_px(boxes[:, ::3]).reshape(-1, 2) for boxes in (truth_px, box_px))
    axes.scatter(true[:, 0], true[:, 1], s=28, linewidths=0.9, marker="+", color="k")
    axes.scatter(found[:, 0], found[:, 1], s=28, linewidths=0.9, marker="o", facecolors="none", edgecolors="lime")
    axes.set(title=f"{name}: truth +, traces o")
    axes.set_axis_off()
    save_figure(figure, path, dpi=110)
