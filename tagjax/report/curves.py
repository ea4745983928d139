"""Curves of scores against frame number (TagAttention, Figs. 12-15), one line a tracer. Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Shaped

from ..metrics.curves import Curve
from .figure import blank, save_figure


def score_curves(
    path: Path,
    lines: Mapping[str, Mapping[str, Shaped[np.ndarray, " time"]]],
    valid: Shaped[np.ndarray, " time"],
    *,
    first_frame: int = 0,
    title: str = "",
) -> None:
    """Write a PNG with IoU and centre error (CLE) of each tracer against frame number.

    `lines` maps a tracer's name to its `iou` and `cle_px`; frames that are not scored are shaded.
    """
    frame = first_frame + np.arange(len(valid))
    figure = blank(8.0, 5.0)
    upper, lower = figure.subplots(2, 1, sharex=True)
    for name, line in lines.items():
        upper.plot(frame, line["iou"], label=name, linewidth=1.4)
        lower.plot(frame, line["cle_px"], label=name, linewidth=1.4)
    for axes in (upper, lower):
        left_out = ~np.asarray(valid, dtype=bool)
        axes.fill_between(
            frame,
            0,
            1,
            where=left_out.tolist(),
            step="mid",
            color="0.9",
            transform=axes.get_xaxis_transform(),
            zorder=0,
        )
        axes.grid(alpha=0.3)
    upper.set(ylabel="box IoU", ylim=(-0.02, 1.02))
    upper.set_title(title, loc="left", fontsize=10)
    lower.set(ylabel="CLE (px of 512)", xlabel="frame number (shaded: not scored)")
    lower.set_ylim(bottom=0)
    upper.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8, ncols=4)  # beside the title
    save_figure(figure, path, dpi=110)


_PANELS = {"iou": "box IoU", "cle_px": "CLE (px of 512)", "identification": "identified"}


def band_curves(path: Path, curves: Mapping[str, Mapping[str, Curve]]) -> None:
    """Write a PNG with the scores of each tracer against frames since the first motion, with their bands by recording.

    A curve ends where less than half of the tags are left that it had at its fullest.
    """
    figure = blank(8.0, 6.5)
    panels = figure.subplots(len(_PANELS), 1, sharex=True)
    for axes, (score, label) in zip(panels, _PANELS.items(), strict=True):
        for tracer, by_score in curves.items():
            curve = by_score[score]
            enough = 2 * curve.num_tags >= curve.num_tags.max(initial=0)
            frame = np.arange(len(curve.mean))
            (line,) = axes.plot(frame, np.where(enough, curve.mean, np.nan), label=tracer, linewidth=1.4)
            axes.fill_between(
                frame, curve.low, curve.high, where=enough.tolist(), color=line.get_color(), alpha=0.18, linewidth=0
            )
        axes.grid(alpha=0.3)
        axes.set(ylabel=label)
        axes.set_ylim(bottom=0, top=None if score == "cle_px" else 1.02)
    banded = any(np.isfinite(curve.low).any() for by_score in curves.values() for curve in by_score.values())
    explained = " (band: 95 % interval of the mean, by recording)" if banded else ""  # one recording has no band
    panels[-1].set(xlabel=f"frames since the tag's first motion{explained}")
    panels[0].legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8, ncols=4)
    save_figure(figure, path, dpi=110)
