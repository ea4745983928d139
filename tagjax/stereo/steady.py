"""Pictures whose noise is averaged over the last frames wherever nothing has changed.

Both pictures of a pair have noise of their own, and matching turns it into another disparity in every frame: a wall or a
floor seems to move. Where neither moves, the mean of several frames has less of it. What moves stays as it is.
"""

from __future__ import annotations

from collections import OrderedDict

import cv2
import numpy as np
from jaxtyping import UInt8

from ..core.types import LazyArray

MAX_FRAMES = 10
"""Most frames of a mean: each costs some 10 ms a picture of 512 x 424."""

_CHANGED = 3.0  # levels by which the mean of 3 x 3 pixels differs, in any colour, where something has changed
_WINDOW = (3, 3)


class SteadyPictures:
    """The pictures `frames`, uint8 RGB (time, height, width, 3), each the mean of up to `count` frames up to itself.

    A pixel's mean goes back to the first frame, counted from this one, that differs there. It does not depend on the order in
    which frames are asked for. Raises `ValueError` for a count outside 1 to `MAX_FRAMES`.
    """

    def __init__(self, frames: LazyArray, count: int):
        if not 1 <= count <= MAX_FRAMES:
            raise ValueError(f"count is {count}; expected 1 to {MAX_FRAMES} frames.")
        self._frames, self._count = frames, count
        self._recent: OrderedDict[int, np.ndarray] = OrderedDict()

    def __call__(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """The picture of one frame."""
        first = max(0, frame - self._count + 1)
        pictures = [self._picture(number) for number in range(first, frame + 1)]  # in order: videos are read forwards
        return steady_mean(pictures)

    def _picture(self, frame: int) -> np.ndarray:
        if frame not in self._recent:
            self._recent[frame] = np.asarray(self._frames[frame])
            while len(self._recent) > self._count:
                self._recent.popitem(last=False)
        return self._recent[frame]


def steady_mean(pictures: list[np.ndarray]) -> UInt8[np.ndarray, "height width 3"]:
    """The last of the pictures, each pixel averaged over those before it back to the first that differs there."""
    now = pictures[-1].astype(np.float32)
    total, number = now.copy(), np.ones(now.shape[:2], np.float32)
    same = np.ones(now.shape[:2], bool)
    for picture in reversed(pictures[:-1]):
        before = picture.astype(np.float32)
        differs = np.abs(cv2.blur(before - now, _WINDOW)).max(axis=-1) > _CHANGED
        same &= cv2.dilate(differs.astype(np.uint8), np.ones(_WINDOW, np.uint8)) == 0
        total += before * same[..., None]
        number += same
    return np.rint(total / number[..., None]).astype(np.uint8)
