"""Figures of results as pictures: one row a recording and tracer, one column a frame."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ..overlay import PALETTE_RGB
from .style import FONT, Crop, box, outline, save_small, sheet, show


@dataclasses.dataclass(frozen=True)
class Cell:
    """One frame of a strip: the picture, each detected tag's mask and box, the true boxes, and the texts around it."""

    colour: UInt8[np.ndarray, "height width 3"]
    masks: Bool[np.ndarray, "tag height width"]
    boxes_px: Float[np.ndarray, "tag 4"]
    detected: Bool[np.ndarray, " tag"]
    true_boxes_px: Float[np.ndarray, "object 4"]
    title: str
    below: str


@dataclasses.dataclass(frozen=True)
class Row:
    """A row of a strip: its label, the part of the picture that is shown, and its frames."""

    label: str
    crop: Crop
    cells: Sequence[Cell]


def strip_figure(path: Path, rows: Sequence[Row], *, names: Sequence[str] = ()) -> None:
    """TagAttention, Figs. 13, 15, 20, 21: masks and boxes in the tags' colours, true boxes white and dashed."""
    columns = max(len(row.cells) for row in rows)
    x0, y0, x1, y1 = rows[0].crop
    shape = (y1 - y0) / (x1 - x0)
    height_in = len(rows) * (6.7 / columns * shape + 0.42) + (0.3 if names else 0.0)
    figure = sheet(height_in)
    grid = np.asarray(figure.subplots(len(rows), columns, squeeze=False))
    for number, row in enumerate(rows):
        for axes, cell in zip(grid[number], row.cells, strict=False):
            show(axes, _painted(cell), row.crop, title=cell.title, below=cell.below)
            for true_box in cell.true_boxes_px:
                box(axes, true_box, "white", dashed=True, width=1.1)
            for tag in np.flatnonzero(cell.detected).tolist():  # boxes that coincide stay visible: the first is thicker
                outline(axes, cell.masks[tag], _colour(tag), width=0.7)
                box(axes, cell.boxes_px[tag], _colour(tag), width=2.8 if tag == 0 and len(cell.masks) > 1 else 1.4)
        grid[number][0].set_ylabel(row.label, fontsize=FONT)
        for axes in grid[number][len(row.cells) :]:
            axes.set_axis_off()
    if names:
        _legend(figure, names)
    save_small(figure, path)


def _legend(figure: Figure, names: Sequence[str]) -> None:
    handles = [Line2D([], [], color=_colour(tag), linewidth=2.5) for tag in range(len(names))]
    figure.legend(handles, list(names), loc="outside lower center", ncols=len(names), fontsize=FONT, frameon=False)


def _painted(cell: Cell) -> np.ndarray:
    """The picture with the detected masks tinted."""
    picture = cell.colour.astype(np.float32)
    for tag in np.flatnonzero(cell.detected):
        mask = cell.masks[tag]
        picture[mask] = 0.6 * picture[mask] + 0.4 * np.array(PALETTE_RGB[tag % len(PALETTE_RGB)], np.float32)
    return picture.astype(np.uint8)


def _colour(tag: int) -> str:
    red, green, blue = PALETTE_RGB[tag % len(PALETTE_RGB)]
    return f"#{red:02x}{green:02x}{blue:02x}"
