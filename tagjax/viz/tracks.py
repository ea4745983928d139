"""Accuracy of association scores against the length of the window that they see. Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .figure import blank


def accuracy_plot(path: Path, rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> None:
    """A panel for each scene, a line for each method; `rows` are those of `evaluation.tracks.run_tracks`."""
    names = list(dict.fromkeys(row["scene"] for row in rows))
    figure = blank(4.2 * max(len(names), 1), 3.4)
    for axes, name in zip(np.atleast_1d(figure.subplots(1, max(len(names), 1), sharey=True)), names, strict=False):
        mine = [row for row in rows if row["scene"] == name]
        length = [row["window_s"] for row in mine]
        for method in methods:
            axes.plot(length, [row["accuracy"][method] for row in mine], "o-", label=method, markersize=4)
        axes.plot(length, [row["chance"] for row in mine], "k:", label="chance")
        axes.set(
            xlabel="window (s)", ylim=(0, 1.03), xscale="log", xticks=length, xticklabels=[f"{s:g}" for s in length]
        )
        axes.set_title(name, fontsize=9)
        axes.minorticks_off()
        axes.grid(alpha=0.3)
    if names:
        figure.axes[0].set_ylabel("carrier has the highest score")
        figure.axes[0].legend(fontsize=7, loc="lower right")
    figure.savefig(path, dpi=110)
