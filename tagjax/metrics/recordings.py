"""Run a tracer over whole recordings and score what it says against their truth."""

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
from . import tracking as metrics
from .tracking import FrameScores, Scores


@dataclasses.dataclass(frozen=True)
class ScoreSettings(TraceSettings):
    """What counts, and how much is traced at once."""

    moved_for_s: float = 1.5  # score a tag once it has moved for this long
    min_speed_m_s: float = 0.1  # slower than this is no motion
    frames: tuple[int, int] | None = None  # only these (from, to) are scored; all are traced
    moved_restarts: bool = False  # whether a tag that was out of sight has to move that long again
    border_px: float = 2.0  # an object this near to the edge of the labelled area may be cut off: not scored
    threshold: float = 0.5  # IoU of a lock and of a success
    lock_frames: int = 5
    min_pixels: int = 100  # an object that shows less is not scored
    mask_level: float = 0.5  # soft masks are cut here
    num_pictures: int = 12  # frames kept for overlay pictures, spread over the recording

    def __post_init__(self) -> None:
        super().__post_init__()
        least = {"lock_frames": 1, "num_pictures": 0, "min_pixels": 0}
        least |= {"moved_for_s": 0, "min_speed_m_s": 0, "border_px": 0}
        for name, lowest in least.items():
            if not getattr(self, name) >= lowest:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {lowest}.")
        for name in ("threshold", "mask_level"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a share from 0 to 1.")
        if self.frames is not None and not 0 <= self.frames[0] < self.frames[1]:
            raise ValueError(f"frames is {list(self.frames)}; expected [from, to] with 0 <= from < to.")

    def able(self, tracer: AbstractTracer) -> ScoreSettings:
        """These, without smoothing for a tracer that goes forwards only."""
        return dataclasses.replace(self, smooth=self.smooth and isinstance(tracer, AbstractSmoother))


@dataclasses.dataclass(frozen=True)
class Picture:
    """What a tracer said at one frame, at the full picture's size, kept to be drawn."""

    frame: int
    epcs: tuple[str, ...]
    masks: Bool[np.ndarray, "tag height width"]
    boxes_px: Float[np.ndarray, "tag 4"]
    confidence: Float[np.ndarray, " tag"]
    found: Bool[np.ndarray, " tag"]


@dataclasses.dataclass(frozen=True)
class RecordingResult:
    """Scores of every tag of one recording (none without truth), and the pictures kept.

    `no_object` are the tags that no labelled object carries (left lying on a shelf), and when each of them was claimed.
    """

    recording: Recording
    frames: dict[str, FrameScores]
    pictures: list[Picture]
    settings: ScoreSettings
    no_object: dict[str, Bool[np.ndarray, " time"]] = dataclasses.field(default_factory=dict)

    def tag_scores(self) -> dict[str, Scores]:
        """The scores of each tag by itself."""
        chosen = self.settings
        return {
            epc: Scores.of(frames, threshold=chosen.threshold, lock_frames=chosen.lock_frames)
            for epc, frames in self.frames.items()
        }

    def scores(self) -> Scores:
        """All tags together, each frame counting the same."""
        total = Scores()
        for scores in self.tag_scores().values():
            total = total.merge(scores)
        for found in self.no_object.values():
            total = total.merge(Scores.of_no_object(found))
        return total


def box_to_picture(
    box_px: Shaped[np.ndarray, "*batch 4"], stride: int, height: int, width: int
) -> Float[np.ndarray, "*batch 4"]:
    """Inclusive box edges at every `stride`-th pixel to those of the full picture.

    Working pixel i is the full picture's pixel i * stride and stands for the `stride` pixels around it.
    """
    reach = 0.5 * (stride - 1)
    box = np.asarray(box_px, np.float64) * stride + np.array([-reach, -reach, reach, reach])
    return np.clip(box, 0.0, np.array([width - 1, height - 1, width - 1, height - 1], dtype=np.float64))


def mask_to_picture(
    mask: Shaped[np.ndarray, "rows columns"], stride: int, height: int, width: int
) -> Float[np.ndarray, "height width"]:
    """Soft mask at every `stride`-th pixel, interpolated linearly to the full picture."""
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
    """Trace a recording and score every tag whose object the truth labels; without truth only pictures come back.

    Boxes and masks are compared at the full picture's size. `stride` is the one `load` works with; `on_frame` is
    called after each frame.
    """
    settings = settings or ScoreSettings()
    names = recording.resolve_epcs(epcs)
    said = trace_recording(tracer, recording, load, epcs=names, settings=settings, frames=frames)
    return score_traces(said, recording, names, stride=stride, settings=settings, frames=frames, on_frame=on_frame)


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
    """`evaluate_recording` of what any tracer says, frame by frame, of the tags `names` (`trace_recording`)."""
    settings = settings or ScoreSettings()
    first, last = frames or (0, recording.num_frames)
    height, width = recording.image_shape
    truth = recording.truth
    scored = {epc: truth.tag_to_label[epc] for epc in names if truth is not None and epc in truth.tag_to_label}
    if truth is None or truth.labels is None:
        scored = {}
    kept = set(np.linspace(first, last - 1, settings.num_pictures).astype(int).tolist())
    rows: dict[str, list[tuple[Any, ...]]] = {epc: [] for epc in scored}
    claims: dict[str, list[bool]] = {epc: [] for epc in names if scored and epc not in scored}
    pictures: list[Picture] = []
    for number, said in traces:
        boxes = box_to_picture(np.asarray(said.box_px), stride, height, width)
        masks = {
            tag: mask_to_picture(np.asarray(said.mask[tag]), stride, height, width) >= settings.mask_level
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
                            float(said.confidence[tag]),
                            bool(said.found[tag]),
                        )
                    )
        for tag, epc in enumerate(names):
            if epc in claims:
                claims[epc].append(bool(said.found[tag]))
        if number in kept:
            pictures.append(
                Picture(
                    number,
                    tuple(names),
                    np.stack([masks[tag] for tag in range(len(names))]),
                    boxes,
                    np.asarray(said.confidence, np.float64),
                    np.asarray(said.found, bool),
                )
            )
        if on_frame is not None:
            on_frame()
    results = {epc: _tag_frames(recording, epc, scored[epc], rows[epc], (first, last), settings) for epc in scored}
    no_object = {epc: np.array(found, dtype=bool) for epc, found in claims.items()}
    return RecordingResult(recording, results, pictures, settings, no_object)


