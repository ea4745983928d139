"""Plots: scores of lines (Fig. 6), matching by time observed, tracking errors. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped

from ...report.figure import blank, save_figure


def line_plot(
    path: Path,
    line_m: Float[np.ndarray, " lines"],
    panels: Sequence[tuple[str, Float[np.ndarray, " lines"], Float[np.ndarray, " lines"]]],
    true_m: float = 0.0,
) -> None:
    """Normalised score of every line, one panel per case: (title, one round, mean of all rounds)."""
    columns = min(3, len(panels))
    rows = -(-len(panels) // columns)
    figure = blank(4.3 * columns, 2.9 * rows)
    grid = np.atleast_1d(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axes, (title, one, mean) in zip(grid, panels, strict=False):
        axes.axvline(true_m * 1e3, color="tab:red", linewidth=0.8, alpha=0.6)
        axes.plot(line_m * 1e3, one, color="0.65", linewidth=0.8, label="one round")
        axes.plot(line_m * 1e3, mean, color="tab:blue", linewidth=1.4, label="mean of all rounds")
        axes.axhline(0.075, color="0.3", linewidth=0.7, linestyle=":")
        axes.set(title=title, ylim=(0, 1.05), xlabel="line at x (mm); red: the tag's", ylabel="score / maximum")
        axes.title.set_fontsize(9)
        axes.grid(alpha=0.3)
    grid[0].legend(loc="upper right", fontsize=7)
    for axes in grid[len(panels) :]:
        axes.set_visible(False)
    save_figure(figure, path, dpi=110)


def matching_plot(path: Path, matched: Mapping[str, Mapping[float, float]], *, target: float = 0.98) -> None:
    """Fraction of tags matched to the right object against the time observed, one line per setting."""
    figure = blank(5.5, 3.4)
    axes = figure.subplots()
    for name, line in matched.items():
        axes.plot(list(line), list(line.values()), marker="o", markersize=4, linewidth=1.4, label=name)
    axes.axhline(target, color="0.3", linewidth=0.8, linestyle=":", label=f"the paper's {target:g}")
    axes.set(xlabel="observed for (s)", ylabel="tags matched to the right object", ylim=(0, 1.03))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
    save_figure(figure, path, dpi=110)


def error_plot(
    path: Path, errors_mm: Mapping[str, Shaped[np.ndarray, " values"]], *, target_mm: float | None = None
) -> None:
    """Cumulative distribution of errors, one line per kind."""
    figure = blank(5.5, 3.4)
    axes = figure.subplots()
    limit = 1.0
    for name, values in errors_mm.items():
        if not len(values):
            continue
        ordered = np.sort(np.asarray(values, np.float64))
        fraction = np.arange(1, len(ordered) + 1) / len(ordered)
        axes.plot(ordered, fraction, linewidth=1.4, label=f"{name} (mean {ordered.mean():.2f} mm)")
        limit = max(limit, float(np.quantile(ordered, 0.99)))
    if target_mm is not None:
        axes.axvline(target_mm, color="0.3", linewidth=0.8, linestyle=":", label=f"the paper's mean {target_mm:g} mm")
    axes.set(xlabel="error (mm)", ylabel="fraction of frames", xlim=(0, 1.3 * limit), ylim=(0, 1.01))
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8, loc="lower right")
    save_figure(figure, path, dpi=110)
