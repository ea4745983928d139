"""Trace whole recordings and score the traces against their truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from ..recording import Recording, RecordingError
from ..tracing.recordings import TraceSettings, trace_recording
from ..tracing.tracer import AbstractSmoother, AbstractTracer, Trace
from . import tracking
from .tracking import FrameScores, Scores


@dataclasses.dataclass(frozen=True)
class ScoreSettings(TraceSettings):
    """Which frames are scored, and how."""

    moved_for_s: float = 1.5  # frames of a tag are scored once it has moved for this long in total
    min_speed_m_s: float = 0.1  # lower speeds do not count as motion
    frames: tuple[int, int] | None = None  # only frames from <= number < to are scored; all are traced
    moved_restarts: bool = False  # True: after an unknown position the time of motion starts anew
    border_px: float = 2.0  # objects within this margin of the labelled area's edge are not scored: they may be cut off
    threshold: float = 0.5  # box IoU of a lock and of a success
    lock_frames: int = 5
    min_pixels: int = 100  # objects with fewer visible pixels are not scored
    mask_level: float = 0.5  # threshold of soft masks
    num_pictures: int = 12  # overlay pictures a recording, evenly spread

    def __post_init__(self) -> None:
        super().__post_init__()
        minimum = {"lock_frames": 1, "num_pictures": 0, "min_pixels": 0}
        minimum |= {"moved_for_s": 0, "min_speed_m_s": 0, "border_px": 0}
        for name, lowest in minimum.items():
            if not getattr(self, name) >= lowest:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {lowest}.")
        for name in ("threshold", "mask_level"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a value from 0 to 1.")
        if self.frames is not None and not 0 <= self.frames[0] < self.frames[1]:
            raise ValueError(f"frames is {list(self.frames)}; expected [from, to] with 0 <= from < to.")

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
    found: Bool[np.ndarray, " tag"]


@dataclasses.dataclass(frozen=True)
class RecordingResult:
    """Scores of every tag of one recording (none without truth), and the pictures kept.

    `unlabelled` holds, for each tag whose object has no label (a tag on a shelf, say), the frames in which it was detected.
    """

    recording: Recording
    frames: dict[str, FrameScores]
    pictures: list[Picture]
    settings: ScoreSettings
    unlabelled: dict[str, Bool[np.ndarray, " time"]] = dataclasses.field(default_factory=dict)

    def tag_scores(self) -> dict[str, Scores]:
        """The scores of each tag by itself."""
        chosen = self.settings
        return {
            epc: Scores.of(frames, threshold=chosen.threshold, lock_frames=chosen.lock_frames)
            for epc, frames in self.frames.items()
        }

    def scores(self) -> Scores:
        """All tags together; every frame has the same weight."""
        total = Scores()
        for scores in self.tag_scores().values():
            total = total.merge(scores)
        for detected in self.unlabelled.values():
            total = total.merge(Scores.of_unlabelled(detected))
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
    stride: int,
    epcs: Sequence[str] | None = None,
    settings: ScoreSettings | None = None,
    frames: tuple[int, int] | None = None,
    on_frame: Callable[[], None] | None = None,
) -> RecordingResult:
    """Trace a recording and score every tag whose object is labelled; without truth only pictures are returned.

    Boxes and masks are compared at the size of the full picture. `stride` is that of `load`; `on_frame` is called after
    each frame.
    """
    settings = settings or ScoreSettings()
    names = recording.resolve_epcs(epcs)
    trace = trace_recording(tracer, recording, load, epcs=names, settings=settings, frames=frames)
    return score_traces(trace, recording, names, stride=stride, settings=settings, frames=frames, on_frame=on_frame)


def score_traces(
    traces: Iterable[tuple[int, Trace]],
    recording: Recording,
    names: Sequence[str],
    *,
    stride: int = 1,
    settings: ScoreSettings | None = None,
    frames: tuple[int, int] | None = None,
    on_frame: Callable[[], None] | None = None,
) -> RecordingResult:
    """`evaluate_recording` for given traces of the tags `names`, frame by frame (as `trace_recording` yields them)."""
    settings = settings or ScoreSettings()
    first, last = frames or (0, recording.num_frames)
    height, width = recording.image_shape
    truth = recording.truth
    scored = {epc: truth.tag_to_label[epc] for epc in names if truth is not None and epc in truth.tag_to_label}
    if truth is None or truth.labels is None:
        scored = {}
    kept = set(np.linspace(first, last - 1, settings.num_pictures).astype(int).tolist())
    rows: dict[str, list[tuple[Any, ...]]] = {epc: [] for epc in scored}
    detections: dict[str, list[bool]] = {epc: [] for epc in names if scored and epc not in scored}
    pictures: list[Picture] = []
    for number, trace in traces:
        boxes = box_to_picture(np.asarray(trace.box_px), stride, height, width)
        masks = {
            tag: mask_to_picture(np.asarray(trace.mask[tag]), stride, height, width) >= settings.mask_level
            for tag, epc in enumerate(names)
            if epc in scored or number in kept
        }
        labels = np.asarray(truth.labels[number]) if truth is not None and truth.labels is not None else None
        if labels is not None:
            for tag, epc in enumerate(names):
                if epc in scored:
                    rows[epc].append(
                        (
                            *_score_frame(masks[tag], boxes[tag], labels, scored[epc], settings),
                            float(trace.confidence[tag]),
                            bool(trace.detected[tag]),
                        )
                    )
        for tag, epc in enumerate(names):
            if epc in detections:
                detections[epc].append(bool(trace.detected[tag]))
        if number in kept:
            pictures.append(
                Picture(
                    number,
                    tuple(names),
                    np.stack([masks[tag] for tag in range(len(names))]),
                    boxes,
                    np.asarray(trace.confidence, np.float64),
                    np.asarray(trace.detected, bool),
                )
            )
        if on_frame is not None:
            on_frame()
    results = {epc: _tag_frames(recording, epc, scored[epc], rows[epc], (first, last), settings) for epc in scored}
    unlabelled = {epc: np.array(frames_detected, dtype=bool) for epc, frames_detected in detections.items()}
    return RecordingResult(recording, results, pictures, settings, unlabelled)


def _score_frame(
    mask: np.ndarray, box_px: np.ndarray, labels: np.ndarray, label: int, settings: ScoreSettings
) -> tuple[float, float, float, int, bool]:
    true_box = tracking.label_box(labels, label)
    large_enough = int(np.sum(labels == label)) >= settings.min_pixels
    whole = large_enough and not bool(
        tracking.touches_border(true_box, tracking.labelled_area(labels), margin_px=settings.border_px)
    )
    return (
        float(tracking.box_iou(box_px, true_box)),
        float(tracking.centre_error(box_px, true_box, labels.shape[1])),
        tracking.mask_iou(mask, labels, label),
        tracking.best_covered_label(mask, labels, min_pixels=settings.min_pixels),
        whole,
    )


def _tag_frames(
    recording: Recording,
    epc: str,
    label: int,
    rows: list[tuple[Any, ...]],
    frames: tuple[int, int],
    settings: ScoreSettings,
) -> FrameScores:
    truth = recording.truth
    if truth is None:
        raise RecordingError(f"{recording.name}: there is no truth to score {epc} against.")
    part = slice(*frames)
    time_s = recording.frame_time_s()
    iou, cle_px, mask_j, identified, visible, confidence, detected = (
        np.array(column) for column in zip(*rows, strict=True)
    )
    if label in truth.visible:
        visible = visible & np.asarray(truth.visible[label], bool)[part]
    has_moved = tracking.moved_for(
        truth,
        epc,
        time_s,
        settings.moved_for_s,
        min_speed_m_s=settings.min_speed_m_s,
        restarts=settings.moved_restarts,
    )
    if settings.frames is not None:
        number = np.arange(len(has_moved))
        has_moved = has_moved & (number >= settings.frames[0]) & (number < settings.frames[1])
    return FrameScores(
        time_s=time_s[part],
        iou=iou.astype(np.float64),
        cle_px=cle_px.astype(np.float64),
        mask_j=mask_j.astype(np.float64),
        identified=identified.astype(np.int64),
        confidence=confidence.astype(np.float64),
        detected=detected.astype(bool),
        visible=visible.astype(bool),
        has_moved=has_moved[part],
        label=label,
    )
