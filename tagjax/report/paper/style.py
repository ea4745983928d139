"""The common style of the papers' figures: size, colours, and small files. Needs the viz extra."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ...core.files import write_atomic
from ..figure import blank

WIDTH_IN = 7.0
"""Width of every figure; at 100 pixels an inch it is as wide as a page of documentation shows it."""

MAX_BYTES = 150_000

OURS, PAPERS, TRUTH, OTHER = "#0072b2", "#d55e00", "#000000", "#999999"
"""Of the learnable tracer, of the published one, of the truth and of everything else (Okabe and Ito, 2008)."""

LINES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
DASHES = ("-", "--", "-.", ":", (0, (5, 1, 1, 1, 1, 1)), (0, (1, 1)))
"""Colours and dashes of several lines in one panel: each line has both."""

FONT = 8.5

Crop = tuple[int, int, int, int]
"""First column, first row, and the ones after the last column and row."""


def sheet(height_in: float) -> Figure:
    """An empty figure of the common width."""
    return blank(WIDTH_IN, height_in)


def tidy(axes: Axes, *, title: str = "", xlabel: str = "", ylabel: str = "") -> None:
    """A light grid, and texts of the common size."""
    axes.grid(alpha=0.3, linewidth=0.6)
    axes.set_title(title, fontsize=FONT + 0.5, loc="left")
    axes.set_xlabel(xlabel, fontsize=FONT)
    axes.set_ylabel(ylabel, fontsize=FONT)
    axes.tick_params(labelsize=FONT - 0.5)


def save_small(figure: Figure, path: Path, *, max_bytes: int = MAX_BYTES) -> None:
    """Write a PNG of at most `max_bytes`: as it is, or with ever fewer colours and then pixels, until it is small enough."""
    if path.suffix != ".png":
        raise ValueError(f"{path}: found the suffix {path.suffix!r}; expected .png.")
    for dpi in (150, 120, 100, 80):
        drawn = io.BytesIO()
        figure.savefig(drawn, dpi=dpi, format="png")
        content = _fewer_colours(drawn.getvalue(), max_bytes)
        if len(content) <= max_bytes:
            break
    write_atomic(path, content)


def shrink(path: Path, *, max_bytes: int = MAX_BYTES) -> None:
    """Write a PNG again with so few colours that it has at most `max_bytes`, as far as 64 colours suffice."""
    write_atomic(path, _fewer_colours(path.read_bytes(), max_bytes))


def _fewer_colours(content: bytes, max_bytes: int) -> bytes:
    """A PNG with as many of its colours as fit; with 64 if none does."""
    from PIL import Image

    out = b""
    for colours in (None, 256, 128, 64):
        small = Image.open(io.BytesIO(content)).convert("RGB")
        if colours is not None:
            small = small.quantize(colours, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
        written = io.BytesIO()
        small.save(written, format="png", optimize=True)
        out = written.getvalue()
        if len(out) <= max_bytes:
            break
    return out


def show(
    axes: Axes, image: UInt8[np.ndarray, "height width 3"], crop: Crop, *, title: str = "", below: str = ""
) -> None:
    """A part of a picture without ticks, in the picture's coordinates, with a title and a text below."""
    x0, y0, x1, y1 = crop
    axes.imshow(image, interpolation="nearest")
    axes.set(xlim=(x0 - 0.5, x1 - 0.5), ylim=(y1 - 0.5, y0 - 0.5), xticks=[], yticks=[])
    axes.set_title(title, fontsize=FONT, pad=3)
    axes.set_xlabel(below, fontsize=FONT - 0.5, labelpad=2)
    for side in axes.spines.values():
        side.set_linewidth(0.5)


def outline(axes: Axes, mask: Bool[np.ndarray, "height width"], colour: str, *, width: float = 1.2) -> None:
    """The outline of a mask, over a thin white one so that it stands out from any background."""
    if mask.any() and not mask.all():
        axes.contour(mask.astype(float), levels=[0.5], colors="white", linewidths=width + 1.0)
        axes.contour(mask.astype(float), levels=[0.5], colors=colour, linewidths=width)


def box(axes: Axes, box_px: Float[np.ndarray, " 4"], colour: str, *, dashed: bool = False, width: float = 1.4) -> None:
    """A box (x0 y0 x1 y1, inclusive edges); nothing where it is not finite."""
    if np.all(np.isfinite(box_px)):
        x0, y0, x1, y1 = np.asarray(box_px) + np.array([-0.5, -0.5, 0.5, 0.5])
        style = (0, (3, 2)) if dashed else "-"
        axes.plot([x0, x1, x1, x0, x0], [y0, y0, y1, y1, y0], color=colour, linewidth=width, linestyle=style)


def heat(level: Float[np.ndarray, "height width"]) -> UInt8[np.ndarray, "height width 3"]:
    """0 to 1 as colours that grow brighter evenly, for any kind of colour vision (cividis); NaN is white."""
    from matplotlib import colormaps

    coloured = colormaps["cividis"](np.clip(np.nan_to_num(level), 0.0, 1.0))[..., :3]
    return np.where(np.isfinite(level)[..., None], np.rint(255 * coloured), 255).astype(np.uint8)


def around(boxes_px: Float[np.ndarray, "*batch 4"], height: int, width: int, *, margin: float = 0.6) -> Crop:
    """A part of a picture of the picture's own proportions around some boxes (NaN ignored), with a margin."""
    boxes = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    boxes = boxes[np.isfinite(boxes).all(axis=1)]
    if not len(boxes):
        return 0, 0, width, height
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    centre, size = 0.5 * (low + high), (high - low) * (1 + margin)
    scale = min(1.0, max(size[0] / width, size[1] / height, 0.3))
    across, down = round(width * scale), round(height * scale)
    x0 = int(np.clip(round(centre[0] - across / 2), 0, width - across))
    y0 = int(np.clip(round(centre[1] - down / 2), 0, height - down))
    return x0, y0, x0 + across, y0 + down