def _score_frame(
    mask: np.ndarray, box_px: np.ndarray, labels: np.ndarray, label: int, settings: ScoreSettings
) -> tuple[float, float, float, int, bool]:
    true_box = metrics.label_box(labels, label)
    shows = int(np.sum(labels == label)) >= settings.min_pixels
    whole = shows and not bool(
        metrics.touches_border(true_box, metrics.known_area(labels), margin_px=settings.border_px)
    )
    return (
        float(metrics.box_iou(box_px, true_box)),
        float(metrics.centre_error(box_px, true_box, labels.shape[1])),
        metrics.mask_iou(mask, labels, label),
        metrics.most_covered(mask, labels, min_pixels=settings.min_pixels),
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
        raise RecordingError(f"{recording.name}: no truth to score {epc} with.")
    part = slice(*frames)
    time_s = recording.frame_time_s()
    iou, cle_px, mask_j, identified, shown, confidence, found = (np.array(column) for column in zip(*rows, strict=True))
    if label in truth.visible:
        shown = shown & np.asarray(truth.visible[label], bool)[part]
    moved = metrics.moved_for(
        truth,
        epc,
        time_s,
        settings.moved_for_s,
        min_speed_m_s=settings.min_speed_m_s,
        restarts=settings.moved_restarts,
    )
    if settings.frames is not None:
        number = np.arange(len(moved))
        moved = moved & (number >= settings.frames[0]) & (number < settings.frames[1])
    return FrameScores(
        time_s=time_s[part],
        iou=iou.astype(np.float64),
        cle_px=cle_px.astype(np.float64),
        mask_j=mask_j.astype(np.float64),
        identified=identified.astype(np.int64),
        confidence=confidence.astype(np.float64),
        found=found.astype(bool),
        shown=shown.astype(bool),
        moved=moved[part],
        label=label,
    )
