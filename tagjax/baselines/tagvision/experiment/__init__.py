"""TagVision's own experiments: parallel lines (Fig. 6), camera calibration (VI.B), things that move over a table."""

from __future__ import annotations

from ._calibration import PAPER_CAMERA, CalibrationSettings, board_views, calibrated, overhead, transform_error_m
from ._lines import LineScores, LineSettings, line_scores
from ._run import PAPER, TagVisionExperiment, run_tagvision, summarise, table
from ._table import SeenRecording, TableTruth, TagResult, judge, nearest_host, see, table_truth

__all__ = [
    "PAPER",
    "PAPER_CAMERA",
    "CalibrationSettings",
    "LineScores",
    "LineSettings",
    "SeenRecording",
    "TableTruth",
    "TagResult",
    "TagVisionExperiment",
    "board_views",
    "calibrated",
    "judge",
    "line_scores",
    "nearest_host",
    "overhead",
    "run_tagvision",
    "see",
    "summarise",
    "table",
    "table_truth",
    "transform_error_m",
]
