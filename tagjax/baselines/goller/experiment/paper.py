"""Figures that Goller et al. report."""

from __future__ import annotations

from typing import Any

SIMPLE = "sp_st_still"
"""The variant of Table I: one moving tag, two still ones."""

PAPER_TABLE_1 = {"rfid": (0.86, 0.40), "fused": (0.96, 0.0)}
"""P_D and P_FA of RFID only and of RFID + CV."""

PAPER_TABLE_2: dict[str, tuple[str, float, float, float | None]] = {
    "sp_st": ("SP-ST", 0.9733, 0.9733, None),
    "sp_mt_2": ("SP-MT, 2 moving", 1.0, 0.9750, None),
    "sp_mt_4": ("SP-MT, 4 moving", 1.0, 0.9125, None),
    "sp_mt_still": ("SP-MT, 2 moving, 4 still", 1.0, 0.9312, 0.0188),
    "mp_mt_still": ("MP-MT, 2 moving, 4 still", 1.0, 0.8438, 0.0219),
}
"""Label, P_D,run, P_D and P_FA by variant."""


def paper_rates() -> dict[str, Any]:
    """Both tables as plain values, with the names of `Rates`."""
    return {
        "table_1": {rule: {"detected": found, "false_alarm": false} for rule, (found, false) in PAPER_TABLE_1.items()},
        "table_2": {
            variant: {"detected_run": run, "detected": found, "false_alarm": false}
            for variant, (_, run, found, false) in PAPER_TABLE_2.items()
        },
    }
