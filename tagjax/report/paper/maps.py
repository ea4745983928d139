"""Figures of one frame's stages as pictures: motion, attention, likelihood, its distribution, the mask."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from .style import FONT, LINES, OTHER, OURS, PAPERS, TRUTH, Crop, heat, outline, save_small, sheet, show, tidy


@dataclasses.dataclass(frozen=True)
class Anchor:
    """A chosen pixel: column and row, whether it is on the object, and its motion over the window."""

    place_px: tuple[int, int]
    on_object: bool
    motion_m: Float[np.ndarray, " window"]


@dataclasses.dataclass(frozen=True)
class MapFrame:
    """One tag's stages at one frame, pixels of the working resolution."""

    title: str
    colour: UInt8[np.ndarray, "height width 3"]
    true_mask: Bool[np.ndarray, "height width"]
    attention: Float[np.ndarray, "height width"]
    carried: Float[np.ndarray, "height width"]  # the last frame's, normalised to 0 to 1
    probability: Float[np.ndarray, "height width"]


def attention_figure(
    path: Path,
    frame: MapFrame,
    change_mm: UInt8[np.ndarray, "height width 3"],
    largest_mm: float,
    anchors: Sequence[Anchor],
    time_s: Float[np.ndarray, " window"],
    tag_m: Float[np.ndarray, " window"],
    crop: Crop,
) -> None:
    """TagAttention, Fig. 4: (A) chosen pixels, (B) the motion map, (C) their motion against the tag's, (D) attention."""
    figure = sheet(5.6)
    (top, right), (lower, corner) = figure.subplots(2, 2)
    show(top, frame.colour, crop, title="(A) chosen pixels")
    show(right, change_mm, crop, title=f"(B) change of distance over the window, ±{largest_mm:.0f} mm")
    show(corner, heat(frame.attention), crop, title="(D) attention, 0 dark to 1 bright")
    ms = 1e3 * (time_s - time_s[0])
    lower.plot(ms, 1e3 * tag_m, "o-", color=TRUTH, linewidth=2.0, markersize=4, label="tag, by radio")
    for number, anchor in enumerate(anchors, 1):
        colour = LINES[(number - 1) % len(LINES)]
        line = "-" if anchor.on_object else "--"
        name = f"{number}, on the object" if anchor.on_object else f"{number}"
        lower.plot(ms, 1e3 * anchor.motion_m, line, color=colour, linewidth=1.4, label=name)
        for axes in (top, right):
            axes.plot(*anchor.place_px, "o", color=colour, markersize=5, markeredgecolor="white", markeredgewidth=0.9)
        top.annotate(
            f"{number}",
            anchor.place_px,
            (4, 3),
            textcoords="offset points",
            fontsize=FONT,
            color="white",
            bbox={"facecolor": "black", "alpha": 0.6, "pad": 1, "linewidth": 0},
        )
    for axes in (top, right, corner):
        outline(axes, frame.true_mask, TRUTH, width=0.8)
    tidy(lower, title="(C) motion of these pixels and of the tag", xlabel="time (ms)", ylabel="change of distance (mm)")
    lower.legend(fontsize=FONT - 1, ncols=2, frameon=False)
    save_small(figure, path)


def propagation_figure(path: Path, frames: Sequence[MapFrame], crop: Crop) -> None:
    """TagAttention, Fig. 5: one row a frame: picture, attention, likelihood carried along the flow, their product."""
    names = ("picture", "attention", "carried along the flow", "likelihood")
    figure = sheet(1.42 * len(frames) + 0.3)
    grid = np.asarray(figure.subplots(len(frames), len(names), squeeze=False))
    for number, (row, frame) in enumerate(zip(grid, frames, strict=True)):
        maps = (frame.colour, heat(frame.attention), heat(frame.carried), heat(frame.probability))
        for axes, name, image in zip(row, names, maps, strict=True):
            show(axes, image, crop, title="" if number else name)
            outline(axes, frame.true_mask, TRUTH, width=0.7)
        row[0].set_ylabel(frame.title, fontsize=FONT)
    save_small(figure, path)


def distribution_figure(
    path: Path,
    probability: Float[np.ndarray, " pixels"],
    on_object: Bool[np.ndarray, " pixels"],
    cut: float,
    corners: Sequence[float],
) -> None:
    """TagAttention, Fig. 6: the distribution of the normalised likelihood over the pixels, its corners and the cut."""
    figure = sheet(3.1)
    left, right = figure.subplots(1, 2)
    at = np.linspace(0.0, 1.0, 501)
    for axes, values, colour, line, label in (
        (left, probability, OURS, "-", "all pixels"),
        (right, probability[~on_object], OTHER, "--", "not of the object"),
        (right, probability[on_object], OURS, "-", "of the object"),
    ):
        level = below(values, at)
        axes.plot(at, level, line, color=colour, linewidth=1.5, label=f"{label} ({len(values)})")
        if axes is left:
            marked = below(values, np.asarray(corners))
            axes.plot(corners, marked, "o", color=LINES[4], markersize=8, markerfacecolor="none", markeredgewidth=1.6)
            low = float(below(values, np.array([0.002]))[0])
            axes.set_ylim(min(0.995, low - 0.15 * (1 - low)), 1.0 + 0.05 * (1 - low))
    for axes in (left, right):
        axes.axvline(cut, color=PAPERS, linewidth=1.2, linestyle=":", label=f"cut at {cut:g}")
    tidy(left, title="all pixels, upper end (circles: corners)", xlabel="normalised likelihood p", ylabel="CDF")
    tidy(right, title="by truth", xlabel="normalised likelihood p")
    for axes in (left, right):
        axes.legend(fontsize=FONT - 0.5, loc="center right" if axes is right else "lower right")
    save_small(figure, path)


