"""Empty figures that are written to files without a display. Needs the viz extra."""

from __future__ import annotations

from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from ..core.files import atomic_path


def blank(width: float, height: float) -> Figure:
    """An empty figure of this size in inches, with constrained layout."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def save_figure(figure: Figure, path: Path, *, dpi: int) -> None:
    """Write a figure as the kind of picture that the suffix of `path` names; it appears whole or not at all."""
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=dpi, format=path.suffix.removeprefix("."))
