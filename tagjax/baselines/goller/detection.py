"""Detection of moving blobs (Goller et al., III.B): background subtraction without shadows, parts of a body joined."""

from __future__ import annotations

import dataclasses
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ...recording import Recording
from ..boxes import box_from_window
from ..opencv import background_model, foreground

_NUM_WARM_UP = 20  # repetitions of the empty scene, after which the background model is certain of it
_MIN_COLUMN_OVERLAP = 0.5  # of the narrower one, for two boxes to be above each other
_MAX_GAP = 0.15  # of the taller one's height, between the parts of one body


@dataclasses.dataclass(frozen=True)
class BlobSettings:
    """Detection and tracking of blobs. The paper names the steps and gives no values."""

    background_frames: int = 200  # memory of the background model
    background_rate: float = 0.002  # weight of one frame in the background model
    background_threshold: float = 16.0  # squared distance, in variances, up to which a pixel is background
    shadow: float = 0.5  # darkest shadow, as a fraction of the background's brightness
    warm_up: Literal["empty", "online"] = "empty"  # train the background on the empty scene first, or not at all
    area_m2: tuple[float, float] = (0.08, 2.5)  # smallest and largest visible area of a new blob
    max_speed_m_s: float = 3.0
    min_travel_m: float = 0.3  # distance from the first position before a blob is reported
    max_missed: int = 3  # frames without foreground before a blob ends
    max_merged: int = 10  # frames for which two blobs above each other may have one piece of foreground
    num_bins: int = 32  # of the intensity histogram
    histogram_rate: float = 0.1  # weight of one frame in the histogram
    position: Literal["centre", "foot", "depth"] = "foot"  # see `BlobLocator`
    person_height_m: float = 1.7

    def __post_init__(self) -> None:
        if not 0 < self.area_m2[0] < self.area_m2[1]:
            raise ValueError(f"area_m2 is {self.area_m2}; expected 0 < smallest < largest.")
        for name in ("background_frames", "background_threshold", "max_speed_m_s", "num_bins"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number.")


@dataclasses.dataclass(frozen=True)
class Component:
    """A connected piece of foreground, or several that are parts of one body."""

    box_px: Int[np.ndarray, " 4"]
    area_px: int
    mask: Bool[np.ndarray, "height width"]


class BlobDetector:
    """Background subtraction with OpenCV's model, which learns in place: one detector serves one video."""

    def __init__(self, settings: BlobSettings):
        self._rate = settings.background_rate
        self._model = background_model(
            settings.background_frames, settings.background_threshold, shadow=settings.shadow
        )

    def warm_up(self, empty: UInt8[np.ndarray, "height width 3"]) -> None:
        """Train the background model on the empty scene before the first frame."""
        for number in range(_NUM_WARM_UP):
            self._model.apply(empty, learningRate=-1 if number else 1)

    def foreground(self, colour: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        """Pixels that are neither background nor its shadow, cleaned; the background model learns from the frame."""
        mask = foreground(self._model, colour, self._rate).astype(np.uint8)
        opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return np.asarray(cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((7, 3), np.uint8)) > 0)


def find_components(solid: Bool[np.ndarray, "height width"]) -> list[Component]:
    """Connected components of the foreground; those above each other with a small gap are one body."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(solid.astype(np.uint8), connectivity=8)
    boxes = [box_from_window((int(x), int(y), int(w), int(h))) for x, y, w, h, _ in stats[1:count]]
    group = list(range(len(boxes)))

    def root(i: int) -> int:
        while group[i] != i:
            i = group[i]
        return i

    for i, box in enumerate(boxes):
        for j in range(i):
            if _same_body(box, boxes[j]):
                group[root(i)] = root(j)
    found = []
    for number in sorted({root(i) for i in range(len(boxes))}):
        members = [i for i in range(len(boxes)) if root(i) == number]
        parts = np.array([boxes[i] for i in members])
        found.append(
            Component(
                np.concatenate([parts[:, :2].min(axis=0), parts[:, 2:].max(axis=0)]),
                sum(int(stats[i + 1, cv2.CC_STAT_AREA]) for i in members),
                np.isin(labels, np.array(members) + 1) & solid,
            )
        )
    return found


def column_overlap(first_px: Int[np.ndarray, " 4"], second_px: Int[np.ndarray, " 4"]) -> float:
    """Columns that two boxes share, as a fraction of the narrower one; negative where they lie apart."""
    shared = min(first_px[2], second_px[2]) - max(first_px[0], second_px[0]) + 1
    return float(shared) / float(min(first_px[2] - first_px[0], second_px[2] - second_px[0]) + 1)


def _same_body(first_px: Int[np.ndarray, " 4"], second_px: Int[np.ndarray, " 4"]) -> bool:
    gap = max(first_px[1], second_px[1]) - min(first_px[3], second_px[3]) - 1
    tallest = max(first_px[3] - first_px[1], second_px[3] - second_px[1]) + 1
    return column_overlap(first_px, second_px) >= _MIN_COLUMN_OVERLAP and bool(gap <= _MAX_GAP * tallest)


def empty_scene(recording: Recording, num_frames: int = 50) -> UInt8[np.ndarray, "height width 3"]:
    """The most stable colour of every pixel over the recording: an estimate of the empty scene, taken at installation.

    It is the mean of the middle of the shortest half of a pixel's brightnesses (the "shorth"). Unlike the median it is
    right where people cover a pixel for half of the time. It uses later frames, yet only of what does not move.
    """
    some = np.unique(np.linspace(0, recording.num_frames - 1, min(recording.num_frames, num_frames)).astype(int))
    pictures = np.stack([np.asarray(recording.colour[int(frame)]) for frame in some])
    brightness = np.sum(pictures, axis=-1, dtype=np.uint16)
    order = np.argsort(brightness, axis=0, kind="stable")
    level = np.take_along_axis(brightness, order, axis=0)
    half = len(some) // 2 + 1
    start = np.argmin(level[half - 1 :] - level[: len(some) - half + 1], axis=0)
    middle = range(half // 3, max(half - half // 3, half // 3 + 1))
    total: Float[np.ndarray, "height width 3"] = np.zeros(pictures.shape[1:], np.float32)
    for offset in middle:
        chosen = np.take_along_axis(order, (start + offset)[None], axis=0)
        total += np.take_along_axis(pictures, chosen[..., None], axis=0)[0]
    return np.clip(np.rint(total / len(middle)), 0, 255).astype(np.uint8)
