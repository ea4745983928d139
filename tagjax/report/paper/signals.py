"""Figures of reads: phases and distances before and after unwrapping, the two clocks, the tag's constant offset."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from .style import DASHES, FONT, LINES, OTHER, OURS, PAPERS, TRUTH, save_small, sheet, tidy


def phase_figure(
    path: Path,
    read_s: Float[np.ndarray, " reads"],
    phase_rad: Float[np.ndarray, " reads"],
    unwrapped_rad: Float[np.ndarray, " reads"],
    distances_m: Mapping[str, Float[np.ndarray, " reads"]],
    frame_s: Float[np.ndarray, " frames"],
    truth_m: Float[np.ndarray, " frames"],
) -> None:
    """TagAttention, Fig. 2: (A) phases as received and unwrapped, (B) distances before and after smoothing."""
    figure = sheet(4.6)
    upper, lower = figure.subplots(2, 1, sharex=True)
    upper.plot(read_s, phase_rad, "+", color=TRUTH, markersize=4, label="received, modulo 2π")
    upper.plot(read_s, unwrapped_rad, "-", color=OURS, linewidth=1.3, label="unwrapped")
    tidy(upper, title="(A) phase", ylabel="phase (rad)")
    upper.legend(fontsize=FONT - 0.5, ncols=2, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    lower.plot(frame_s, 100 * truth_m, color=TRUTH, linewidth=3.2, alpha=0.25, label="true")
    for number, (name, distance_m) in enumerate(distances_m.items()):
        wide = {"linewidth": 2.6, "alpha": 0.5} if number == 0 else {"linewidth": 1.3}
        lower.plot(read_s, 100 * distance_m, linestyle=DASHES[number], color=LINES[number], label=name, **wide)
    tidy(lower, title="(B) distance", xlabel="time (s)", ylabel="change of distance (cm)")
    lower.legend(fontsize=FONT - 0.5, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    save_small(figure, path)


def synchronisation_figure(
    path: Path,
    read_s: Mapping[str, Float[np.ndarray, " _"]],
    shown: str,
    at_reads_m: Float[np.ndarray, " reads"],
    frame_s: Float[np.ndarray, " frames"],
    at_frames_m: Float[np.ndarray, " frames"],
    truth_m: Float[np.ndarray, " frames"],
) -> None:
    """TagAttention, Fig. 3: the times of frames and of each tag's reads, and one tag's distance moved to the frames.

    `read_s` has each tag's reads by name; `at_reads_m` are the distances of the tag `shown`.
    """
    figure = sheet(4.2)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(1.0, 2.2))
    rows = {"frames": frame_s, **read_s}
    colours = [TRUTH, *(OURS if name == shown else OTHER for name in read_s)]
    upper.eventplot(list(rows.values()), lineoffsets=range(len(rows)), linelengths=0.7, linewidths=1.3, colors=colours)
    tidy(upper, title="(A) times of frames and reads")
    upper.set_yticks(range(len(rows)), list(rows))
    upper.set_ylim(len(rows) - 0.5, -0.5)
    for at in frame_s:
        lower.axvline(at, color=OTHER, linewidth=0.5, alpha=0.5)
    lower.plot(frame_s, 100 * truth_m, color=TRUTH, linewidth=3.2, alpha=0.25, label="true")
    lower.plot(read_s[shown], 100 * at_reads_m, "+", color=OURS, markersize=6, label=f"at the reads of {shown}")
    lower.plot(
        frame_s, 100 * at_frames_m, "o", color=PAPERS, markersize=4.5, markerfacecolor="none", label="at the frames"
    )
    tidy(lower, title="(B) change of distance", xlabel="time (s)", ylabel="change of distance (cm)")
    lower.legend(fontsize=FONT - 0.5, ncols=3, loc="lower right", bbox_to_anchor=(1.0, 1.0), frameon=False)
    save_small(figure, path)


def offset_figure(
    path: Path,
    time_s: Float[np.ndarray, " reads"],
    measured_rad: Float[np.ndarray, " reads"],
    theory_rad: Float[np.ndarray, " reads"],
) -> None:
    """TagVision, Fig. 5: measured and theoretical phase, (a) as received, (b) each relative to its first value."""
    figure = sheet(2.9)
    left, right = figure.subplots(1, 2, sharey=True)
    whole = 2 * np.pi
    panels: tuple[tuple[Axes, str, np.ndarray, np.ndarray], ...] = (
        (left, "(a) before", measured_rad, theory_rad),
        (right, "(b) relative to the first phase", measured_rad - measured_rad[0], theory_rad - theory_rad[0]),
    )
    for axes, title, measured, theory in panels:
        axes.plot(time_s, np.mod(theory, whole), ".", color=OURS, markersize=2.5, label="from the true path")
        axes.plot(time_s, np.mod(measured, whole), "+", color=PAPERS, markersize=3.5, label="measured")
        tidy(axes, title=title, xlabel="time (s)")
    left.set_ylabel("phase (rad)", fontsize=FONT)
    figure.legend(
        *left.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=FONT - 0.5, frameon=False
    )
    save_small(figure, path)
