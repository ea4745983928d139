"""TagVision's figures as Markdown tables, the paper's beside them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ....core.results import markdown_table

PAPER = {"blob_matching": 0.98, "tracking_error_mm": 10.33, "transform_error_mm": 1.56, "others_below": 0.075}
"""The figures that the paper reports."""


def report_markdown(metrics: Mapping[str, Any]) -> str:
    """The metrics of a run as tables: lines, calibration, matching."""
    parts = []
    if "lines" in metrics:
        parts.append(_line_table(metrics["lines"]))
    parts.append(_calibration_table(metrics))
    if "tracks" in metrics:
        parts.append(_matching_table(metrics["tracks"]["matching"]))
    return "\n\n".join(parts) + "\n"


def _line_table(lines: Mapping[str, Mapping[str, float]]) -> str:
    header = [
        "lines",
        "truth is maximum (rounds)",
        "error of a round, mm",
        "others: min, median, 90 % below",
        "below 0.075",
    ]
    rows = []
    for name, one in lines.items():
        others = [f"{one[key]:.3f}" for key in ("others_min", "others_median", "others_90_percent_below")]
        maximum = "yes" if one["truth_is_maximum"] else "no"
        rows.append(
            [
                name,
                f"{maximum} ({one['truth_is_maximum_fraction_of_rounds']:.2f})",
                f"{one['error_of_a_round_mm']:.1f}",
                ", ".join(others),
                f"{one['others_below_0.075']:.2f}",
            ]
        )
    return markdown_table(header, rows)


def _calibration_table(metrics: Mapping[str, Any]) -> str:
    rows = [
        [name, f"{one['transform_error_mm']:.2f}", f"{one['worst_mm']:.2f}", PAPER["transform_error_mm"]]
        for name, one in metrics["calibration"].items()
    ]
    if "tracks" in metrics:
        own = metrics["tracks"]["transform_error_mm"]
        rows.append(["of the recordings", f"{own['mean']:.2f}", f"{own['worst']:.2f}", PAPER["transform_error_mm"]])
    return markdown_table(["calibration", "mean transform error, mm", "worst, mm", "paper, mm"], rows)


def _matching_table(matching: Mapping[str, Mapping[str, Any]]) -> str:
    header = ["matching", "all tags", "tags among several", "correct detections", "error, mm"]
    rows = [["paper", PAPER["blob_matching"], None, None, PAPER["tracking_error_mm"], None, None]]
    for name, one in matching.items():
        rows.append(
            [
                name,
                _count(one["blob_matching"], one["num_tags"]),
                _count(one["blob_matching_among_several"], one["num_tags_among_several"]),
                *(
                    None if one[key] is None else f"{one[key]:.3g}"
                    for key in (
                        "detections_correct",
                        "tracking_error_mm",
                        "tracking_error_own_height_mm",
                        "tag_error_mm",
                    )
                ),
            ]
        )
    return markdown_table([*header, "error at the object's height, mm", "error of the tag, mm"], rows)


def _count(value: float | None, count: int) -> str | None:
    return None if value is None else f"{value:.3f} of {count}"
