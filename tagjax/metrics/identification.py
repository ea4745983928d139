"""Identification in windows: which object a tag's masks of the last seconds cover most often."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from .locking import frames_in
from .mean import MaskedMean

WINDOWS_S = (1.0, 2.5, 5.0)
"""Lengths of the windows, seconds."""


def window_identification(
    identified: Int[np.ndarray, " time"],
    label: int,
    valid: Bool[np.ndarray, " time"],
    time_s: Float[np.ndarray, " time"],
    seconds: float,
) -> MaskedMean:
    """The fraction of windows in which the majority of a tag's frames names its own object.

    `identified` is the label that the mask covers at each frame, 0 for none. The windows follow each other without overlap
    from the first valid frame; the last one is left out where it is shorter, and so is one of which less than half of the
    frames are valid. Frames without a label have no vote; of labels with equally many the smallest wins.
    """
    size = frames_in(seconds, time_s)
    begin = np.flatnonzero(valid)[:1]
    right = num = 0
    for start in range(int(begin[0]) if len(begin) else len(valid), len(valid) - size + 1, size):
        part = slice(start, start + size)
        if 2 * np.sum(valid[part]) < size:
            continue
        votes = identified[part][valid[part]]
        votes = votes[votes > 0]
        right += int(len(votes) > 0 and int(np.argmax(np.bincount(votes))) == label)
        num += 1
    return MaskedMean(float(right), num)
