"""Tracking metrics against labelled truth: box IoU, centre error, mask J, identification, time to lock.

Host-side NumPy. Every metric is computed per frame with a validity mask and accumulated as state -> merge -> result, so
that clips, tags and recordings are scored one by one and merged afterwards.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float, Int, Integer, Shaped

from ..recording import Truth

REFERENCE_WIDTH_PX = 512
"""Centre errors are scaled to a picture of this width (Kinect v2's depth camera, as in TagAttention)."""


def box_iou(
    box_a_px: Shaped[np.ndarray, "*batch 4"], box_b_px: Shaped[np.ndarray, "*batch 4"]
) -> Float[np.ndarray, "*batch"]:
    """Intersection over union of boxes x0 y0 x1 y1 with inclusive pixel edges (TagAttention, Eq. 8).

    Pixels have unit size, so a box spans x1 - x0 + 1. 0 where either box is NaN or has a negative side.
    """
    a, b = np.asarray(box_a_px, np.float64), np.asarray(box_b_px, np.float64)
    side_a, side_b = a[..., 2:] - a[..., :2] + 1.0, b[..., 2:] - b[..., :2] + 1.0
    with np.errstate(invalid="ignore"):
        overlap = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]) + 1.0
        proper = np.all(side_a > 0, axis=-1) & np.all(side_b > 0, axis=-1)
        intersection = np.prod(np.maximum(overlap, 0.0), axis=-1)
        union = np.prod(side_a, axis=-1) + np.prod(side_b, axis=-1) - intersection
    return np.where(proper, np.divide(intersection, union, out=np.zeros_like(union), where=proper & (union > 0)), 0.0)


def centre_error(
    box_a_px: Shaped[np.ndarray, "*batch 4"], box_b_px: Shaped[np.ndarray, "*batch 4"], width: int
) -> Float[np.ndarray, "*batch"]:
    """Distance between box centres in pixels of a 512-pixel-wide picture; NaN where a box is NaN.

    `width` is the width of the picture to which the boxes belong, pixels.
    """
    a, b = np.asarray(box_a_px, np.float64), np.asarray(box_b_px, np.float64)
    gap = 0.5 * (a[..., :2] + a[..., 2:] - b[..., :2] - b[..., 2:])
    return np.asarray(np.linalg.norm(gap, axis=-1) * (REFERENCE_WIDTH_PX / width))


def mask_iou(mask: Bool[np.ndarray, "height width"], labels: Integer[np.ndarray, "height width"], label: int) -> float:
    """Region similarity J: IoU of a mask with a labelled object, pixels labelled 255 (ignore) left out of both.

    NaN where both are empty.
    """
    counted = labels != Truth.IGNORE
    predicted, true = mask & counted, labels == label
    union = int(np.sum(predicted | true))
    return float(np.sum(predicted & true) / union) if union else float("nan")


def best_covered_label(
    mask: Bool[np.ndarray, "height width"], labels: Integer[np.ndarray, "height width"], *, min_pixels: int = 20
) -> int:
    """The label of the object of which the mask covers the largest fraction; 0 if it covers none.

    Objects with fewer than `min_pixels` visible pixels are ignored: masks cover these by chance.
    """
    area = np.bincount(labels.reshape(-1), minlength=256).astype(np.float64)
    covered = np.bincount(labels[mask], minlength=256).astype(np.float64)
    area[[0, Truth.IGNORE]] = covered[[0, Truth.IGNORE]] = 0
    fraction = np.where(area >= min_pixels, covered / np.maximum(area, 1.0), 0.0)
    return int(np.argmax(fraction)) if fraction.max() > 0 else 0


def label_box(labels: Integer[np.ndarray, "height width"], label: int) -> Float[np.ndarray, " 4"]:
    """Tight box x0 y0 x1 y1 (inclusive) around a labelled object; NaN if it is not visible."""
    own = labels == label
    rows, columns = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
    if not len(rows):
        return np.full(4, np.nan)
    return np.array([columns[0], rows[0], columns[-1], rows[-1]], dtype=np.float64)


def labelled_area(labels: Integer[np.ndarray, "height width"]) -> Float[np.ndarray, " 4"]:
    """Box x0 y0 x1 y1 (inclusive) of the labelled area: rows and columns at the edges that are all 255 (ignore) are cut."""
    known = labels != Truth.IGNORE
    rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
    if not len(rows):
        return np.full(4, np.nan)
    return np.array([columns[0], rows[0], columns[-1], rows[-1]], dtype=np.float64)


