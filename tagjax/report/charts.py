"""Charts that grow with time, as pictures beside a video: each tag's phase, and the change of its distance. Needs viz."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Float64, UInt8
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine

from .overlay import PALETTE_RGB

_DPI = 100
_TEXT_PT = 8.0
_GREY = "0.45"
_PHASE_TICKS = ([0.0, np.pi, 2 * np.pi], ["0", "π", "2π"])


@dataclasses.dataclass(frozen=True)
class TagCurves:
    """What is drawn of a tag. Times are seconds since the first frame that is shown; `range_m` is NaN where nothing is known."""

    name: str
    read_s: Float64[np.ndarray, " reads"]
    phase_rad: Float64[np.ndarray, " reads"]
    range_m: Float64[np.ndarray, " frames"]  # distance of the mask's centre to the antenna
    true_range_m: Float64[np.ndarray, " frames"]  # of the tag

    def changes_m(self) -> tuple[Float64[np.ndarray, " frames"], Float64[np.ndarray, " frames"]]:
        """Both distances since the first frame that has one, of the mask and of the tag.

        The mask's centre is not the tag, so where the truth is known they are compared less the median of their difference.
        """
        difference = self.range_m - self.true_range_m
        if np.isfinite(difference).any():
            begin = self.true_range_m[np.isfinite(self.true_range_m)][0]
            return self.range_m - np.nanmedian(difference) - begin, self.true_range_m - begin
        found_m, true_m = (
            one - one[np.isfinite(one)][0] if np.isfinite(one).any() else one
            for one in (self.range_m, self.true_range_m)
        )
        return found_m, true_m


class GrowingCharts:
    """One chart of phase a tag, and one of all tags' change of distance; `drawn` gives their picture at a time."""

    def __init__(
        self, tags: Sequence[TagCurves], frame_s: Float[np.ndarray, " frames"], width: int, height: int
    ) -> None:
        self._tags, self._frame_s = tags, frame_s
        self._changes = [tag.changes_m() for tag in tags]
        layout = ConstrainedLayoutEngine(w_pad=0.08, h_pad=0.04, hspace=0.0)
        self._figure = Figure(figsize=(width / _DPI, height / _DPI), dpi=_DPI, layout=layout)
        self._canvas = FigureCanvasAgg(self._figure)
        *phases, distance = self._figure.subplots(
            len(tags) + 1, 1, sharex=True, height_ratios=[*[1.0] * len(tags), 2.4]
        )
        self._now = [axes.axvline(0.0, color=_GREY, linewidth=0.8) for axes in (*phases, distance)]
        self._points = [
            _phase_axes(axes, tag, _colour(n)) for n, (axes, tag) in enumerate(zip(phases, tags, strict=True))
        ]
        phases[0].set_title("phase of each read, rad", loc="left", pad=4.0, fontsize=_TEXT_PT)
        self._lines = _distance_axes(distance, self._changes)
        distance.set_xlim(0.0, 1.01 * max(float(frame_s[-1]), 1e-3))
        distance.set_xlabel("time, s", labelpad=1.0, fontsize=_TEXT_PT)
        self._figure.draw_without_rendering()
        self._figure.set_layout_engine("none")  # or the axes would move a little at each frame

    def drawn(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """The charts with all reads and distances until a frame, numbered from 0."""
        now_s = float(self._frame_s[frame])
        for line in self._now:
            line.set_xdata([now_s, now_s])
        for tag, points in zip(self._tags, self._points, strict=True):
            seen = tag.read_s <= now_s
            points.set_data(tag.read_s[seen], tag.phase_rad[seen])
        until = slice(0, frame + 1)
        for changes, lines in zip(self._changes, self._lines, strict=True):
            for change_m, line in zip(changes, lines, strict=True):
                line.set_data(self._frame_s[until], change_m[until])
        self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()


def _colour(tag: int) -> tuple[float, float, float]:
    red, green, blue = PALETTE_RGB[tag % len(PALETTE_RGB)]
    return red / 255, green / 255, blue / 255


def _phase_axes(axes: Axes, tag: TagCurves, colour: tuple[float, float, float]):
    """Axes of a tag's phase, empty; the points, which are set later."""
    _plain(axes)
    axes.set_ylim(-0.4, 2 * np.pi + 0.4)
    axes.set_yticks(*_PHASE_TICKS, fontsize=_TEXT_PT)
    axes.tick_params(labelbottom=False)
    axes.annotate(
        tag.name,
        (1.0, 1.0),
        (0, 1),
        xycoords="axes fraction",
        textcoords="offset points",
        ha="right",
        va="bottom",
        fontsize=_TEXT_PT,
    )
    (points,) = axes.plot([], [], linestyle="", marker="o", markersize=2.2, color=colour)
    return points


def _distance_axes(axes: Axes, changes: Sequence[tuple[np.ndarray, np.ndarray]]):
    """Axes of the change of distance; of each tag the line of its mask and that of the truth, empty."""
    _plain(axes)
    axes.set_title("change of distance, m", loc="left", pad=4.0, fontsize=_TEXT_PT)
    values = np.concatenate([np.concatenate(pair) for pair in changes])
    values = values[np.isfinite(values)]
    low, high = (values.min(), values.max()) if len(values) else (-1.0, 1.0)
    margin = 0.06 * max(high - low, 0.1)
    axes.set_ylim(low - margin, high + margin)
    axes.tick_params(labelsize=_TEXT_PT)
    lines = []
    for tag in range(len(changes)):
        (mask,) = axes.plot([], [], color=_colour(tag), linewidth=1.8, solid_capstyle="round", label="mask")
        (truth,) = axes.plot([], [], color="0.2", linewidth=0.9, linestyle=(0, (3, 2)), label="truth")
        lines.append((mask, truth))
    has_truth = any(np.isfinite(true_m).any() for _, true_m in changes)
    known = lines[0] if has_truth else lines[0][:1]
    axes.legend(
        handles=known,
        loc="lower right",
        bbox_to_anchor=(1.0, 0.98),
        ncols=2,
        fontsize=_TEXT_PT,
        frameon=False,
        handlelength=1.6,
        borderpad=0.0,
        columnspacing=1.0,
    )
    return lines


def _plain(axes: Axes) -> None:
    """Axes without a box, with a thin grid."""
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(_GREY)
    axes.grid(color="0.9", linewidth=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(length=2.0, color=_GREY, pad=2.0)
