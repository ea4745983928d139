"""Run a tracer over whole recordings and score what it says against their truth."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Shaped

from ..data.backwards import played_backwards
from ..recording import Recording, RecordingError
from ..rf.reads import RadioWindow
from ..tracer import AbstractSmoother, AbstractTracer, Camera, Frame, Later, Trace
from . import metrics
from .metrics import FrameScores, Scores


@dataclasses.dataclass(frozen=True)
class ScoreSettings:
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
    tags_at_once: int = 6
    frames_at_once: int = 48
    smooth: bool = False  # say of a frame what those after it tell as well: twice the time, and not while it happens
    num_pictures: int = 12  # frames kept for overlay pictures, spread over the recording

    def __post_init__(self) -> None:
        least = {"tags_at_once": 1, "frames_at_once": 1, "lock_frames": 1, "num_pictures": 0, "min_pixels": 0}
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


@eqx.filter_jit
def _init(tracer: AbstractTracer, camera: Camera, frame: Frame) -> Any:
    return tracer.init(camera, frame)


@eqx.filter_jit
def _step_back(tracer: AbstractSmoother, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Later]:
    return tracer.look_back(camera, state, frame)


@eqx.filter_jit
def _step(tracer: AbstractTracer, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
    return tracer.step(camera, state, frame)


def _tags(frame: Frame, first: int, size: int) -> Frame:
    """One frame (leading time axis kept) with only `size` of the tags; beyond the last one they are never heard."""
    num_tags = frame.radio.std_m.shape[1]
    chosen = np.arange(first, first + size)
    there = chosen < num_tags
    pick = lambda leaf: leaf[:, chosen.clip(max=num_tags - 1)]  # noqa: E731
    radio, reads = jax.tree.map(pick, frame.radio), jax.tree.map(pick, frame.reads)
    heard = there[None, :, None, None]
    radio = RadioWindow(jnp.where(heard, radio.relative_m, 0.0), jnp.where(heard, radio.std_m, jnp.inf))
    reads = eqx.tree_at(lambda one: one.valid, reads, reads.valid & heard)
    return eqx.tree_at(lambda f: (f.radio, f.reads), frame, (radio, reads))


def trace_recording(
    tracer: AbstractTracer,
    recording: Recording,
    load: Callable[..., Any],
    *,
    epcs: Sequence[str],
    settings: ScoreSettings | None = None,
    frames: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Trace]]:
    """Every frame's number and `Trace` (NumPy leaves, tag axis in the order of `epcs`), frame by frame.

    `load(recording, start, stop, epcs=...)` gives a `Clip`. Pieces of `frames_at_once` frames are read one after the
    other with the tracer's state carried across, so that memory does not grow with the recording; tags go through in
    groups of `tags_at_once`, the last one filled up with silent ones, so that one compilation does for all. Tags compete for
    pixels within their group.

    With `smooth` in the settings the frames go through backwards first, and what is said of a frame rests on those after
    it as well; log odds are kept in half precision in a temporary file meanwhile. Raises `RecordingError` for a tracer
    that is no `AbstractSmoother`.
    """
    settings = settings or ScoreSettings()
    first, last = frames or (0, recording.num_frames)
    if not 0 <= first < last <= recording.num_frames:
        raise RecordingError(
            f"{recording.name}: frames {first} to {last} asked for; expected a part of 0 to {recording.num_frames}."
        )
    if not epcs:
        raise RecordingError(f"{recording.name}: no tag to trace. The recording holds no read, or epcs is empty.")
    later: Callable[[int], Later] | None = None
    if settings.smooth:
        if not isinstance(tracer, AbstractSmoother):
            raise RecordingError(
                f"smooth: {type(tracer).__name__} goes forwards only; expected TagAttention. Set scores.smooth=false."
            )
        later = _look_back(tracer, recording, load, epcs, settings, (first, last))
    for number, said in _run(_step, tracer, recording, load, epcs, settings, (first, last), later):
        yield number, jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(epcs)], *said)


def _run(
    step: Callable[..., tuple[Any, Any]],
    tracer: AbstractTracer,
    recording: Recording,
    load: Callable[..., Any],
    epcs: Sequence[str],
    settings: ScoreSettings,
    frames: tuple[int, int],
    later: Callable[[int], Later] | None = None,
) -> Iterator[tuple[int, list[Any]]]:
    """Every frame's number, and what a step says of each group of tags there (NumPy leaves)."""
    first, last = frames
    size = min(settings.tags_at_once, len(epcs))
    groups = range(0, len(epcs), size)
    states: list[Any] = [None] * len(groups)
    for start in range(first, last, settings.frames_at_once):
        stop = min(start + settings.frames_at_once, last)
        overlap = int(start > first)  # a clip's first frame has no flow: read it again, with the frame before
        clip = load(recording, start - overlap, stop, epcs=list(epcs))
        parts = [_tags(clip.frames, group, size) for group in groups]
        for index in range(overlap, stop - start + overlap):
            said = []
            known = later(start - overlap + index) if later is not None else None
            for number, part in enumerate(parts):
                frame = jax.tree.map(lambda leaf, i=index: jnp.asarray(leaf[i]), part)
                if known is not None:
                    chosen = slice(groups[number], groups[number] + size)
                    told = jax.tree.map(lambda leaf, part=chosen: jnp.asarray(leaf[part], jnp.float32), known)
                    frame = eqx.tree_at(lambda one: one.later, frame, told, is_leaf=lambda leaf: leaf is None)
                if states[number] is None:
                    states[number] = _init(tracer, clip.camera, frame)
                states[number], out = step(tracer, clip.camera, states[number], frame)
                said.append(jax.tree.map(np.asarray, out))
            yield start - overlap + index, said


def _look_back(
    tracer: AbstractSmoother,
    recording: Recording,
    load: Callable[..., Any],
    epcs: Sequence[str],
    settings: ScoreSettings,
    frames: tuple[int, int],
) -> Callable[[int], Later]:
    """Go through the frames backwards; what the later ones say of each can then be asked by its number.

    Its tag axis is that of all groups, silent tags included.
    """
    count, (first, last) = recording.num_frames, frames
    kept: dict[int, Later] = {}
    log_odds: np.ndarray | None = None
    for number, said in _run(
        _step_back, tracer, played_backwards(recording), load, epcs, settings, (count - last, count - first)
    ):
        told: Later = jax.tree.map(lambda *leaves: np.concatenate(leaves), *said)
        if log_odds is None:
            with tempfile.TemporaryFile() as file:  # it has no name, and is gone when the array is
                log_odds = np.memmap(file, np.float16, "w+", shape=(last - first, *told.log_odds.shape))
        frame = count - 1 - number
        log_odds[frame - first] = told.log_odds
        kept[frame] = eqx.tree_at(lambda one: one.log_odds, told, log_odds[frame - first])
    return kept.__getitem__


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