def touches_border(
    box_px: Shaped[np.ndarray, "*batch 4"], area_px: Float[np.ndarray, " 4"], *, margin_px: float = 0.0
) -> Bool[np.ndarray, "*batch"]:
    """Whether a box is within `margin_px` of the edge of the labelled area, where the object may be cut off."""
    x0, y0, x1, y1 = np.moveaxis(np.asarray(box_px, np.float64), -1, 0)
    left, top, right, bottom = np.asarray(area_px) + margin_px * np.array([1.0, 1.0, -1.0, -1.0])
    return np.asarray((x0 <= left) | (y0 <= top) | (x1 >= right) | (y1 >= bottom))


def time_to_lock(
    iou: Float[np.ndarray, " time"],
    valid: Bool[np.ndarray, " time"],
    time_s: Float[np.ndarray, " time"],
    *,
    threshold: float = 0.5,
    num_frames: int = 5,
) -> float:
    """Seconds from the first valid frame to the first of `num_frames` valid frames in a row with IoU >= threshold.

    Invalid frames are skipped: they neither interrupt nor lengthen the sequence. Infinite if there is no lock, NaN
    without a valid frame.
    """
    frames = np.flatnonzero(valid)
    if not len(frames):
        return float("nan")
    good = np.asarray(iou)[frames] >= threshold
    row = 0
    for i, locked in enumerate(good):
        row = row + 1 if locked else 0
        if row == num_frames:
            return float(time_s[frames[i - num_frames + 1]] - time_s[frames[0]])
    return float("inf")


def times_to_recover(
    iou: Float[np.ndarray, " time"],
    visible: Bool[np.ndarray, " time"],
    time_s: Float[np.ndarray, " time"],
    *,
    threshold: float = 0.5,
    num_frames: int = 5,
    hidden_frames: int = 3,
) -> tuple[float, ...]:
    """Seconds to lock again, one value for every reappearance of the object after `hidden_frames` or more.

    Each is `time_to_lock` from the reappearance to the next disappearance of that length: infinite without a lock in
    between, and left out where the object is visible for fewer than `num_frames` frames.
    """
    visible = np.asarray(visible, bool)
    edges = np.diff(np.concatenate([[0], visible.astype(np.int8), [0]]))
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    long = begins[1:] - ends[:-1] >= hidden_frames
    starts = begins[1:][long]
    stops = [
        int(ends[:-1][long][number + 1]) if number + 1 < len(starts) else len(visible) for number in range(len(starts))
    ]
    times = []
    for start, stop in zip(starts, stops, strict=True):
        part = slice(int(start), stop)
        if np.sum(visible[part]) >= num_frames:
            times.append(
                time_to_lock(iou[part], visible[part], time_s[part], threshold=threshold, num_frames=num_frames)
            )
    return tuple(times)


