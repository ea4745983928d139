"""One recording of Tagview's experiments: track all objects, identify the traces, compare both with the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ....recording import Recording
from ...boxes import box_centre_px, box_iou
from ...host_tracer import HostCamera, host_frames
from ..matching import Identification
from ..tracer import TagviewState, TagviewTracer

SAME_IOU = 0.3
"""Smallest IoU of a trace's box with the object that it follows."""

MAX_MISSED_FRAMES = 3
"""An object out of sight for no more frames is still in the same stretch."""

MIN_COVERED = 0.5
"""A stretch counts as identified if at least this fraction of its frames is."""


@dataclasses.dataclass(frozen=True)
class TrackedRecording:
    """The camera's part of a recording, done once, and its truth. Objects are those with tags, in the tags' order."""

    name: str
    epcs: tuple[str, ...]
    camera: HostCamera
    state: TagviewState
    box_px: Float[np.ndarray, "traces frames 4"]  # NaN where not seen
    truth_px: Float[np.ndarray, "objects frames 4"]
    object_of: Int[np.ndarray, " traces"]  # the object that a trace follows; -1 for none
    mm_per_px: float  # on the plane, at the principal point


def track_recording(tracer: TagviewTracer, recording: Recording) -> TrackedRecording:
    """Detect and track through a whole recording. Raises `ValueError` for one without true boxes of tagged objects.

    The tracer's memory must span the recording. Tags that were never read have objects all the same.
    """
    truth = recording.truth
    if truth is None or truth.boxes_px is None or not truth.tag_to_label:
        raise ValueError(
            f"{recording.name}: no true boxes of tagged objects, expected some. Use a simulated recording."
        )
    epcs = tuple(sorted(truth.tag_to_label))
    camera = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m, np.float64), epcs)
    state = tracer.init(camera)
    for frame in host_frames(recording, epcs):
        state = tracer.observe(state, frame)
    boxes, _, _ = tracer.boxes(state)
    rows = [truth.tag_to_label[epc] - 1 for epc in epcs]
    true_px = np.moveaxis(np.asarray(truth.boxes_px, np.float64)[:, rows], 1, 0)
    return TrackedRecording(
        name=recording.name,
        epcs=epcs,
        camera=camera,
        state=state,
        box_px=boxes,
        truth_px=true_px,
        object_of=objects_of_traces(boxes, true_px),
        mm_per_px=1e3 * plane_depth_m(recording) / recording.intrinsics.fx_px,
    )


def plane_depth_m(recording: Recording) -> float:
    """Median depth of the labelled tags, from the truth."""
    truth = recording.truth
    assert truth is not None
    return float(np.nanmedian([np.nanmedian(truth.tag_position_m[epc][:, 2]) for epc in sorted(truth.tag_to_label)]))


def objects_of_traces(
    box_px: Float[np.ndarray, "traces frames 4"], truth_px: Float[np.ndarray, "objects frames 4"]
) -> Int[np.ndarray, " traces"]:
    """The object that each trace overlaps in most of its frames, by `SAME_IOU`; -1 where that is less than half."""
    found = np.full(len(box_px), -1)
    for row, boxes in enumerate(box_px):
        seen = np.flatnonzero(np.isfinite(boxes[:, 0]))
        counts = np.zeros(len(truth_px))
        for frame in seen:
            counts += np.nan_to_num(box_iou(boxes[frame][None], truth_px[:, frame])[0]) >= SAME_IOU
        if len(counts) and counts.max() >= 0.5 * len(seen):
            found[row] = int(counts.argmax())
    return found


def visible_stretches(seen: Bool[np.ndarray, " frames"], min_frames: int) -> list[tuple[int, int]]:
    """First frame and one past the last of each stretch in sight, with gaps of `MAX_MISSED_FRAMES` closed.

    Stretches of less than `min_frames` are left out.
    """
    frames = np.flatnonzero(seen)
    if not len(frames):
        return []
    breaks = np.flatnonzero(np.diff(frames) > MAX_MISSED_FRAMES + 1)
    first, last = np.append(frames[0], frames[breaks + 1]), np.append(frames[breaks], frames[-1])
    return [(int(a), int(b) + 1) for a, b in zip(first, last, strict=True) if b - a + 1 >= min_frames]


