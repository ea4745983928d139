"""Training of the detector on frames with true boxes: crops, SSD's loss with hard negatives, Adam."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, UInt8

from ...core.progress import OnProgress, unobserved
from ...recording import Recording
from ..boxes import box_area_px, box_centre_px, box_iou, box_size_px
from .default_boxes import default_boxes, targets
from .detection import AbstractDetector
from .network import BoxNetwork

CORRECT_IOU = 0.5
"""Smallest IoU of a correct detection."""

_MIN_VISIBLE = 0.75  # fraction of an object within a crop that still counts as the object
_IGNORED_IOU = 0.2


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """Settings of the training. Mirrored crops give more variety than whole pictures, at less cost."""

    num_steps: int = 3000
    batch_size: int = 16
    crop_px: tuple[int, int] = (96, 128)  # height and width, multiples of 4
    learning_rate: float = 3e-3
    negatives: float = 3.0  # hard negatives per positive (SSD, 2.2)
    frame_stride: int = 3  # every how many frames of a recording are used
    min_side_px: float = 5.0  # smaller objects are ignored
    widths: tuple[int, int, int] = (16, 32, 48)
    depth: int = 3
    seed: int = 0
    max_duration_s: float = 900.0  # training ends after this time

    def __post_init__(self):
        for name in ("num_steps", "batch_size", "frame_stride", "depth", "max_duration_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number.")
        if any(side % 4 or side < 16 for side in self.crop_px):
            raise ValueError(f"crop_px is {self.crop_px}; expected multiples of 4, at least 16.")


@dataclasses.dataclass(frozen=True)
class LabelledFrame:
    """A picture, the boxes of its tagged objects, and ignored boxes: too small, or cut by the edge."""

    image: UInt8[np.ndarray, "height width 3"]
    objects_px: Float[np.ndarray, "objects 4"]
    ignored_px: Float[np.ndarray, "others 4"]


def labelled_frames(recording: Recording, *, stride: int = 1, min_side_px: float = 5.0) -> list[LabelledFrame]:
    """Every `stride`-th frame with the boxes of its tagged objects. Raises `ValueError` for a recording without
    truth.
    """
    truth = recording.truth
    if truth is None or truth.boxes_px is None or not truth.tag_to_label:
        raise ValueError(
            f"{recording.name}: no true boxes of tagged objects, expected some. Use a simulated recording."
        )
    labels = np.array(sorted(set(truth.tag_to_label.values()))) - 1
    found = []
    for number in range(0, recording.num_frames, stride):
        boxes = np.asarray(truth.boxes_px[number], np.float64)[labels]
        boxes = boxes[np.all(np.isfinite(boxes), axis=1)]
        large = np.min(box_size_px(boxes), axis=1, initial=np.inf) >= min_side_px
        found.append(LabelledFrame(np.asarray(recording.colour[number]), boxes[large], boxes[~large]))
    return found


def detection_loss(
    network: BoxNetwork,
    images: Float[Array, "batch height width 3"],
    labels: Int[Array, "batch boxes"],
    offsets: Float[Array, "batch boxes 4"],
    negatives: float,
) -> Float[Array, ""]:
    """SSD's loss (Liu et al., Eq. 1): cross entropy of positives and the hardest negatives, smooth L1 of the
    offsets.
    """
    log_odds, predicted = jax.vmap(network)(images)
    positive = labels == 1
    number = jnp.maximum(jnp.sum(positive), 1).astype(log_odds.dtype)
    object_loss = jnp.sum(jnp.where(positive, jax.nn.softplus(-log_odds), 0.0))
    background_loss = jnp.where(labels == 0, jax.nn.softplus(log_odds), 0.0).reshape(-1)
    hardest = jax.lax.top_k(background_loss, background_loss.shape[0] // 8)[0]
    counted = jnp.arange(hardest.shape[0]).astype(log_odds.dtype) < negatives * number
    difference = jnp.abs(predicted - offsets)
    smooth = jnp.where(difference < 1.0, 0.5 * difference**2, difference - 0.5)
    offset_loss = jnp.sum(jnp.where(positive[..., None], smooth, 0.0))
    return (object_loss + jnp.sum(jnp.where(counted, hardest, 0.0)) + offset_loss) / number


def train_detector(
    frames: Sequence[LabelledFrame],
    settings: TrainSettings,
    *,
    on_progress: OnProgress = unobserved,
) -> tuple[BoxNetwork, dict[str, Any]]:
    """A network trained on labelled frames, and the settings with the last losses. Raises `ValueError` without a
    frame.
    """
    if not frames:
        raise ValueError("No frame to train on, expected labelled frames. Simulate the train split of a suite.")
    rng = np.random.default_rng(settings.seed)
    network = BoxNetwork(settings.widths, settings.depth, key=jax.random.key(settings.seed))
    optimizer = optax.chain(
        optax.clip_by_global_norm(5.0),
        optax.scale_by_adam(),
        optax.add_decayed_weights(1e-4),
        optax.scale_by_schedule(lambda step: -_rate(jnp.asarray(step), settings)),
    )
    moments = optimizer.init(eqx.filter(network, eqx.is_array))

    @eqx.filter_jit
    def update(network, moments, images, labels, offsets):
        pictures = images.astype(jnp.float32) / 255.0
        loss, gradient = eqx.filter_value_and_grad(detection_loss)(
            network, pictures, labels, offsets, settings.negatives
        )
        with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
            change, moments = optimizer.update(gradient, moments, eqx.filter(network, eqx.is_array))
        return eqx.apply_updates(network, change), moments, loss

    defaults = default_boxes(*settings.crop_px)
    start, losses, steps = time.perf_counter(), [], 0
    on_progress("train", 0, settings.num_steps, "compiling")
    while steps < settings.num_steps and time.perf_counter() - start < settings.max_duration_s:
        chosen = [_crop(frames[int(rng.integers(len(frames)))], settings, rng) for _ in range(settings.batch_size)]
        labelled = [targets(one.objects_px, one.ignored_px, defaults) for one in chosen]
        network, moments, loss = update(
            network,
            moments,
            jnp.asarray(np.stack([one.image for one in chosen])),
            jnp.asarray(np.stack([label for label, _ in labelled]), jnp.int32),
            jnp.asarray(np.stack([offset for _, offset in labelled]), jnp.float32),
        )
        losses.append(float(loss))
        steps += 1
        on_progress("train", steps, settings.num_steps, f"loss {losses[-1]:.3f}")
    record = {
        **dataclasses.asdict(settings),
        "steps_done": steps,
        "num_frames": len(frames),
        "seconds": round(time.perf_counter() - start, 1),
        "last_losses": float(np.mean(losses[-50:])),
    }
    return network, record


def _rate(step: Int[Array, ""], settings: TrainSettings) -> Float[Array, ""]:
    """Learning rate: a linear rise over the first hundred steps (at most half of them), then half a cosine to 0."""
    now, warm = step.astype(jnp.float32), float(min(100, settings.num_steps // 2 + 1))
    decay = 0.5 * (1.0 + jnp.cos(jnp.pi * jnp.clip((now - warm) / (settings.num_steps + 1 - warm), 0.0, 1.0)))
    return settings.learning_rate * jnp.minimum((now + 1.0) / warm, 1.0) * decay


def _crop(frame: LabelledFrame, settings: TrainSettings, rng: np.random.Generator) -> LabelledFrame:
    """A crop of a frame, mostly one with an object in it, randomly mirrored and recoloured."""
    image, objects, ignored = frame.image, frame.objects_px, frame.ignored_px
    high, wide = settings.crop_px
    rows, columns = image.shape[:2]
    if rows < high or columns < wide:
        image = np.pad(image, ((0, max(high - rows, 0)), (0, max(wide - columns, 0)), (0, 0)), mode="edge")
        rows, columns = image.shape[:2]
    limits = np.array([columns - wide, rows - high])
    if len(objects) and rng.random() < 0.8:
        box = objects[int(rng.integers(len(objects)))]
        corner = box_centre_px(box) - rng.uniform(0.15, 0.85, 2) * [wide, high]
        corner = np.clip(np.round(corner), 0, limits).astype(int)
    else:
        corner = np.array([rng.integers(limits[0] + 1), rng.integers(limits[1] + 1)])
    part = image[corner[1] : corner[1] + high, corner[0] : corner[0] + wide]
    kept, cut = _crop_boxes(objects - np.tile(corner, 2), wide, high)
    boxes = np.concatenate([kept, cut, *_crop_boxes(ignored - np.tile(corner, 2), wide, high)])
    for axis in (0, 1):
        if rng.random() < 0.5:
            part = part[:, ::-1] if axis == 0 else part[::-1]
            size = wide if axis == 0 else high
            boxes[:, [axis, axis + 2]] = (size - 1) - boxes[:, [axis + 2, axis]]
    part = part[..., rng.permutation(3)].astype(np.float32)
    part = part * rng.uniform(0.8, 1.25, 3) * rng.uniform(0.7, 1.3) + rng.uniform(-15, 15)
    part = np.clip(part, 0, 255).astype(np.uint8)
    return LabelledFrame(part, boxes[: len(kept)], boxes[len(kept) :])


def _crop_boxes(
    box_px: Float[np.ndarray, "boxes 4"], width: int, height: int
) -> tuple[Float[np.ndarray, "kept 4"], Float[np.ndarray, "cut 4"]]:
    """Boxes cut to a picture: those of which three quarters remain, and the remaining parts of others."""
    low = np.minimum(np.maximum(box_px[:, :2], 0), [width, height])
    high = np.maximum(np.minimum(box_px[:, 2:], [width - 1, height - 1]), -1)
    inside = np.concatenate([low, high], axis=1)
    whole, area = np.maximum(box_area_px(box_px), 1e-12), box_area_px(inside)
    return inside[area >= _MIN_VISIBLE * whole], inside[(area > 0) & (area < _MIN_VISIBLE * whole)]


def measure_detector(detector: AbstractDetector, frames: Sequence[LabelledFrame]) -> dict[str, float]:
    """Precision and recall of detections (each of at most one object, IoU at least `CORRECT_IOU`), and the mean
    distance of correct ones from the objects' centres, px. Detections of ignored boxes do not count.
    """
    correct = detected = expected = 0
    errors: list[float] = []
    state = detector.init()
    for frame in frames:
        state, boxes, _ = detector.detect(state, frame.image)
        if len(boxes) and len(frame.ignored_px):
            boxes = boxes[box_iou(boxes, frame.ignored_px).max(axis=1) < _IGNORED_IOU]
        free = set(range(len(frame.objects_px)))
        detected, expected = detected + len(boxes), expected + len(frame.objects_px)
        iou = box_iou(boxes, frame.objects_px)
        for index in range(len(boxes)):
            best = max(free, key=lambda number: iou[index, number], default=None)
            if best is not None and iou[index, best] >= CORRECT_IOU:
                free.remove(best)
                correct += 1
                offset_px = box_centre_px(boxes[index]) - box_centre_px(frame.objects_px[best])
                errors.append(float(np.linalg.norm(offset_px)))
    return {
        "precision": correct / detected if detected else float("nan"),
        "recall": correct / expected if expected else float("nan"),
        "error_px": float(np.mean(errors)) if errors else float("nan"),
        "num_objects": float(expected),
    }
