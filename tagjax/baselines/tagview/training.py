"""Training the detector on frames whose boxes are known: crops, SSD's loss with hard negatives, Adam."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float, Int, UInt8

from ...recording import Recording
from ._anchors import default_boxes, targets
from ._boxes import from_inclusive, overlap
from ._detect import AbstractDetector
from ._network import BoxNetwork

MEASURED_OVERLAP = 0.5
"""With which a detection counts as right."""


@dataclasses.dataclass(frozen=True)
class TrainSettings:
    """The recipe. Crops and turned pictures show the net more than whole ones, and cost less."""

    num_steps: int = 3000
    batch: int = 16
    crop_px: tuple[int, int] = (96, 128)  # height and width, multiples of 4
    learning_rate: float = 3e-3
    negatives: float = 3.0  # hardest ones for each positive (SSD, 2.2)
    every: int = 3  # of a recording's frames
    least_side_px: float = 5.0  # things seen smaller are neither right nor wrong
    widths: tuple[int, int, int] = (16, 32, 48)
    depth: int = 3
    seed: int = 0
    most_s: float = 900.0  # training ends after this time

    def __post_init__(self):
        if min(self.num_steps, self.batch, self.every, self.depth) < 1 or not self.most_s > 0:
            raise ValueError("num_steps, batch, every, depth and most_s are to be positive.")
        if any(side % 4 or side < 16 for side in self.crop_px):
            raise ValueError(f"crop_px is {self.crop_px}; expected multiples of 4 from 16 on.")


@dataclasses.dataclass(frozen=True)
class LabelledFrame:
    """A picture, the boxes of the tagged things in it, and boxes that are too small or cut to be judged."""

    image: UInt8[np.ndarray, "height width 3"]
    things_px: Float[np.ndarray, "things 4"]
    ignored_px: Float[np.ndarray, "others 4"]


def labelled_frames(recording: Recording, *, every: int = 1, least_side_px: float = 5.0) -> list[LabelledFrame]:
    """Every n-th frame with the boxes of its tagged things; `ValueError` for a recording without truth."""
    truth = recording.truth
    if truth is None or truth.boxes_px is None or not truth.tag_to_label:
        raise ValueError(f"{recording.name}: no truth boxes of tagged things; expected a simulated recording.")
    labels = np.array(sorted(set(truth.tag_to_label.values()))) - 1
    found = []
    for number in range(0, recording.num_frames, every):
        boxes = np.asarray(truth.boxes_px[number], np.float64)[labels]
        boxes = from_inclusive(boxes[np.all(np.isfinite(boxes), axis=1)])
        large = np.min(boxes[:, 2:] - boxes[:, :2], axis=1, initial=np.inf) >= least_side_px
        found.append(LabelledFrame(np.asarray(recording.colour[number]), boxes[large], boxes[~large]))
    return found


def detection_loss(
    network: BoxNetwork,
    images: Float[Array, "batch height width 3"],
    labels: Int[Array, "batch boxes"],
    offsets: Float[Array, "batch boxes 4"],
    negatives: float,
) -> Float[Array, ""]:
    """SSD's loss (Liu et al., Eq. 1): cross entropy of positives and the hardest negatives, smooth L1 of the offsets."""
    log_odds, said = jax.vmap(network)(images)
    positive = labels == 1
    number = jnp.maximum(jnp.sum(positive), 1).astype(log_odds.dtype)
    of_things = jnp.sum(jnp.where(positive, jax.nn.softplus(-log_odds), 0.0))
    of_nothing = jnp.where(labels == 0, jax.nn.softplus(log_odds), 0.0).reshape(-1)
    hardest = jax.lax.top_k(of_nothing, of_nothing.shape[0] // 8)[0]
    counted = jnp.arange(hardest.shape[0]).astype(log_odds.dtype) < negatives * number
    difference = jnp.abs(said - offsets)
    smooth = jnp.where(difference < 1.0, 0.5 * difference**2, difference - 0.5)
    of_offsets = jnp.sum(jnp.where(positive[..., None], smooth, 0.0))
    return (of_things + jnp.sum(jnp.where(counted, hardest, 0.0)) + of_offsets) / number


def train_detector(
    frames: Sequence[LabelledFrame],
    settings: TrainSettings,
    *,
    on_step: Callable[[int, float], None] | None = None,
) -> tuple[BoxNetwork, dict[str, Any]]:
    """A network trained on labelled frames, and the recipe with its last losses; `ValueError` without a frame."""
    if not frames:
        raise ValueError("No frame to train on; expected labelled ones of a train split.")
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
    while steps < settings.num_steps and time.perf_counter() - start < settings.most_s:
        chosen = [_crop(frames[int(rng.integers(len(frames)))], settings, rng) for _ in range(settings.batch)]
        wanted = [targets(one.things_px, one.ignored_px, defaults) for one in chosen]
        network, moments, loss = update(
            network,
            moments,
            jnp.asarray(np.stack([one.image for one in chosen])),
            jnp.asarray(np.stack([label for label, _ in wanted]), jnp.int32),
            jnp.asarray(np.stack([offset for _, offset in wanted]), jnp.float32),
        )
        losses.append(float(loss))
        steps += 1
        if on_step is not None:
            on_step(steps, losses[-1])
    recipe = {
        **dataclasses.asdict(settings),
        "steps_done": steps,
        "num_frames": len(frames),
        "seconds": round(time.perf_counter() - start, 1),
        "last_losses": float(np.mean(losses[-50:])),
    }
    return network, recipe


def _rate(step: Int[Array, ""], settings: TrainSettings) -> Float[Array, ""]:
    """Learning rate: a linear rise over the first hundred steps or half of them, then half a cosine to 0."""
    at, warm = step.astype(jnp.float32), float(min(100, settings.num_steps // 2 + 1))
    fallen = 0.5 * (1.0 + jnp.cos(jnp.pi * jnp.clip((at - warm) / (settings.num_steps + 1 - warm), 0.0, 1.0)))
    return settings.learning_rate * jnp.minimum((at + 1.0) / warm, 1.0) * fallen


def _crop(frame: LabelledFrame, settings: TrainSettings, rng: np.random.Generator) -> LabelledFrame:
    """A part of a frame, mostly one with a thing in it, mirrored, turned, and recoloured."""
    image, things, ignored = frame.image, frame.things_px, frame.ignored_px
    high, wide = settings.crop_px
    rows, columns = image.shape[:2]
    if rows < high or columns < wide:
        image = np.pad(image, ((0, max(high - rows, 0)), (0, max(wide - columns, 0)), (0, 0)), mode="edge")
        rows, columns = image.shape[:2]
    limits = np.array([columns - wide, rows - high])
    if len(things) and rng.random() < 0.8:
        box = things[int(rng.integers(len(things)))]
        corner = 0.5 * (box[:2] + box[2:]) - rng.uniform(0.15, 0.85, 2) * [wide, high]
        corner = np.clip(np.round(corner), 0, limits).astype(int)
    else:
        corner = np.array([rng.integers(limits[0] + 1), rng.integers(limits[1] + 1)])
    part = image[corner[1] : corner[1] + high, corner[0] : corner[0] + wide]
    edge = np.array([wide, high, wide, high]) - 0.5
    cut_things, cut = _within(things - np.tile(corner, 2), edge)
    cut_ignored, other = _within(ignored - np.tile(corner, 2), edge)
    boxes = np.concatenate([cut_things, cut, cut_ignored, other])
    for axis in (0, 1):
        if rng.random() < 0.5:
            part = part[:, ::-1] if axis == 0 else part[::-1]
            size = wide if axis == 0 else high
            boxes[:, [axis, axis + 2]] = (size - 1) - boxes[:, [axis + 2, axis]]
    part = part[..., rng.permutation(3)].astype(np.float32)
    part = part * rng.uniform(0.8, 1.25, 3) * rng.uniform(0.7, 1.3) + rng.uniform(-15, 15)
    part = np.clip(part, 0, 255).astype(np.uint8)
    return LabelledFrame(part, boxes[: len(cut_things)], boxes[len(cut_things) :])


def _within(box_px: np.ndarray, edge: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes cut to a picture: those of which three quarters remain, and what is left of others."""
    whole = np.prod(np.maximum(box_px[:, 2:] - box_px[:, :2], 1e-6), axis=1)
    cut = np.clip(box_px, -0.5, edge)
    left = np.prod(cut[:, 2:] - cut[:, :2], axis=1)
    return cut[left >= 0.75 * whole], cut[(left > 0) & (left < 0.75 * whole)]


def measure_detector(detector: AbstractDetector, frames: Sequence[LabelledFrame]) -> dict[str, float]:
    """Precision and recall of detections (each with at most one thing, overlap `MEASURED_OVERLAP`), and the mean
    distance of right ones from the things' middles, px. Detections of what is ignored count neither way.
    """
    right = made = wanted = 0
    errors: list[float] = []
    state = detector.begin()
    for frame in frames:
        state, boxes, _ = detector.detect(state, frame.image)
        if len(boxes) and len(frame.ignored_px):
            boxes = boxes[overlap(boxes, frame.ignored_px).max(axis=1) < 0.2]
        free = set(range(len(frame.things_px)))
        made, wanted = made + len(boxes), wanted + len(frame.things_px)
        shared = overlap(boxes, frame.things_px)
        for index in range(len(boxes)):
            best = max(free, key=lambda thing: shared[index, thing], default=None)
            if best is not None and shared[index, best] >= MEASURED_OVERLAP:
                free.remove(best)
                right += 1
                ends = [0.5 * (box[:2] + box[2:]) for box in (boxes[index], frame.things_px[best])]
                errors.append(float(np.linalg.norm(ends[0] - ends[1])))
    return {
        "precision": right / made if made else float("nan"),
        "recall": right / wanted if wanted else float("nan"),
        "error_px": float(np.mean(errors)) if errors else float("nan"),
        "num_things": float(wanted),
    }
