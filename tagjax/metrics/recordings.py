"""Trace whole recordings and score the traces against their truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int8, Shaped

from ..core.camera import working_stride
from ..recording import Recording, Truth
from ..tracing.recordings import TraceSettings, trace_recording
from ..tracing.status import status_or_detected
from ..tracing.tracer import AbstractSmoother, AbstractTracer, Trace
from .boxes import box_iou, centre_error, label_box, labelled_area, touches_border
from .locking import first_motion
from .masks import BOUNDARY_PX, best_covered_label, boundary_f, boundary_tolerances_px, mask_iou
from .multi_object import MatchFrame, MultiObjectScores
from .tags import FrameScores, Scores


@dataclasses.dataclass(frozen=True)
class ScoreSettings(TraceSettings):
    """Which frames are scored, and how."""

    min_speed_m_s: float = 0.1  # frames of a tag count from the first time that it is as fast as this
    from_s: float = 0.0  # only frames from this long after that time
    until_s: float | None = None  # to this long after it; to the end if None
    border_px: float = 2.0  # objects within this margin of the labelled area's edge are not scored: they may be cut off
    threshold: float = 0.5  # box IoU of a lock and of a success
    lock_s: float = 0.33  # the time for which a lock has to last
    min_pixels: int = 100  # objects with fewer visible pixels are not scored
    mask_level: float = 0.5  # threshold of soft masks
    num_pictures: int = 12  # overlay pictures a recording, evenly spread
    video: bool = True  # an overlay video of each recording and tracer, which the report's page shows

    def __post_init__(self) -> None:
        super().__post_init__()
        minimum = dict.fromkeys(("num_pictures", "min_pixels", "from_s", "lock_s", "min_speed_m_s", "border_px"), 0)
        for name, lowest in minimum.items():
            if not getattr(self, name) >= lowest:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {lowest}.")
        for name in ("threshold", "mask_level"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a value from 0 to 1.")
        if self.until_s is not None and not self.until_s > self.from_s:
            raise ValueError(f"until_s is {self.until_s}; expected more than from_s, {self.from_s}.")

    def supported_by(self, tracer: AbstractTracer) -> ScoreSettings:
        """These settings, with smoothing switched off for a tracer without a backward pass."""
        return dataclasses.replace(self, smooth=self.smooth and isinstance(tracer, AbstractSmoother))


@dataclasses.dataclass(frozen=True)
class Picture:
    """A tracer's output at one frame, at the size of the full picture, kept for an overlay."""

    frame: int
    epcs: tuple[str, ...]
    masks: Bool[np.ndarray, "tag height width"]
    boxes_px: Float[np.ndarray, "tag 4"]
    confidence: Float[np.ndarray, " tag"]
    detected: Bool[np.ndarray, " tag"]
    status: Int8[np.ndarray, " tag"]  # codes of `Status`
    soft_masks: Float[np.ndarray, "tag rows columns"] | None = None  # the tracer's own, at its resolution


@dataclasses.dataclass(frozen=True)
class RecordingResult:
    """Scores of every tag of one recording whose object is labelled (none without truth), and the pictures kept.

    `unlabelled` holds what is known of the other tags, without truth: those on a shelf, say, or all if nothing is labelled.
    """

    recording: Recording
    frames: dict[str, FrameScores]
    pictures: list[Picture]
    settings: ScoreSettings
    unlabelled: dict[str, FrameScores] = dataclasses.field(default_factory=dict)
    multi_object: MultiObjectScores = dataclasses.field(default_factory=MultiObjectScores)

    def tag_scores(self) -> dict[str, Scores]:
        """The scores of each tag by itself."""
        chosen = self.settings
        return {
            epc: Scores.of(frames, threshold=chosen.threshold, lock_s=chosen.lock_s)
            for epc, frames in self.frames.items()
        }

    def scores(self) -> Scores:
        """All tags together; every frame has the same weight."""
        total = Scores(multi_object=self.multi_object)
        for scores in self.tag_scores().values():
            total = total.merge(scores)
        # Where nothing is labelled, a detection is neither right nor false.
        for frames in self.unlabelled.values() if self.frames else ():
            total = total.merge(Scores.of_false_detections(frames.detected))
        return total


