"""The blobs of a video in a fixed number of slots, as the association filter needs them."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int, Integer

from .tracks import Blob


@dataclasses.dataclass(frozen=True)
class BlobTracks:
    """The blobs of every frame by slot."""

    identity: Int[np.ndarray, "time slot"]  # 0 = empty slot
    position_m: Float[np.ndarray, "time slot 2"]  # room frame; 0 where empty
    box_px: Float[np.ndarray, "time slot 4"]  # x0 y0 x1 y1, first and last pixel; NaN where empty
    num_dropped: int  # blobs of a frame without a free slot, summed over frames
    labels: Integer[np.ndarray, "time height width"] | None = None  # identity of each pixel's blob, 0 = none


def assign_slots(
    frames: Sequence[Sequence[Blob]],
    num_slots: int,
    *,
    labels: Integer[np.ndarray, "time height width"] | None = None,
    previous: tuple[int, ...] | None = None,
) -> BlobTracks:
    """Give every blob the first free slot for as long as it exists; blobs without a free slot are dropped and counted.

    `previous` are the identities in the slots before the first frame. Raises `ValueError` for less than one slot.
    """
    if num_slots < 1:
        raise ValueError(f"num_slots is {num_slots}; expected at least 1.")
    shape = (len(frames), num_slots)
    identity, position = np.zeros(shape, np.int32), np.zeros((*shape, 2), np.float32)
    box = np.full((*shape, 4), np.nan, np.float32)
    taken = [0] * num_slots if previous is None else list(previous)
    dropped = 0
    for time, blobs in enumerate(frames):
        alive = {blob.identity for blob in blobs}
        taken = [one if one in alive else 0 for one in taken]
        for blob in blobs:
            if blob.identity not in taken:
                if 0 not in taken:
                    dropped += 1
                    continue
                taken[taken.index(0)] = blob.identity
            slot = taken.index(blob.identity)
            identity[time, slot], position[time, slot], box[time, slot] = blob.identity, blob.position_m, blob.box_px
    return BlobTracks(identity, position, box, dropped, labels)
