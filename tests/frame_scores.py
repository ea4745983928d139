"""A tag's frame scores for tests: only what a test is about has to be given."""

from __future__ import annotations

from typing import Any

import numpy as np

from tagjax.metrics.tags import FrameScores
from tagjax.tracing.status import Status


def frame_scores(iou: Any, *, rate_hz: float = 10.0, **columns: Any) -> FrameScores:
    """Frame scores with this box IoU; by default everything is detected, right, visible and clearly read from frame 0."""
    iou = np.asarray(iou, np.float64)
    num = len(iou)
    label = int(columns.pop("label", 1))
    chosen: dict[str, Any] = {
        "time_s": np.arange(num) / rate_hz,
        "cle_px": np.full(num, 7.0),
        "mask_j": iou,
        "boundary_f": np.repeat(iou[:, None], 4, axis=1),
        "identified": np.full(num, label),
        "confidence": np.ones(num),
        "detected": np.ones(num, bool),
        "status": np.full(num, Status.DETECTED, np.int8),
        "carrier_iou": np.full(num, np.nan),
        "range_error_m": np.full(num, -0.02),
        "visible": np.ones(num, bool),
        "since_motion": np.arange(num),
        "selected": np.ones(num, bool),
        "reads": np.full(num, 30),
        "rssi_dbm": np.full(num, -55.0),
        "line_of_sight": np.ones(num),
    }
    types = {name: value.dtype for name, value in chosen.items()}
    moves = bool(columns.pop("moves", True))
    chosen |= {name: np.asarray(value, types[name]) for name, value in columns.items()}
    return FrameScores(iou=iou, label=label, moves=moves, **chosen)
