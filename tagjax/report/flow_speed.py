"""Accuracy of optical flows against the time that they take. Needs the viz extra."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes

from .figure import blank, save_figure

_NO_MOTION = "zero"


def error_by_time(path: Path, materials: Mapping[str, Mapping[str, Mapping[str, Any]]]) -> bool:
    """Write a PNG with a panel for each material, and a point for each of its flows: end-point error of moving pixels
    against the median time of a call. The line is the least error that can be had in a time.

    `materials` holds by name what `tagjax.evaluation.flow.evaluate_flows` returns under this key. A material without truth or
    without times is left out. Returns whether there was any to draw.
    """
    measured = {name: points for name, flows in materials.items() if (points := _points(flows))}
    if not measured:
        return False
    figure = blank(4.6 * len(measured) + 0.6, 4.2)
    for axes, (name, points) in zip(np.atleast_1d(figure.subplots(1, len(measured))), measured.items(), strict=True):
        _panel(axes, points)
        if (still := materials[name].get(_NO_MOTION)) is not None:
            error_px = still["all"]["epe_moving_px"]
            axes.set_ylim(top=max(axes.get_ylim()[1], 1.1 * error_px))
            axes.axhline(error_px, color="0.6", linestyle=":", linewidth=1)
            axes.annotate("no motion", (1, error_px), (-3, 3), xycoords=("axes fraction", "data"), textcoords="offset points",
                          ha="right", fontsize=8, color="0.4")  # fmt: skip
        axes.set_title(name, fontsize=10)
        axes.set_xlabel("median time of a call, ms", fontsize=9)
        axes.set_ylabel("end-point error of moving pixels, px", fontsize=9)
    save_figure(figure, path, dpi=110)
    return True


def _points(flows: Mapping[str, Mapping[str, Any]]) -> dict[str, tuple[float, float]]:
    """Time in ms and error in pixels by flow, of those that have both."""
    both = {name: (flow["all"].get("median_ms"), flow["all"].get("epe_moving_px")) for name, flow in flows.items()}
    return {name: pair for name, pair in both.items() if None not in pair and name != _NO_MOTION}  # pyright: ignore[reportReturnType]


def _panel(axes: Axes, points: Mapping[str, tuple[float, float]]) -> None:
    order = sorted(points, key=lambda name: points[name])
    ms, error_px = np.array([points[name] for name in order]).T
    best = np.minimum.accumulate(error_px)
    axes.step([*ms, ms[-1] * 1.6], [*best, best[-1]], where="post", color="0.75", linewidth=1.5, zorder=1)
    ahead = error_px == best
    axes.scatter(ms, error_px, c=np.where(ahead, "C0", "C1"), zorder=3)
    for name, at, error, first in zip(order, ms, error_px, ahead, strict=True):
        offset, side = ((-4, -11), "right") if first else ((5, 4), "left")
        axes.annotate(name, (at, error), offset, textcoords="offset points", ha=side, fontsize=8)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter("{x:g}")
    axes.set_xlim(ms[0] / 8, ms[-1] * 6)
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
