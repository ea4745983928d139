"""A tag's scores frame by frame, and their sums over any number of tags and recordings: state -> merge -> result."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, Int8

from .boxes import PRECISION_PX, success_area
from .identification import WINDOWS_S, window_identification
from .locking import frames_in, time_to_lock, times_to_recover
from .masks import BOUNDARY_PX, decay
from .mean import MaskedMean
from .multi_object import MultiObjectScores
from .reliability import Reliability

CLEAR_READS = 5
CLEAR_LINE_OF_SIGHT = 0.9
"""A tag is clearly read at a frame with so many reads in the last second, and so much of the direct path free."""

CLEAR = "clear_"
"""Prefix of the scores over the frames at which a tag is clearly read."""

_CLEAR_NAMES = ("iou", "cle_px", "mask_j", "identification", "success")
_MIN_LOCK_FRAMES = 3


@dataclasses.dataclass(frozen=True)
class FrameScores:
    """One tag's scores at every frame, before any selection."""

    time_s: Float[np.ndarray, " time"]
    iou: Float[np.ndarray, " time"]  # of boxes
    cle_px: Float[np.ndarray, " time"]
    mask_j: Float[np.ndarray, " time"]
    boundary_f: Float[np.ndarray, "time 4"]  # at 1, 2, 3 px and 0.8 % of the diagonal
    identified: Int[np.ndarray, " time"]  # the label most covered by the mask, 0 = none
    confidence: Float[np.ndarray, " time"]
    detected: Bool[np.ndarray, " time"]  # the tracer reports a detection
    status: Int8[np.ndarray, " time"]  # codes of `Status`: detected, or why not
    range_error_m: Float[np.ndarray, " time"]  # estimated less true range to the first antenna, NaN = unknown
    carrier_iou: Float[
        np.ndarray, " time"
    ]  # of the box with that of the person who holds the object, NaN = no such truth
    visible: Bool[np.ndarray, " time"]  # the whole object is visible in the truth
    since_motion: Int[
        np.ndarray, " time"
    ]  # frames since the tag's first motion; negative before, and if it never moves
    selected: Bool[np.ndarray, " time"]  # the time since the first motion is within the limits of the settings
    reads: Int[np.ndarray, " time"]  # of the last second
    rssi_dbm: Float[np.ndarray, " time"]  # mean of the last second, NaN without a read
    line_of_sight: Float[np.ndarray, " time"]  # fraction of the field on the direct path, NaN = unknown
    label: int  # 0 = the object has no label
    moves: bool  # the tag moves at some time

    @property
    def valid(self) -> Bool[np.ndarray, " time"]:
        """The frames that count: since the first motion, while the object is visible."""
        return self.visible & (self.since_motion >= 0) & self.selected

    @property
    def clear(self) -> Bool[np.ndarray, " time"]:
        """The frames at which the tag is clearly read; an unknown line of sight counts as free."""
        free = np.isnan(self.line_of_sight) | (self.line_of_sight >= CLEAR_LINE_OF_SIGHT)
        return (self.reads >= CLEAR_READS) & free

    @property
    def box_iou(self) -> Float[np.ndarray, " time"]:
        """The box IoU, 0 without a detection."""
        return np.where(self.detected, self.iou, 0.0)


def _columns(frames: FrameScores, threshold: float) -> dict[str, np.ndarray]:
    """What is averaged over frames. Without a detection overlaps are 0; errors in pixels and metres are then undefined."""
    detected = frames.detected
    iou, cle_px = frames.box_iou, np.where(detected, frames.cle_px, np.nan)
    mask_j = np.where(detected, frames.mask_j, 0.0)
    boundary_f = np.where(detected[:, None], frames.boundary_f, 0.0)
    named = {f"f_{tolerance:g}px": boundary_f[:, n] for n, tolerance in enumerate(BOUNDARY_PX)}
    return {
        "iou": iou,
        "cle_px": cle_px,
        "mask_j": mask_j,
        "identification": (detected & (frames.identified == frames.label)).astype(np.float64),
        "carrier_iou": np.where(detected | np.isnan(frames.carrier_iou), frames.carrier_iou, 0.0),
        "success": (iou >= threshold).astype(np.float64),
        "success_auc": success_area(iou),
        "precision_20px": (np.nan_to_num(cle_px, nan=np.inf) <= PRECISION_PX).astype(np.float64),
        **named,
        "f": boundary_f[:, -1],
        "j_and_f": 0.5 * (mask_j + boundary_f[:, -1]),
        "j_recall": (mask_j > 0.5).astype(np.float64),
        "f_recall": (boundary_f[:, -1] > 0.5).astype(np.float64),
        "p_d": detected.astype(np.float64),
        "confidence": frames.confidence,
        "range_error_mm": np.where(detected, 1e3 * np.abs(frames.range_error_m), np.nan),
        "reads_1s": frames.reads.astype(np.float64),
        "rssi_dbm": frames.rssi_dbm,
        "line_of_sight": frames.line_of_sight,
    }


