"""True positions of a recording's tags, and the filter's true states that follow from them."""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int

from ...recording import Recording, RecordingError
from .offline import Observations
from .room import find_room_frame

Kind = Literal["leaves", "stays", "still"]
"""What a tag does: it enters the exit region, it moves elsewhere, or it never moves."""

_MAX_DISTANCE_M = 1.0  # of a carried tag to the blob that carries it
_MIN_SPEED_M_S = 0.3  # a slower carried tag could as well be background: its state is unknown
_STILL_M = 0.05


@dataclasses.dataclass(frozen=True)
class TrueTags:
    """The tags of known position, in the order of the recording's truth, read or not."""

    epcs: tuple[str, ...]
    position_m: Float[np.ndarray, "tag time 2"]  # room frame
    still: Bool[np.ndarray, " tag"]  # never moved by more than 5 cm

    def kind(self, tag: int, exit_x_m: float) -> Kind:
        """What a tag does in the recording."""
        if self.still[tag]:
            return "still"
        return "leaves" if np.nanmin(self.position_m[tag, :, 0]) < exit_x_m else "stays"


def true_tags(recording: Recording) -> TrueTags:
    """The true tags of a recording. Raises `RecordingError` where their positions are unknown."""
    truth = recording.truth
    if truth is None or not truth.tag_position_m:
        raise RecordingError(
            f"{recording.name}: no true positions of its tags (truth.tag_position_m), which rates need. Simulate recordings "
            "of the scenarios, or record the positions."
        )
    room = find_room_frame(recording)
    epcs = tuple(truth.tag_position_m)
    paths = np.stack([room.to_room(np.asarray(truth.tag_position_m[epc], np.float64)) for epc in epcs])
    return TrueTags(epcs, paths[..., :2], np.ptp(paths, axis=1).max(axis=-1) < _STILL_M)


def true_states(observed: Observations, truth: TrueTags) -> Int[np.ndarray, "tag time"]:
    """The filter's true state of each read tag at each frame: 0 background, 1 + slot, -1 where it is unknown.

    A still tag is background. A moving one belongs to the nearest blob, if one is within 1 m.
    """
    states = np.full((len(observed.epcs), len(observed.time_s)), -1)
    for row, epc in enumerate(observed.epcs):
        tag = truth.epcs.index(epc)
        if truth.still[tag]:
            states[row] = 0
            continue
        path = truth.position_m[tag]
        distance = np.linalg.norm(observed.blobs.position_m - path[:, None], axis=-1)
        distance = np.where(observed.blobs.identity > 0, distance, np.inf)
        speed = np.linalg.norm(np.gradient(path, observed.time_s.astype(np.float64), axis=0), axis=-1)
        known = (distance.min(axis=1) < _MAX_DISTANCE_M) & (speed > _MIN_SPEED_M_S)
        states[row] = np.where(known, 1 + np.argmin(distance, axis=1), -1)
    return states
