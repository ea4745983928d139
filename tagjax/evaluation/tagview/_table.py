"""Figures over recordings, and the table with the paper's beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from ._judge import Judged

PAPER_GROUPS: Mapping[str, Mapping[str, float]] = {
    "ceiling_2": {"accuracy": 0.99},
    "ceiling_6": {"accuracy": 0.96},
    "separated_traces two": {"precision": 0.99, "recall": 0.99},
    "separated_traces three": {"precision": 0.98, "recall": 0.97},
    "separated_traces four": {"precision": 0.97, "recall": 0.97},
    "half_wavelength": {"precision": 0.97, "recall": 0.97},
}
"""What the paper reports (Fig. 10, Tables I and II); its own trains, on its own table."""


def summarise(judged: Sequence[Judged]) -> dict[str, Any]:
    """Shares and counts over recordings; None where there is nothing to divide by.

    Accuracy: rightly named traces of all traces of tagged things (VI.D). Precision: of all named traces. Recall: of all
    true stretches in sight. Tracking error over all boxes of tagged things' traces.
    """

    def share(part: int, whole: int) -> float | None:
        return part / whole if whole else None

    def total(name: str) -> int:
        return sum(getattr(one, name) for one in judged)

    errors = np.concatenate([one.error_px for one in judged] or [np.zeros(0)])
    return {
        "num_recordings": len(judged),
        "num_traces": total("num_traces"),
        "num_false_traces": total("num_false"),
        "accuracy": share(total("num_right"), total("num_traces")),
        "precision": share(total("num_right"), total("num_named")),
        "recall": share(total("num_found"), total("num_stretches")),
        "tracking_error_px": float(errors.mean()) if len(errors) else None,
        "tracking_error_std_px": float(errors.std()) if len(errors) else None,
        "largest_gap": max((one.gap for one in judged), default=0.0),
    }


def quartiles(judged: Sequence[Judged], kind: str) -> dict[str, list[float] | None]:
    """Lower quartile, median and upper quartile of `r_squared` or `slope`, of right and of wrong pairs."""
    rows = np.concatenate([getattr(one, kind) for one in judged] or [np.zeros((2, 0))], axis=1)
    parts = {"right": rows[0, rows[1] == 1], "wrong": rows[0, rows[1] == 0]}
    return {
        name: [float(value) for value in np.quantile(part, [0.25, 0.5, 0.75])] if len(part) else None
        for name, part in parts.items()
    }


def table(metrics: Mapping[str, Any]) -> str:
    """The metrics as Markdown: a row for each group of recordings and setting, the paper's figures in brackets."""
    rows = [
        "| recordings | setting | runs | traces | accuracy | precision | recall |",
        "|---|---|---|---|---|---|---|",
    ]
    for group, settings in metrics["groups"].items():
        for name, one in settings.items():
            theirs = PAPER_GROUPS.get(group, {}) if name == metrics["complete"] else {}
            cells = [_cell(one[kind], theirs.get(kind)) for kind in ("accuracy", "precision", "recall")]
            rows.append(f"| {group} | {name} | {one['num_recordings']} | {one['num_traces']} | {' | '.join(cells)} |")
    rows += [
        "",
        "In brackets the paper's figure on its own trains. Over all: mean accuracy 0.98, Hungarian matching alone 0.91; "
        "half_wavelength without RSSI: precision 0.57, recall 0.55.",
        "",
        "| tracking error | px | std, px | mm on the plane |",
        "|---|---|---|---|",
        "| the paper's (1080 rows) | 4.82 | 3.42 | 5.36 |",
    ]
    track = metrics["tracking"]
    rows.append(
        f"| here ({track['height_px']} rows) | {track['error_px']:.2f} | {track['std_px']:.2f} | {track['error_mm']:.2f} |"
    )
    rows += ["", "| pairs | R^2, quartiles | slope over the true one, quartiles |", "|---|---|---|"]
    for kind in ("right", "wrong"):
        cells = [_three(metrics["pairs"][what][kind]) for what in ("r_squared", "slope")]
        rows.append(f"| {kind} | {' | '.join(cells)} |")
    return "\n".join(rows) + "\n"


def _cell(value: float | None, theirs: float | None) -> str:
    said = "-" if value is None else f"{value:.3f}"
    return said if theirs is None else f"{said} ({theirs:g})"


def _three(values: Sequence[float] | None) -> str:
    return "-" if values is None else ", ".join(f"{value:.2f}" for value in values)