@dataclasses.dataclass(frozen=True)
class Scores:
    """Accumulated scores of any number of tags.

    A frame without a detection has overlaps of 0 and counts as not identified; its centre error is undefined and left
    out, so read `cle_px` together with `p_d`.
    """

    means: Mapping[str, MaskedMean] = dataclasses.field(default_factory=dict)
    lock_s: tuple[float, ...] = ()  # one element a tag with a frame that counts
    identified_s: tuple[float, ...] = ()  # likewise, until the right object is named
    recover_s: tuple[float, ...] = ()  # one element a reappearance of a tag's object
    reliability: Reliability = dataclasses.field(default_factory=Reliability)
    multi_object: MultiObjectScores = dataclasses.field(default_factory=MultiObjectScores)

    @classmethod
    def of(cls, frames: FrameScores, *, threshold: float = 0.5, lock_s: float = 0.33) -> Scores:
        """The state of one tag. A tag that never moves has only false detections."""
        if not frames.moves:
            return cls.of_false_detections(frames.detected)
        valid = frames.valid
        columns = _columns(frames, threshold)
        means = {name: MaskedMean.of(values, valid) for name, values in columns.items()}
        for name in _CLEAR_NAMES:
            means[CLEAR + name] = MaskedMean.of(columns[name], valid & frames.clear)
        for name in ("mask_j", "f"):
            means[f"{name}_decay"] = _mean_of_one(decay(columns[name][valid]))
        means["counted"] = MaskedMean.of(valid.astype(np.float64), np.ones_like(valid))
        means["clearly_read"] = MaskedMean.of(frames.clear.astype(np.float64), valid)
        for seconds in WINDOWS_S:
            named = np.where(frames.detected, frames.identified, 0)
            one = window_identification(named, frames.label, valid, frames.time_s, seconds)
            means[f"identification_{seconds:g}s"] = one
        num_frames = frames_in(lock_s, frames.time_s, minimum=_MIN_LOCK_FRAMES)
        locked, identified = columns["success"] > 0, columns["identification"] > 0
        times = [time_to_lock(one, valid, frames.time_s, num_frames=num_frames) for one in (locked, identified)]
        right = Reliability.of(np.clip(frames.confidence[valid], 0.0, 1.0), locked[valid])
        lock, identification = (() if np.isnan(one) else (one,) for one in times)
        recover = times_to_recover(locked, frames.visible, frames.time_s, num_frames=num_frames)
        return cls(means, lock, identification, recover, right)

    @classmethod
    def of_false_detections(cls, detected: Bool[np.ndarray, " time"]) -> Scores:
        """The state of a tag that is stationary, or the object of which has no label: each of its detections is false."""
        return cls({"p_fa": MaskedMean.of(detected.astype(np.float64), np.ones_like(detected))})

    def merge(self, other: Scores) -> Scores:
        names = {**self.means, **other.means}
        return Scores(
            {name: self.means.get(name, MaskedMean()).merge(other.means.get(name, MaskedMean())) for name in names},
            self.lock_s + other.lock_s,
            self.identified_s + other.identified_s,
            self.recover_s + other.recover_s,
            self.reliability.merge(other.reliability),
            self.multi_object.merge(other.multi_object),
        )

    def result(self) -> dict[str, Any]:
        """Means by name, the number of frames that count, and of tags; fractions of tags locked and identified, with the
        median times that this took.

        Where objects reappear: also the fraction of reappearances that were locked again, and the median time to that.
        Undefined numbers are None, so that the result is plain JSON.
        """
        numbers: dict[str, Any] = {name: mean.result() if mean.count else None for name, mean in self.means.items()}
        numbers["num_frames"] = self.means["iou"].count if "iou" in self.means else 0
        numbers["num_tags"] = len(self.lock_s)
        numbers["locked"], numbers["time_to_lock_s"] = _reached(self.lock_s)
        numbers["identified_tags"], numbers["time_to_identification_s"] = _reached(self.identified_s)
        if self.recover_s:
            numbers["recovered"], numbers["time_to_recover_s"] = _reached(self.recover_s)
        return {**numbers, **self.reliability.result(), **self.multi_object.result()}


def _mean_of_one(value: float) -> MaskedMean:
    return MaskedMean() if np.isnan(value) else MaskedMean(value, 1)


def _reached(times_s: tuple[float, ...]) -> tuple[float | None, float | None]:
    """The fraction of the times that are finite, and the median of these."""
    finite = [time_s for time_s in times_s if np.isfinite(time_s)]
    return len(finite) / len(times_s) if times_s else None, float(np.median(finite)) if finite else None