def below(values: Float[np.ndarray, " pixels"], at: Float[np.ndarray, " levels"]) -> Float[np.ndarray, " levels"]:
    """The fraction of values that are at most each level; 1 where there are no values."""
    return np.searchsorted(np.sort(values), at, side="right") / max(len(values), 1) if len(values) else np.ones(len(at))


def cdf_corners(probability: Float[np.ndarray, " pixels"], *, most: int = 5) -> list[float]:
    """The corners of the CDF between 0 and 1, in order: where its slope changes most, at least 0.08 apart.

    Slopes are those over 0.04 to both sides, in parts of the rise from p = 0.01 to 1; changes below a tenth of the largest
    do not count. A CDF that does not rise has its only corner at 0.
    """
    at = np.linspace(0.0, 1.0, 1001)
    level = below(probability, np.maximum(at, 0.01))
    rise = level[-1] - level[0]
    if rise <= 0:
        return [0.0]
    near = np.clip(np.arange(len(at))[:, None] + np.array([-40, 0, 40])[None], 0, len(at) - 1)
    before, here, after = (level[near] / rise).T
    change = np.abs((after - here) - (here - before))
    change[[*range(10), *range(-10, 0)]] = 0.0
    found: list[int] = []
    for place in np.argsort(-change, kind="stable"):
        if len(found) == most or change[place] < 0.1 * change.max():
            break
        if all(abs(place - other) >= 80 for other in found):
            found.append(int(place))
    return sorted(float(at[place]) for place in found) or [0.0]


def refinement_figure(
    path: Path,
    colour: UInt8[np.ndarray, "height width 3"],
    cluster: Int[np.ndarray, "height width"],
    before: Bool[np.ndarray, "height width"],
    after: Bool[np.ndarray, "height width"],
    true_mask: Bool[np.ndarray, "height width"],
    texts: tuple[str, str],
    crop: Crop,
) -> None:
    """TagAttention, Fig. 7: picture, K-means clusters of position, and the mask before and after the refinement."""
    figure = sheet(2.0)
    axes = figure.subplots(1, 4)
    show(axes[0], colour, crop, title="picture")
    show(axes[1], cluster_colours(cluster), crop, title="clusters of position")
    for one, mask, title, text in zip(axes[2:], (before, after), ("before", "after"), texts, strict=True):
        show(one, tinted(colour, mask), crop, title=title, below=text)
    for one in axes:
        outline(one, true_mask, TRUTH, width=0.8)
    save_small(figure, path)


def cluster_colours(cluster: Int[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """A colour of its own for each cluster, the same each time; neighbours may by chance look alike."""
    table = np.random.default_rng(0).integers(90, 235, (int(cluster.max(initial=0)) + 1, 3), dtype=np.uint8)
    return table[cluster]


def tinted(
    colour: UInt8[np.ndarray, "height width 3"], mask: Shaped[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """The picture grey, with the mask in orange."""
    grey = np.repeat(colour.mean(axis=-1, keepdims=True), 3, axis=-1) * 0.6
    orange = 0.35 * grey + 0.65 * np.array([230.0, 159.0, 0.0])
    return np.where(np.asarray(mask, bool)[..., None], orange, grey).astype(np.uint8)


def heat_figure(
    path: Path,
    frames: Sequence[
        tuple[
            str,
            UInt8[np.ndarray, "height width 3"],
            Float[np.ndarray, "height width"],
            Bool[np.ndarray, "height width"],
        ]
    ],
    crop: Crop,
) -> None:
    """TagAttention, Fig. 11: attention over the grey picture at several frames (title, picture, attention, true mask)."""
    columns = min(4, len(frames))
    rows = -(-len(frames) // columns)
    figure = sheet(1.62 * rows + 0.1)
    grid = np.asarray(figure.subplots(rows, columns, squeeze=False)).ravel()
    for axes, (title, colour, attention, true_mask) in zip(grid, frames, strict=False):
        grey = np.repeat(colour.mean(axis=-1, keepdims=True), 3, axis=-1)
        level = np.clip(attention, 0.0, 1.0)[..., None]
        show(axes, (grey * (1 - level) + heat_warm(attention) * level).astype(np.uint8), crop, title=title)
        outline(axes, true_mask, TRUTH, width=0.7)
    for axes in grid[len(frames) :]:
        axes.set_axis_off()
    save_small(figure, path)


def heat_warm(level: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width 3"]:
    """Yellow for little, dark red for 1."""
    level = np.clip(level, 0.0, 1.0)[..., None]
    return (1 - level) * np.array([255.0, 237.0, 160.0]) + level * np.array([177.0, 0.0, 38.0])
