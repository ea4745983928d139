"""Figures of scores against the frames since the first motion: one panel a score and condition, one line a tracer."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool

from ...metrics.curves import Curve
from .style import DASHES, FONT, LINES, save_small, sheet, tidy

NUM_FRAMES = 90
"""Frames since the first motion that the paper's figures show."""

SCORES = {"iou": "box IoU", "cle_px": "CLE (px of 512)"}
"""The scores that are drawn, a row of panels each: box IoU (0 without a detection) and centre error over detections."""


@dataclasses.dataclass(frozen=True)
class Panel:
    """A column of panels: its title, and by line the curves of each score. Bands of many lines would hide each other."""

    title: str
    lines: Mapping[str, Mapping[str, Curve]]
    bands: bool = True


def shown(curve: Curve) -> Bool[np.ndarray, " frame"]:
    """Which frames up to `NUM_FRAMES` are drawn: those with half of the tags, or more, that the curve has at its fullest."""
    count = curve.num_tags[: NUM_FRAMES + 1]
    return (2 * count >= count.max(initial=0)) & (count > 0)


def _drawn(curve: Curve, kept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Frame numbers, means and bounds; NaN, a gap in the line, at frames that are not drawn."""
    mean, low, high = (np.where(kept, one[: len(kept)], np.nan) for one in (curve.mean, curve.low, curve.high))
    return np.arange(len(kept)), mean, low, high


def score_figure(path: Path, panels: Sequence[Panel], *, scores: Sequence[str] = ("iou", "cle_px")) -> None:
    """TagAttention, Figs. 10, 12, 14, 16, 17, 19: means with the 95 % band of the mean by recording, where there are several."""
    figure = sheet(2.15 * len(scores) + 0.45)
    grid = np.asarray(figure.subplots(len(scores), len(panels), sharex=True, sharey="row", squeeze=False))
    for column, panel in enumerate(panels):
        for row, score in enumerate(scores):
            axes = grid[row][column]
            for number, (name, by_score) in enumerate(panel.lines.items()):
                kept = shown(by_score[score])
                frame, mean, low, high = _drawn(by_score[score], kept)
                colour, dash = LINES[number % len(LINES)], DASHES[number % len(DASHES)]
                axes.plot(frame, mean, color=colour, linestyle=dash, linewidth=1.4, label=name)
                if panel.bands:
                    axes.fill_between(frame, low, high, color=colour, alpha=0.16, linewidth=0)
            tidy(axes, title=panel.title if row == 0 else "", ylabel=SCORES[score] if column == 0 else "")
            axes.set_xlim(0, NUM_FRAMES)
    for score, row in zip(scores, grid, strict=True):  # when all is drawn: panels of a row share their limits
        row[0].set_ylim(bottom=0, top=1.02 if score == "iou" else None)
    figure.supxlabel("frames since the first motion", fontsize=FONT)
    if all(list(panel.lines) == list(panels[0].lines) for panel in panels):
        handles = grid[0][0].get_legend_handles_labels()
        ncols = 2 if len(handles[0]) == 4 else 3
        figure.legend(*handles, loc="outside upper center", ncols=ncols, fontsize=FONT, frameon=False)
    else:
        for axes in grid[-1]:
            axes.legend(fontsize=FONT - 0.5, loc="upper right")
    save_small(figure, path)
