"""Goller et al.'s own experiments: alarms at a shop's exit (Tables I and II), hand-over (Fig. 7), and what is missed."""

from __future__ import annotations

from ._handover import Handover, follow, mean_curve
from ._ladder import RUNGS, ladder
from ._run import GollerConfig, run_goller, scenario_paths
from ._tables import PAPER_TABLE_1, PAPER_TABLE_2, Rates, TagOutcome, outcomes, rates, thresholds

__all__ = [
    "PAPER_TABLE_1",
    "PAPER_TABLE_2",
    "RUNGS",
    "GollerConfig",
    "Handover",
    "Rates",
    "TagOutcome",
    "follow",
    "ladder",
    "mean_curve",
    "outcomes",
    "rates",
    "run_goller",
    "scenario_paths",
    "thresholds",
]
