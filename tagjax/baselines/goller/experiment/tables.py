"""Goller et al.'s tables as Markdown, with the paper's figures in columns of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from ....core.results import markdown_table
from .paper import PAPER_TABLE_1, PAPER_TABLE_2, SIMPLE
from .rates import Rates, rate_with_interval

_RULES = {"rfid": "RFID only", "fused": "RFID + CV"}


def rate_tables(
    simple: Mapping[str, Rates], scenarios: Mapping[str, Rates], at_paper: Mapping[str, tuple[float, float]]
) -> str:
    """Table I (with further rows at the paper's false alarms) and Table II."""
    rows: list[list[Any]] = []
    for rule, row in simple.items():
        rows.append(_simple_row(_RULES[rule], rule, row, (row.detected, row.false_alarm)))
    for rule, point in at_paper.items():
        rows.append(_simple_row(f"{_RULES[rule]}, at the paper's P_FA", rule, simple[rule], point))
    first = markdown_table(["approach", "runs", "P_D (95 %)", "P_D, paper", "P_FA (95 %)", "P_FA, paper"], rows)
    rows = []
    for name, row in scenarios.items():
        label, run, detected, false_alarm = PAPER_TABLE_2[name]
        rows.append(
            [
                label,
                row.num_runs,
                rate_with_interval(row.detected_run, row.num_runs),
                run,
                rate_with_interval(row.detected, row.num_leaves),
                detected,
                rate_with_interval(row.false_alarm, row.num_still),
                false_alarm,
                rate_with_interval(row.false_alarm_stays, row.num_stays),
            ]
        )
    header = ["scenario", "runs", "P_D,run (95 %)", "paper", "P_D (95 %)", "paper", "P_FA (95 %)", "paper"]
    second = markdown_table([*header, "false alarms of carried tags that stay"], rows)
    return f"{first}\n\n{second}\n"


def _simple_row(label: str, rule: str, row: Rates, point: tuple[float, float]) -> list[Any]:
    paper = PAPER_TABLE_1[rule]
    detected, false_alarm = rate_with_interval(point[0], row.num_leaves), rate_with_interval(point[1], row.num_still)
    return [label, row.num_runs, detected, paper[0], false_alarm, paper[1]]


def ablation_table(conditions: Mapping[str, Mapping[str, Rates]]) -> str:
    """P_D / P_FA of every scenario where one sensor, or both, are replaced by the truth."""
    labels = {**{name: paper[0] for name, paper in PAPER_TABLE_2.items()}, SIMPLE: "SP-ST, 2 still", "all": "all"}
    columns = [name for name in labels if any(name in row for row in conditions.values())]
    rows = [
        [condition, *(_pair(row[name]) if name in row else None for name in columns)]
        for condition, row in conditions.items()
    ]
    return markdown_table(["P_D / P_FA", *(labels[name] for name in columns)], rows) + "\n"


def _pair(row: Rates) -> str:
    return " / ".join("-" if np.isnan(rate) else f"{rate:.3f}" for rate in (row.detected, row.false_alarm))