def box_to_picture(
    box_px: Shaped[np.ndarray, "*batch 4"], stride: int, height: int, width: int
) -> Float[np.ndarray, "*batch 4"]:
    """Boxes (inclusive edges) at the working resolution to boxes of the full picture.

    Working pixel i is pixel i * stride of the full picture and represents the `stride` pixels around it.
    """
    margin = 0.5 * (stride - 1)
    box = np.asarray(box_px, np.float64) * stride + np.array([-margin, -margin, margin, margin])
    return np.clip(box, 0.0, np.array([width - 1, height - 1, width - 1, height - 1], dtype=np.float64))


def mask_to_picture(
    mask: Shaped[np.ndarray, "rows columns"], stride: int, height: int, width: int
) -> Float[np.ndarray, "height width"]:
    """Soft mask at the working resolution, interpolated linearly to the full picture."""
    soft = np.asarray(mask, np.float32)
    if stride == 1:
        return soft
    scale = np.array([[stride, 0, 0], [0, stride, 0]], dtype=np.float64)
    return cv2.warpAffine(soft, scale, (width, height), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def evaluate_recording(
    tracer: AbstractTracer,
    recording: Recording,
    load: Callable[..., Any],
    *,
    stride: int | None = None,
    epcs: Sequence[str] | None = None,
    settings: ScoreSettings | None = None,
    frames: tuple[int, int] | None = None,
    on_frame: Callable[[], None] | None = None,
    on_picture: Callable[[Picture], None] | None = None,
) -> RecordingResult:
    """Trace a recording and score every tag whose object is labelled; without truth there are pictures and detections only.

    Boxes and masks are compared at the size of the full picture. `stride` is that of `load`, None the one of the
    picture's width (`working_stride`); `on_frame` is called after each frame, `on_picture` with the picture of each.
    """
    settings = settings or ScoreSettings()
    names = recording.resolve_epcs(epcs)
    trace = trace_recording(tracer, recording, load, epcs=names, settings=settings, frames=frames)
    return score_traces(
        trace,
        recording,
        names,
        stride=stride,
        settings=settings,
        frames=frames,
        on_frame=on_frame,
        on_picture=on_picture,
    )


def score_traces(
    traces: Iterable[tuple[int, Trace]],
    recording: Recording,
    names: Sequence[str],
    *,
    stride: int | None = 1,
    settings: ScoreSettings | None = None,
    frames: tuple[int, int] | None = None,
    on_frame: Callable[[], None] | None = None,
    on_picture: Callable[[Picture], None] | None = None,
) -> RecordingResult:
    """`evaluate_recording` for given traces of the tags `names`, frame by frame (as `trace_recording` yields them)."""
    settings = settings or ScoreSettings()
    first, last = frames or (0, recording.num_frames)
    height, width = recording.image_shape
    stride = working_stride(width, stride)
    truth = recording.truth if recording.truth is not None and recording.truth.labels is not None else None
    scored = {epc: truth.tag_to_label[epc] for epc in names if truth is not None and epc in truth.tag_to_label}
    kept = set(np.linspace(first, last - 1, settings.num_pictures).astype(int).tolist())
    rows: dict[str, list[dict[str, Any]]] = {epc: [] for epc in names}
    found_boxes: list[np.ndarray] = []
    detected: list[np.ndarray] = []
    pictures: list[Picture] = []
    for number, trace in traces:
        boxes = box_to_picture(np.asarray(trace.box_px), stride, height, width)
        found_boxes.append(boxes)
        detected.append(np.asarray(trace.detected, bool))
        status = status_or_detected(trace.status, detected[-1])
        drawn = number in kept or on_picture is not None
        masks = {
            tag: mask_to_picture(np.asarray(trace.mask[tag]), stride, height, width) >= settings.mask_level
            for tag, epc in enumerate(names)
            if epc in scored or drawn
        }
        labels = area_px = None
        if truth is not None and truth.labels is not None and scored:
            labels = np.asarray(truth.labels[number])
            area_px = labelled_area(labels)
        for tag, epc in enumerate(names):
            row = {
                "confidence": float(trace.confidence[tag]),
                "detected": bool(trace.detected[tag]),
                "status": int(status[tag]),
            }
            if truth is not None and labels is not None and area_px is not None and epc in scored:
                row |= _score_frame(masks[tag], boxes[tag], labels, scored[epc], area_px, settings)
                range_m = np.linalg.norm(np.asarray(trace.centre_m[tag], np.float64) - recording.antennas_m[0])
                carrier_px = truth.carrier_box_px[epc][number] if epc in truth.carrier_box_px else np.full(4, np.nan)
                known = bool(np.isfinite(carrier_px).all())
                row["carrier_iou"] = float(box_iou(boxes[tag], carrier_px)) if known else float("nan")
                row["range_error_m"] = float(range_m - _at(truth.tag_range_m, epc, number))
            rows[epc].append(_UNSCORED | row)
        if drawn:
            confidence = np.asarray(trace.confidence, np.float64)
            ordered = np.stack([masks[tag] for tag in range(len(names))])
            picture = Picture(number, tuple(names), ordered, boxes, confidence, detected[-1], status)
            if number in kept:
                soft_masks = np.asarray(trace.mask[: len(names)], np.float32)
                pictures.append(dataclasses.replace(picture, soft_masks=soft_masks))
            if on_picture is not None:
                on_picture(picture)
        if on_frame is not None:
            on_frame()
    tags = {epc: _tag_frames(recording, truth, epc, rows[epc], (first, last), settings) for epc in names}
    labelled = {epc: tags[epc] for epc in names if epc in scored}
    unlabelled = {epc: tags[epc] for epc in names if epc not in scored}
    if not labelled:
        return RecordingResult(recording, {}, pictures, settings, unlabelled)
    found = np.stack(detected)
    multi_object = MultiObjectScores.of(_match_frames(labelled, rows, names, np.stack(found_boxes), found))
    return RecordingResult(recording, labelled, pictures, settings, unlabelled, multi_object)


_UNSCORED: dict[str, Any] = {
    "true_box_px": np.full(4, np.nan),
    **dict.fromkeys(("iou", "cle_px", "mask_j", "carrier_iou", "range_error_m"), float("nan")),
    "boundary_f": np.full(len(BOUNDARY_PX) + 1, np.nan),
    "identified": 0,
    "visible": False,
}
"""A frame of a tag whose object has no label."""


def _score_frame(
    mask: np.ndarray,
    box_px: np.ndarray,
    labels: np.ndarray,
    label: int,
    area_px: np.ndarray,
    settings: ScoreSettings,
) -> dict[str, Any]:
    true_box, true = label_box(labels, label), labels == label
    large_enough = int(np.sum(true)) >= settings.min_pixels
    whole = large_enough and not bool(touches_border(true_box, area_px, margin_px=settings.border_px))
    tolerances = boundary_tolerances_px(*labels.shape)
    counted = labels != Truth.IGNORE
    return {
        "true_box_px": true_box,
        "iou": float(box_iou(box_px, true_box)),
        "cle_px": float(centre_error(box_px, true_box, labels.shape[1])),
        "mask_j": mask_iou(mask, labels, label),
        "boundary_f": boundary_f(mask & counted, true, tolerances) if whole else np.full(len(tolerances), np.nan),
        "identified": best_covered_label(mask, labels, min_pixels=settings.min_pixels),
        "visible": whole,
    }


def _at(values: Mapping[Any, Any], key: Any, frame: int) -> float:
    """An element of a truth's array; NaN where there is none."""
    return float(values[key][frame]) if key in values else float("nan")


def _tag_frames(
    recording: Recording,
    truth: Truth | None,
    epc: str,
    rows: Sequence[Mapping[str, Any]],
    frames: tuple[int, int],
    settings: ScoreSettings,
) -> FrameScores:
    """A tag's frames; without truth, or a label of its object, no frame counts and the label is 0."""
    truth = Truth() if truth is None else truth
    part, label = slice(*frames), truth.tag_to_label.get(epc, 0)
    time_s, frame = recording.frame_time_s(), np.arange(recording.num_frames)
    begin = first_motion(truth, epc, time_s, min_speed_m_s=settings.min_speed_m_s) if label else None
    since = np.full(len(frame), -len(frame)) if begin is None else frame - begin
    elapsed_s = time_s - (time_s[begin] if begin is not None else np.inf)
    until_s = np.inf if settings.until_s is None else settings.until_s
    visible = np.array([row["visible"] for row in rows], dtype=bool)
    if label in truth.visible:
        visible &= np.asarray(truth.visible[label], bool)[part]
    reads, rssi_dbm = recent_reads(recording, epc)
    sight = np.asarray(truth.line_of_sight.get(epc, np.full(len(frame), np.nan)), np.float64)
    columns = {
        name: np.array([row[name] for row in rows])
        for name in ("iou", "cle_px", "mask_j", "carrier_iou", "range_error_m")
    }
    return FrameScores(
        time_s=time_s[part],
        **{name: values.astype(np.float64) for name, values in columns.items()},
        boundary_f=np.array([row["boundary_f"] for row in rows]).reshape(-1, len(BOUNDARY_PX) + 1),
        identified=np.array([row["identified"] for row in rows], dtype=np.int64),
        confidence=np.array([row["confidence"] for row in rows], dtype=np.float64),
        detected=np.array([row["detected"] for row in rows], dtype=bool),
        status=np.array([row["status"] for row in rows], dtype=np.int8),
        visible=visible,
        since_motion=since[part],
        selected=((elapsed_s >= settings.from_s - 1e-9) & (elapsed_s < until_s))[part],
        reads=reads[part],
        rssi_dbm=rssi_dbm[part],
        line_of_sight=sight[part],
        label=label,
        moves=begin is not None,
    )


def recent_reads(recording: Recording, epc: str, *, seconds: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """A tag's number of reads in the time before each frame, (num_frames,), and their mean RSSI, dBm; NaN without a read."""
    reads = recording.reads[recording.reads.epc == epc]
    until = np.searchsorted(reads.time_ns, recording.time_ns, side="right")
    since = np.searchsorted(reads.time_ns, recording.time_ns - round(seconds * 1e9), side="right")
    known = np.isfinite(reads.rssi_dbm)
    sums = np.concatenate([[0.0], np.cumsum(np.where(known, reads.rssi_dbm, 0.0), dtype=np.float64)])
    counts = np.concatenate([[0], np.cumsum(known)])
    number = counts[until] - counts[since]
    mean_dbm = np.where(number > 0, (sums[until] - sums[since]) / np.maximum(number, 1), np.nan)
    return until - since, mean_dbm


def _match_frames(
    tags: Mapping[str, FrameScores],
    rows: Mapping[str, Sequence[Mapping[str, Any]]],
    names: Sequence[str],
    found_boxes: np.ndarray,
    detected: np.ndarray,
) -> list[MatchFrame]:
    """Every frame's true boxes and detections, without the objects that do not count and the detections of these.

    Of two tags on one object only the first is matched: one track of two would be false by definition.
    """
    owner = {tags[epc].label: epc for epc in reversed(list(tags))}
    extra = {epc for epc, frames in tags.items() if owner[frames.label] != epc}
    columns = np.array([tag for tag, epc in enumerate(names) if epc not in extra], dtype=int)
    labels = np.array(sorted(owner), dtype=int)
    valid = np.stack([tags[owner[int(label)]].valid for label in labels], axis=1)
    true_boxes = np.stack([[row["true_box_px"] for row in rows[owner[int(label)]]] for label in labels], axis=1)
    matches = []
    for frame in range(len(detected)):
        there = np.isfinite(true_boxes[frame]).all(axis=-1)
        found = columns[detected[frame, columns]]
        overlap = box_iou(
            np.repeat(true_boxes[frame][there][:, None], len(found), axis=1),
            np.repeat(found_boxes[frame][found][None], int(there.sum()), axis=0),
        )
        one = MatchFrame(labels[there], found, overlap)
        matches.append(one.without_ignored(labels[~valid[frame]]))
    return matches
