"""OpenCV parts that several baselines use: background model, mean shift, masks within a window of the picture."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Int, Shaped, UInt8

from .boxes import Window, box_from_window

_FOREGROUND = 255  # OpenCV marks shadows by 127
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1.0)


def background_model(num_frames: int, threshold: float, *, shadow: float = 0.5) -> Any:
    """A mixture of Gaussians for every pixel (Zivkovic, 2004; MOG2), which OpenCV updates in place.

    `num_frames` is its memory, `threshold` the squared distance in variances up to which a pixel is background,
    `shadow` the darkest shadow as a fraction of the background's brightness.
    """
    model = cv2.createBackgroundSubtractorMOG2(num_frames, threshold, True)
    model.setShadowThreshold(shadow)
    return model


def foreground(
    model: Any, colour: UInt8[np.ndarray, "height width 3"], learning_rate: float = -1.0
) -> Bool[np.ndarray, "height width"]:
    """Pixels that are neither background nor shadow; the model learns from the picture (at OpenCV's own rate if -1)."""
    return np.asarray(model.apply(colour, learningRate=learning_rate)) == _FOREGROUND


def mean_shift(weight: UInt8[np.ndarray, "height width"], window: Window) -> Int[np.ndarray, " 4"]:
    """The box in which mean shift ends (Comaniciu and Meer, 2002), from a window within the picture."""
    x, y, width, height = cv2.meanShift(weight, window, _STOP)[1]
    return box_from_window((int(x), int(y), int(width), int(height)))


def place_in_picture(
    part: Bool[np.ndarray, "rows columns"], left: int, top: int, shape: tuple[int, int]
) -> Bool[np.ndarray, "height width"]:
    """A mask of a window of the picture as a mask of the whole picture."""
    out = np.zeros(shape, bool)
    rows, columns = part.shape
    out[top : top + rows, left : left + columns] = part
    return out


def grey(colour: Shaped[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "height width"]:
    """The grey picture of an RGB one."""
    return np.asarray(cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY))
