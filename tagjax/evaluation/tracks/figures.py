"""Accuracy of association scores against window length, and speeds of real tags. Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...report.figure import blank, save_figure

if TYPE_CHECKING:
    from .real_tags import Association


def accuracy_plot(path: Path, rows: Sequence[Mapping[str, Any]], methods: Sequence[str]) -> None:
    """A panel for each scene, a line for each method; `rows` are those of `tagjax.evaluation.tracks.run_tracks`."""
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
    save_figure(figure, path, dpi=110)


def speeds_plot(path: Path, associations: Sequence[Association]) -> None:
    """A panel for each recording: the tag's speed, scaled to its carrier's, and the speeds of its own tracks towards the antenna."""
    figure = blank(11.0, 2.4 * max(len(associations), 1))
    for axes, one in zip(np.atleast_1d(figure.subplots(max(len(associations), 1), 1)), associations, strict=False):
        carrier = one.alignments[one.carrier]
        for number, (walk, each) in enumerate(zip(one.tagged.walks, one.alignments, strict=False)):
            label = f"track {walk.name[-4:]}, correlation {each.correlation:.2f}"
            style = "-" if number == one.carrier else ":"
            axes.plot(walk.time_s, walk.towards_m_s(each.antenna_m), style, label=label, linewidth=1.2)
        measured = one.measured_m_s() / (carrier.slope or 1.0)
        axes.plot(
            one.tagged.walks[one.carrier].time_s,
            measured,
            "k.",
            markersize=2.5,
            label=f"tag, measured speed / {carrier.slope:.2f}",
        )
        axes.set_title(f"{one.tagged.name}: clocks {carrier.lag_s:.1f} s apart", fontsize=9, loc="left")
        axes.set_ylabel("towards antenna (m/s)", fontsize=8)
        axes.grid(alpha=0.3)
        axes.legend(fontsize=7, loc="lower right", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.1, ncols=3)
    if associations:
        figure.axes[-1].set_xlabel("time (s)")
    save_figure(figure, path, dpi=110)
