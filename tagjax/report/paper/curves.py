"""Figures of scores against the frames since the first motion: one panel a score and condition, one line a tracer."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from ...metrics.curves import Curve
from .style import DASHES, FONT, LINES, save_small, sheet, tidy

NUM_FRAMES = 90
"""Frames since the first motion that the paper's figures show."""

SCORES = {"iou": "box IoU", "cle_px": "CLE (px of 512)"}
"""The scores that are drawn, a row of panels each: box IoU (0 without a detection) and centre error over detections."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """A column of panels: its title, and by line the curves of each score."""

    title: str
    lines: Mapping[str, Mapping[str, Curve]]


def shown(curve: Curve) -> np.ndarray:
    """The frames of a curve that are drawn: up to `NUM_FRAMES`, while half of the tags are left that it had at its fullest."""
    count = curve.num_tags[: NUM_FRAMES + 1]
    enough = 2 * count >= count.max(initial=0)
    return np.flatnonzero(enough & (count > 0))


def score_figure(path: Path, panels: Sequence[Panel], *, scores: Sequence[str] = ("iou", "cle_px")) -> None:
    """TagAttention, Figs. 10, 12, 14, 16, 17, 19: means with the 95 % band of the mean by recording, where there are several."""
    figure = sheet(2.15 * len(scores) + 0.45)
    grid = np.asarray(figure.subplots(len(scores), len(panels), sharex=True, sharey="row", squeeze=False))
    handles: dict[str, object] = {}
    order = list(dict.fromkeys(name for panel in panels for name in panel.lines))
    for column, panel in enumerate(panels):
        for row, score in enumerate(scores):
            axes = grid[row][column]
            for name, by_score in panel.lines.items():
                number = order.index(name)
                curve, at = by_score[score], shown(by_score[score])
                colour, dash = LINES[number % len(LINES)], DASHES[number % len(DASHES)]
                (line,) = axes.plot(at, curve.mean[at], color=colour, linestyle=dash, linewidth=1.4)
                handles.setdefault(name, line)
                axes.fill_between(at, curve.low[at], curve.high[at], color=colour, alpha=0.16, linewidth=0)
            tidy(axes, title=panel.title if row == 0 else "", ylabel=SCORES[score] if column == 0 else "")
            axes.set_xlim(0, NUM_FRAMES)
            axes.set_ylim(bottom=0, top=1.02 if score == "iou" else None)
            if row == len(scores) - 1:
                axes.set_xlabel("frames since the first motion", fontsize=FONT)
    figure.legend(
        list(handles.values()), list(handles), loc="outside upper center", ncols=3, fontsize=FONT, frameon=False
    )
    save_small(figure, path)
