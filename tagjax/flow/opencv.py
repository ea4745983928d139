"""Optical flow baselines of OpenCV: DIS (Kroeger et al., 2016) and Farneback (2003). Imports cv2; runs on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np

from .images import check_images, to_uint8

FlowFunction: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(first, second), RGB uint8 (height, width, 3) each, to flow in pixels, float32 (height, width, 2) on `first`.

Other images that `check_images` accepts are converted.
"""

DIS_PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}

_MIN_SIDE_PX = 16
"""Shorter images are padded by their edge pixels: OpenCV's DIS refuses fewer than 12."""


class DISFlow:
    """Dense inverse search at one of OpenCV's presets: "ultrafast", "fast" or "medium".

    Patches of 8 pixels lie `patch_stride` pixels apart, and their flow is refined in `refinements` steps of the variational
    method, by default as the preset has them (3 and 5 in "medium"). Raises `ValueError` for other presets, strides, and
    numbers of steps.
    """

    def __init__(self, preset: str = "medium", *, patch_stride: int | None = None, refinements: int | None = None):
        if patch_stride is not None and not 1 <= patch_stride <= 8:
            raise ValueError(f"patch_stride is {patch_stride}; expected 1 to 8 pixels: a patch has 8.")
        if refinements is not None and refinements < 0:
            raise ValueError(f"refinements is {refinements}; expected at least 0.")
        if preset not in DIS_PRESETS:
            raise ValueError(f"Unknown DIS preset {preset!r}; expected one of {', '.join(DIS_PRESETS)}.")
        self._dis = cv2.DISOpticalFlow.create(DIS_PRESETS[preset])
        if patch_stride is not None:
            self._dis.setPatchStride(patch_stride)
        if refinements is not None:
            self._dis.setVariationalRefinementIterations(refinements)

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        one, other = _grey_pair(first, second)
        flow = self._dis.calc(one, other, None)  # type: ignore[call-overload]
        return flow[: np.shape(first)[0], : np.shape(first)[1]]


class FarnebackFlow:
    """Polynomial expansion: pyramid of `levels`, averaging window of `window` pixels."""

    def __init__(self, levels: int = 4, window: int = 21, iterations: int = 3):
        self._settings = (0.5, levels, window, iterations, 7, 1.5, 0)

    def __call__(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        one, other = _grey_pair(first, second)
        flow = cv2.calcOpticalFlowFarneback(one, other, None, *self._settings)  # type: ignore[call-overload]
        return flow[: np.shape(first)[0], : np.shape(first)[1]]


FLOWS: dict[str, Callable[[], FlowFunction]] = {
    "dis": DISFlow,
    "dis_live": lambda: DISFlow(patch_stride=4, refinements=2),
    "dis_fast": lambda: DISFlow("fast"),
    "dis_ultrafast": lambda: DISFlow("ultrafast"),
    "farneback": FarnebackFlow,
}


def to_grey_uint8(colour: np.ndarray) -> np.ndarray:
    """RGB uint8 (height, width, 3) to grey uint8."""
    return cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)


def _grey_pair(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Both images, checked, in grey, padded to the minimum side."""
    one, other = (to_grey_uint8(np.ascontiguousarray(to_uint8(image))) for image in check_images(first, second))
    rows, columns = (max(0, _MIN_SIDE_PX - size) for size in one.shape)
    if rows or columns:
        one, other = (np.pad(image, ((0, rows), (0, columns)), mode="edge") for image in (one, other))
    return one, other