def moved_for(
    truth: Truth,
    epc: str,
    time_s: Float[np.ndarray, " time"],
    seconds: float,
    *,
    min_speed_m_s: float = 0.1,
    restarts: bool = False,
) -> Bool[np.ndarray, " time"]:
    """Frames at which the tag has moved for `seconds` in total since the recording's start.

    The speed is that of the true position, or of the true range where no position is known. Frames where neither is known
    add nothing; with `restarts` they reset the total. Without any such truth every frame counts if `seconds` is 0, else
    none does.
    """
    if seconds <= 0:
        return np.ones(len(time_s), dtype=bool)
    if epc in truth.tag_position_m:
        place = np.asarray(truth.tag_position_m[epc], np.float64)
    elif epc in truth.tag_range_m:
        place = np.asarray(truth.tag_range_m[epc], np.float64)[:, None]
    else:
        return np.zeros(len(time_s), dtype=bool)
    step_s = np.diff(time_s, prepend=time_s[:1])
    step_m = np.linalg.norm(np.diff(place, axis=0, prepend=place[:1]), axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        moving = np.nan_to_num(step_m / step_s) > min_speed_m_s
    total = np.cumsum(np.where(moving, step_s, 0.0))
    if restarts:
        unknown = ~np.all(np.isfinite(place), axis=-1)
        total = total - np.maximum.accumulate(np.where(unknown, total, 0.0))
    return total >= seconds - 1e-9


@dataclasses.dataclass(frozen=True)
class MaskedMean:
    """Mean over valid elements as a mergeable state; its result is NaN without any."""

    total: float = 0.0
    count: int = 0

    @classmethod
    def of(cls, values: Shaped[np.ndarray, "*shape"], valid: Bool[np.ndarray, "*shape"]) -> MaskedMean:
        """The state of these values; NaN values count as invalid."""
        values = np.asarray(values, np.float64)
        kept = values[valid & np.isfinite(values)]
        return cls(float(kept.sum()), len(kept))

    def merge(self, other: MaskedMean) -> MaskedMean:
        return MaskedMean(self.total + other.total, self.count + other.count)

    def result(self) -> float:
        return self.total / self.count if self.count else float("nan")


@dataclasses.dataclass(frozen=True)
class FrameScores:
    """One tag's scores at every frame, before any selection."""

    time_s: Float[np.ndarray, " time"]
    iou: Float[np.ndarray, " time"]
    cle_px: Float[np.ndarray, " time"]
    mask_j: Float[np.ndarray, " time"]
    identified: Int[np.ndarray, " time"]  # the label most covered by the mask, 0 = none
    confidence: Float[np.ndarray, " time"]
    detected: Bool[np.ndarray, " time"]  # the tracer reports a detection
    visible: Bool[np.ndarray, " time"]  # the whole object is visible in the truth
    has_moved: Bool[np.ndarray, " time"]  # it has moved for the required time
    label: int

    @property
    def valid(self) -> Bool[np.ndarray, " time"]:
        return self.visible & self.has_moved


@dataclasses.dataclass(frozen=True)
class Scores:
    """Accumulated scores of any number of tags.

    A frame without a detection has IoU 0 and counts as not identified; its centre error is undefined and left out, so
    read `cle_px` together with `detected`.
    """

    means: Mapping[str, MaskedMean] = dataclasses.field(default_factory=dict)
    lock_s: tuple[float, ...] = ()  # one element a tag with a visible object
    recover_s: tuple[float, ...] = ()  # one element a reappearance of a tag's object

    @classmethod
    def of(cls, frames: FrameScores, *, threshold: float = 0.5, lock_frames: int = 5) -> Scores:
        """The state of one tag."""
        valid, detected = frames.valid, frames.detected
        iou = np.where(detected, frames.iou, 0.0)
        columns = {
            "iou": iou,
            "cle_px": np.where(detected, frames.cle_px, np.nan),
            "mask_j": np.where(detected, frames.mask_j, 0.0),
            "identification": (detected & (frames.identified == frames.label)).astype(np.float64),
            "success": (iou >= threshold).astype(np.float64),
            "detected": detected.astype(np.float64),
            "confidence": frames.confidence,
        }
        rule = {"threshold": threshold, "num_frames": lock_frames}
        lock = time_to_lock(iou, frames.visible, frames.time_s, **rule)
        return cls(
            {name: MaskedMean.of(values, valid) for name, values in columns.items()},
            () if np.isnan(lock) else (lock,),
            times_to_recover(iou, frames.visible, frames.time_s, **rule),
        )

    @classmethod
    def of_unlabelled(cls, detected: Bool[np.ndarray, " time"]) -> Scores:
        """The state of a tag whose object has no label: each of its detections is false."""
        return cls({"false_detections": MaskedMean.of(detected, np.ones_like(detected))})

    def merge(self, other: Scores) -> Scores:
        names = {**self.means, **other.means}
        return Scores(
            {name: self.means.get(name, MaskedMean()).merge(other.means.get(name, MaskedMean())) for name in names},
            self.lock_s + other.lock_s,
            self.recover_s + other.recover_s,
        )

    def result(self) -> dict[str, float | int | None]:
        """Means by name, the number of frames, the fraction of tags locked and the median time to lock of those.

        Where objects reappear: also the fraction of reappearances that were locked again, and the median time to that.
        Undefined numbers are None, so that the result is plain JSON.
        """
        numbers: dict[str, float | int | None] = {}
        for name, mean in self.means.items():
            numbers[name] = mean.result() if mean.count else None
        locked = [lock for lock in self.lock_s if np.isfinite(lock)]
        of_objects = (mean.count for name, mean in self.means.items() if name != "false_detections")
        numbers["num_frames"] = max(of_objects, default=0)
        numbers["num_tags"] = len(self.lock_s)
        numbers["locked"] = len(locked) / len(self.lock_s) if self.lock_s else None
        numbers["time_to_lock_s"] = float(np.median(locked)) if locked else None
        if self.recover_s:
            recovered = [time for time in self.recover_s if np.isfinite(time)]
            numbers["recovered"] = len(recovered) / len(self.recover_s)
            numbers["time_to_recover_s"] = float(np.median(recovered)) if recovered else None
        return numbers
