"""The status of a tag at a frame: detected, or the reason why it is not."""

from __future__ import annotations

import enum

import numpy as np
from jaxtyping import Array, Bool, Int8


class Status(enum.IntEnum):
    """What a tracer reports of a tag at a frame. Arrays hold it as int8; files and messages hold its `word`."""

    UNKNOWN = 0  # not detected, and the tracer gives no reason; also of a place that holds no tag
    DETECTED = 1
    NOT_READ = 2  # few reads of late, or none
    OCCLUDED = 3  # the body that carries the tag is out of view: behind something, or beyond the picture's edge
    STATIONARY = 4  # the reads are those of a tag that stays in place
    NOT_FOUND = (
        5  # the reads are those of no body that is followed: it is not in view, or reflections disturb the phases
    )

    @property
    def word(self) -> str:
        """The name in lower case, as files hold it."""
        return self.name.lower()

    @property
    def text(self) -> str:
        """The name for people."""
        return self.word.replace("_", " ")


def status_or_detected(
    status: Int8[Array | np.ndarray, "*batch"] | None, detected: Bool[Array | np.ndarray, "*batch"]
) -> Int8[np.ndarray, "*batch"]:
    """The status, on the host; of a tracer that gives none (None), `DETECTED` or `UNKNOWN`."""
    if status is None:
        return np.where(np.asarray(detected), Status.DETECTED, Status.UNKNOWN).astype(np.int8)
    return np.asarray(status)
