"""Optical flow baselines of OpenCV: DIS (Kroeger et al., 2016) and Farneback (2003). Imports cv2; runs on the host."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import cv2
import numpy as np

FlowFunction: TypeAlias = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""(gray_from, gray_to), uint8 (height, width) each, to flow in pixels, float32 (height, width, 2) on `gray_from`."""

DIS_PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


class DISFlow:
    """Dense inverse search at one of OpenCV's presets: "ultrafast", "fast" or "medium"."""

    def __init__(self, preset: str = "medium"):
        if preset not in DIS_PRESETS:
            raise ValueError(f"Unknown DIS preset {preset!r}; expected one of {', '.join(DIS_PRESETS)}.")
        self._dis = cv2.DISOpticalFlow.create(DIS_PRESETS[preset])

    def __call__(self, gray_from: np.ndarray, gray_to: np.ndarray) -> np.ndarray:
        return self._dis.calc(gray_from, gray_to, None)  # type: ignore[call-overload]


class FarnebackFlow:
    """Polynomial expansion: pyramid of `levels`, averaging window of `window` pixels."""

    def __init__(self, levels: int = 4, window: int = 21, iterations: int = 3):
        self._settings = (0.5, levels, window, iterations, 7, 1.5, 0)

    def __call__(self, gray_from: np.ndarray, gray_to: np.ndarray) -> np.ndarray:
        return cv2.calcOpticalFlowFarneback(gray_from, gray_to, None, *self._settings)  # type: ignore[call-overload]


FLOWS: dict[str, Callable[[], FlowFunction]] = {
    "dis": DISFlow,
    "dis_fast": lambda: DISFlow("fast"),
    "dis_ultrafast": lambda: DISFlow("ultrafast"),
    "farneback": FarnebackFlow,
}


def make_flow(name: str) -> FlowFunction:
    """A flow baseline by name; a name not in `FLOWS` raises `ValueError`."""
    if name not in FLOWS:
        raise ValueError(f"Unknown optical flow {name!r}; expected one of {', '.join(FLOWS)}.")
    return FLOWS[name]()


def to_gray(colour: np.ndarray) -> np.ndarray:
    """RGB uint8 (height, width, 3) to grey uint8."""
    return cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
