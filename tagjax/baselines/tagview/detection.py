"""Detectors: boxes of the things in a picture, by the trained network or by what moves before a still background."""

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

from ._anchors import STRIDE_PX, decode, default_boxes
from ._boxes import suppress
from ._network import BoxNetwork
from ._weights import load_detector


@dataclasses.dataclass(frozen=True)
class DetectorSettings:
    """`ssd` is the paper's; `motion` needs no training and sees only what moves."""

    kind: Literal["ssd", "motion"] = "ssd"
    weights: str | None = None  # of ssd: a file, the packaged ones if None
    width_px: int = 256  # that pictures are brought to: things of 0.2 m on a table are about 14 wide then
    least_score: float = 0.8  # of ssd
    most_overlap: float = 0.3  # of two detections
    history: int = 200  # of motion: frames that the background is learnt from
    least_difference: float = 16.0  # of motion: squared distance to the background, in variances
    least_side_px: float = 4.0  # of motion

    def __post_init__(self):
        if self.kind not in ("ssd", "motion"):
            raise ValueError(f"kind is {self.kind!r}; expected ssd or motion.")
        if self.width_px < 32 or self.history < 2:
            raise ValueError(f"width_px {self.width_px}, history {self.history}; expected at least 32 and 2.")
        if not (0 < self.least_score < 1 and 0 <= self.most_overlap <= 1 and self.least_difference > 0):
            raise ValueError(
                f"least_score {self.least_score}, most_overlap {self.most_overlap}, least_difference "
                f"{self.least_difference}; expected shares, and a positive number."
            )


class AbstractDetector(abc.ABC):
    """Boxes of the things in a video's pictures, one after the other."""

    @abc.abstractmethod
    def begin(self) -> Any:
        """The state before the first picture."""

    @abc.abstractmethod
    def detect(
        self, state: Any, image: UInt8[np.ndarray, "height width 3"]
    ) -> tuple[Any, Float[np.ndarray, "boxes 4"], Float[np.ndarray, " boxes"]]:
        """The next state, boxes in the picture's pixels, and their scores, 0 to 1."""


class BoxDetector(AbstractDetector):
    """The single-shot detector (III.A). It has no memory."""

    def __init__(self, network: BoxNetwork, settings: DetectorSettings):
        self.network, self.settings = network, settings

    def begin(self) -> None:
        return None

    def detect(self, state: None, image: UInt8[np.ndarray, "height width 3"]):
        height, width = image.shape[:2]
        rows = max(round(height * self.settings.width_px / width), 1)
        small = image
        if (rows, self.settings.width_px) != (height, width):
            small = np.asarray(cv2.resize(image, (self.settings.width_px, rows), interpolation=cv2.INTER_AREA))
        below, beside = -rows % STRIDE_PX, -self.settings.width_px % STRIDE_PX
        padded = np.pad(small, ((0, below), (0, beside), (0, 0)), mode="edge")
        chance, offset = (np.asarray(one, np.float64) for one in _run(self.network, jnp.asarray(padded)))
        likely = np.flatnonzero(chance >= self.settings.least_score)
        # Enough for any picture; suppression compares all with all.
        likely = likely[np.argsort(-chance[likely], kind="stable")[:400]]
        boxes = decode(offset[likely], _defaults(padded.shape[0], padded.shape[1])[likely])
        kept = suppress(boxes, chance[likely], self.settings.most_overlap)
        scale = np.array([width / self.settings.width_px, height / rows] * 2)
        return None, (boxes[kept] + 0.5) * scale - 0.5, chance[likely][kept]


class MotionDetector(AbstractDetector):
    """What differs from the background's mixture of Gaussians (OpenCV's MOG2), cleaned and boxed.

    The mixture is OpenCV's own and changes as it learns: a state serves one run.
    """

    def __init__(self, settings: DetectorSettings):
        self.settings = settings

    def begin(self) -> Any:
        return cv2.createBackgroundSubtractorMOG2(self.settings.history, self.settings.least_difference, True)

    def detect(self, state: Any, image: UInt8[np.ndarray, "height width 3"]):
        scale = image.shape[1] / self.settings.width_px
        moved = np.asarray(state.apply(image)) == 255
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (max(round(3 * scale), 1),) * 2)
        cleaned = cv2.morphologyEx(moved.astype(np.uint8), cv2.MORPH_CLOSE, kernel)
        cleaned = cv2.morphologyEx(cleaned, cv2.MORPH_OPEN, kernel)
        _, _, table, _ = cv2.connectedComponentsWithStats(cleaned)
        left, top, wide, high = (table[1:, column].astype(np.float64) for column in range(4))
        least = self.settings.least_side_px * scale
        large = (wide >= least) & (high >= least) & (wide * high < 0.05 * image.shape[0] * image.shape[1])
        boxes = np.stack([left, top, left + wide, top + high], axis=1)[large] - 0.5
        return state, boxes, np.ones(len(boxes))


def make_detector(settings: DetectorSettings) -> AbstractDetector:
    """The detector that settings ask for; raises `ValueError` for weights that cannot be read."""
    if settings.kind == "motion":
        return MotionDetector(settings)
    return BoxDetector(load_detector(settings.weights)[0], settings)


@eqx.filter_jit
def _run(network: BoxNetwork, image: Shaped[Array, "height width 3"]) -> tuple[Array, Array]:
    log_odds, offset = network(image.astype(jnp.float32) / 255.0)
    return jax.nn.sigmoid(log_odds), offset


@functools.lru_cache(maxsize=8)
def _defaults(height: int, width: int) -> Float[np.ndarray, "boxes 4"]:
    return default_boxes(height, width)
