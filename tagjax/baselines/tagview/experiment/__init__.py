"""Tagview's own experiments: naming trains on a table, separated traces, like phases, tracking error (VI.B-D)."""

from __future__ import annotations

from ._judge import Judged, Watched, judge, true_stretches, watch
from ._run import PAPER, DetectorTraining, Matching, TagviewExperiment, run_tagview, train_tagview
from ._table import summarise, table

__all__ = [
    "PAPER",
    "DetectorTraining",
    "Judged",
    "Matching",
    "TagviewExperiment",
    "Watched",
    "judge",
    "run_tagview",
    "summarise",
    "table",
    "train_tagview",
    "true_stretches",
    "watch",
]
