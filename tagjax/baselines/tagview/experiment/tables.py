"""Tagview's figures as Markdown tables, the paper's beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from ....core.results import markdown_table

PAPER_GROUPS: Mapping[str, Mapping[str, float]] = {
    "ceiling_2": {"accuracy": 0.99},
    "ceiling_6": {"accuracy": 0.96},
    "separated_traces two": {"precision": 0.99, "recall": 0.99},
    "separated_traces three": {"precision": 0.98, "recall": 0.97},
    "separated_traces four": {"precision": 0.97, "recall": 0.97},
    "half_wavelength": {"precision": 0.97, "recall": 0.97},
}
"""What the paper reports (Fig. 10, Tables I and II), of its own trains on its own table."""

PAPER = {"accuracy": 0.98, "hungarian": 0.91, "tracking_error_px": 4.82, "groups": PAPER_GROUPS}
"""The figures that the paper reports."""


def report_markdown(metrics: Mapping[str, Any]) -> str:
    """The metrics of a run as tables: identification (the paper's figures in brackets), tracking error, pairs."""
    note = (
        "In brackets the paper's figure, of its own trains. Over all: mean accuracy 0.98, Hungarian matching alone 0.91; "
        "half_wavelength without RSSI: precision 0.57, recall 0.55."
    )
    parts = [_identification_table(metrics), note, _tracking_table(metrics["tracking"]), _pair_table(metrics["pairs"])]
    return "\n\n".join(parts) + "\n"


def _identification_table(metrics: Mapping[str, Any]) -> str:
    rows = []
    for group, settings in metrics["groups"].items():
        for name, one in settings.items():
            paper = PAPER_GROUPS.get(group, {}) if name == metrics["main"] else {}
            cells = [_with_paper(one[kind], paper.get(kind)) for kind in ("accuracy", "precision", "recall")]
            rows.append([group, name, one["num_recordings"], one["num_traces"], *cells])
    header = ["suite", "setting", "recordings", "traces", "accuracy", "precision", "recall"]
    return markdown_table(header, rows)


def _tracking_table(tracking: Mapping[str, float]) -> str:
    own = [f"{tracking[key]:.2f}" for key in ("error_px", "std_px", "error_mm")]
    rows = [["paper (1080 rows)", 4.82, 3.42, 5.36], [f"here ({tracking['height_px']} rows)", *own]]
    return markdown_table(["tracking error", "px", "std, px", "mm on the plane"], rows)


def _pair_table(pairs: Mapping[str, Mapping[str, Sequence[float] | None]]) -> str:
    rows = [
        [kind, *(_three(pairs[quantity][kind]) for quantity in ("r_squared", "slope"))]
        for kind in ("correct", "incorrect")
    ]
    return markdown_table(["pairs", "R^2, quartiles", "slope over the true one, quartiles"], rows)


def _with_paper(value: float | None, paper: float | None) -> str:
    own = "-" if value is None else f"{value:.3f}"
    return own if paper is None else f"{own} ({paper:g})"


def _three(values: Sequence[float] | None) -> str | None:
    return None if values is None else ", ".join(f"{value:.2f}" for value in values)
