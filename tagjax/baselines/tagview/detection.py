"""Detection of objects in pictures (Tagview, III.A): by the trained network, or by motion against a still
background.
"""

from __future__ import annotations

import abc
import dataclasses
import functools
from typing import Any, Literal

import cv2
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Shaped, UInt8

from ..boxes import non_maximum_suppression
from ..opencv import background_model, foreground
from .default_boxes import STRIDE_PX, decode, default_boxes
from .network import BoxNetwork
from .weights import load_weights

_MAX_BOXES = 400
_MAX_AREA = 0.05  # of a moving object, as a fraction of the picture


@dataclasses.dataclass(frozen=True)
class DetectorSettings:
    """`ssd` is the paper's detector; `motion` needs no training and detects only what moves."""

    kind: Literal["ssd", "motion"] = "ssd"
    weights: str | None = None  # of ssd: a file, the packaged one if None
    width_px: int = 256  # to which pictures are resized: objects of 0.2 m on a table are then about 14 wide
    min_score: float = 0.8  # of ssd
    max_iou: float = 0.3  # of two detections
    background_frames: int = 200  # of motion: memory of the background model
    background_threshold: float = 16.0  # of motion: squared distance, in variances, up to which a pixel is background
    min_side_px: float = 4.0  # of motion

    def __post_init__(self):
        if self.kind not in ("ssd", "motion"):
            raise ValueError(f"kind is {self.kind!r}; expected ssd or motion.")
        if self.width_px < 32 or self.background_frames < 2:
            raise ValueError(
                f"width_px {self.width_px}, background_frames {self.background_frames}; expected at least 32 and 2."
            )
        if not (0 < self.min_score < 1 and 0 <= self.max_iou <= 1 and self.background_threshold > 0):
            raise ValueError(
                f"min_score {self.min_score}, max_iou {self.max_iou}, background_threshold {self.background_threshold}; "
                "expected two fractions and a positive number."
            )


class AbstractDetector(abc.ABC):
    """Boxes of the objects in the pictures of a video, one picture after the other."""

    @abc.abstractmethod
    def init(self) -> Any:
        """The state before the first picture."""

    @abc.abstractmethod
    def detect(
        self, state: Any, image: UInt8[np.ndarray, "height width 3"]
    ) -> tuple[Any, Float[np.ndarray, "boxes 4"], Float[np.ndarray, " boxes"]]:
        """The next state, boxes (x0 y0 x1 y1, first and last pixel), and their scores, 0 to 1."""


class BoxDetector(AbstractDetector):
    """The single-shot detector (III.A), without a state."""

    def __init__(self, network: BoxNetwork, settings: DetectorSettings):
        self.network, self.settings = network, settings

    def init(self) -> None:
        return None

    def detect(self, state: None, image: UInt8[np.ndarray, "height width 3"]):
        height, width = image.shape[:2]
        rows = max(round(height * self.settings.width_px / width), 1)
        small = image
        if (rows, self.settings.width_px) != (height, width):
            small = np.asarray(cv2.resize(image, (self.settings.width_px, rows), interpolation=cv2.INTER_AREA))
        below, beside = -rows % STRIDE_PX, -self.settings.width_px % STRIDE_PX
        padded = np.pad(small, ((0, below), (0, beside), (0, 0)), mode="edge")
        score, offset = (np.asarray(one, np.float64) for one in _run(self.network, jnp.asarray(padded)))
        likely = np.flatnonzero(score >= self.settings.min_score)
        # Suppression compares all pairs: the number of boxes is limited.
        likely = likely[np.argsort(-score[likely], kind="stable")[:_MAX_BOXES]]
        boxes = decode(offset[likely], _defaults(padded.shape[0], padded.shape[1])[likely])
        kept = non_maximum_suppression(boxes, score[likely], self.settings.max_iou)
        scale = np.array([width / self.settings.width_px, height / rows] * 2)
        last = np.array([0, 0, 1, 1])
        return None, (boxes[kept] + last) * scale - last, score[likely][kept]


class MotionDetector(AbstractDetector):
    """Boxes of the foreground of OpenCV's background model.

    OpenCV updates the model in place: a state serves one run.
    """

    def __init__(self, settings: DetectorSettings):
        self.settings = settings

    def init(self) -> Any:
        return background_model(self.settings.background_frames, self.settings.background_threshold)

    def detect(self, state: Any, image: UInt8[np.ndarray, "height width 3"]):
        scale = image.shape[1] / self.settings.width_px
        moved = foreground(state, image)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (max(round(3 * scale), 1),) * 2)
        cleaned = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
        cleaned = cv2.morphologyEx(cleaned, cv2.MORPH_OPEN, kernel)
        _, _, table, _ = cv2.connectedComponentsWithStats(cleaned)
        left, top, wide, high = (table[1:, column].astype(np.float64) for column in range(4))
        min_side = self.settings.min_side_px * scale
        max_area = _MAX_AREA * image.shape[0] * image.shape[1]
        large = (wide >= min_side) & (high >= min_side) & (wide * high < max_area)
        boxes = np.stack([left, top, left + wide - 1, top + high - 1], axis=1)[large]
        return state, boxes, np.ones(len(boxes))


def make_detector(settings: DetectorSettings) -> AbstractDetector:
    """The detector of some settings. Raises `ValueError` for weights that cannot be read."""
    if settings.kind == "motion":
        return MotionDetector(settings)
    return BoxDetector(load_weights(settings.weights)[0], settings)


@eqx.filter_jit
def _run(network: BoxNetwork, image: Shaped[Array, "height width 3"]) -> tuple[Array, Array]:
    log_odds, offset = network(image.astype(jnp.float32) / 255.0)
    return jax.nn.sigmoid(log_odds), offset


@functools.lru_cache(maxsize=8)
def _defaults(height: int, width: int) -> Float[np.ndarray, "boxes 4"]:
    return default_boxes(height, width)