@dataclasses.dataclass(frozen=True)
class RecordingScore:
    """The counts of a recording with one setting."""

    recording: str
    num_tags: int
    num_traces: int  # of tagged objects
    num_false: int  # traces of no tagged object
    num_correct: int  # traces identified as their object
    num_identified: int  # traces that got a tag
    num_stretches: int  # in sight, by the truth
    num_covered: int  # of those, correctly identified in most of their frames
    error_px: Float[np.ndarray, " boxes"]  # of centres, all traces of tagged objects
    r_squared: Float[np.ndarray, "2 _"]  # of pairs: value, and 1 where the pair is correct
    slope: Float[np.ndarray, "2 _"]  # relative to 4 pi h / wavelength with the true height
    gap: float  # of the programme; 0 if solved to the optimum


def score_recording(
    tracked: TrackedRecording, found: Identification, *, min_frames: int, true_slope: float
) -> RecordingScore:
    """Counts of an identification against the truth. `true_slope` is 4 pi h / wavelength, rad."""
    object_of, tag_of = tracked.object_of, found.tag_of
    correct = (object_of >= 0) & (tag_of == object_of)
    stretches = covered = 0
    for number, boxes in enumerate(tracked.truth_px):
        identified = np.any(np.isfinite(tracked.box_px[correct & (object_of == number), :, 0]), axis=0)
        for first, last in visible_stretches(np.isfinite(boxes[:, 0]), min_frames):
            stretches += 1
            covered += bool(np.mean(identified[first:last]) >= MIN_COVERED)
    real = np.flatnonzero(object_of >= 0)
    errors = [
        np.linalg.norm(box_centre_px(tracked.box_px[row]) - box_centre_px(tracked.truth_px[object_of[row]]), axis=1)
        for row in real
    ]
    error_px = np.concatenate(errors) if errors else np.zeros(0)
    pair = (object_of[real, None] == np.arange(len(tracked.epcs))[None, :]).ravel().astype(np.float64)
    return RecordingScore(
        recording=tracked.name,
        num_tags=len(tracked.epcs),
        num_traces=len(real),
        num_false=int(np.sum(object_of < 0)),
        num_correct=int(correct.sum()),
        num_identified=int(np.sum(tag_of >= 0)),
        num_stretches=stretches,
        num_covered=covered,
        error_px=error_px[np.isfinite(error_px)],
        r_squared=np.stack([found.r_squared[real].ravel(), pair]),
        slope=np.stack([found.slope[real].ravel() / true_slope, pair]),
        gap=0.0 if found.selection is None else found.selection.gap,
    )


def summarise(scores: Sequence[RecordingScore]) -> dict[str, Any]:
    """Fractions and counts over recordings; None where there is nothing to divide by.

    Accuracy: correctly identified traces of all traces of tagged objects (VI.D). Precision: of all identified traces.
    Recall: of all true stretches in sight. The tracking error is over all boxes of tagged objects' traces.
    """

    def fraction(part: str, whole: str) -> float | None:
        return total(part) / total(whole) if total(whole) else None

    def total(name: str) -> int:
        return sum(getattr(one, name) for one in scores)

    errors = np.concatenate([one.error_px for one in scores] or [np.zeros(0)])
    return {
        "num_recordings": len(scores),
        "num_traces": total("num_traces"),
        "num_false_traces": total("num_false"),
        "accuracy": fraction("num_correct", "num_traces"),
        "precision": fraction("num_correct", "num_identified"),
        "recall": fraction("num_covered", "num_stretches"),
        "tracking_error_px": float(errors.mean()) if len(errors) else None,
        "tracking_error_std_px": float(errors.std()) if len(errors) else None,
        "largest_gap": max((one.gap for one in scores), default=0.0),
    }


def quartiles(scores: Sequence[RecordingScore], kind: str) -> dict[str, list[float] | None]:
    """Lower quartile, median and upper quartile of `r_squared` or `slope`, of correct and of incorrect pairs."""
    rows = np.concatenate([getattr(one, kind) for one in scores] or [np.zeros((2, 0))], axis=1)
    parts = {"correct": rows[0, rows[1] == 1], "incorrect": rows[0, rows[1] == 0]}
    return {
        name: [float(value) for value in np.quantile(part, [0.25, 0.5, 0.75])] if len(part) else None
        for name, part in parts.items()
    }
