"""Which segments are connected in space: `tagattention.segments.connection`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import connection as original
from .travel import squared_distance


def touching(
    centre_m: Float[np.ndarray, "segment 3"], size_m: Float[np.ndarray, " segment"]
) -> Bool[np.ndarray, "segment segment"]:
    """Whether two segments touch."""
    limit = np.float32(0.5 * original.GAP) * (size_m[:, None] + size_m[None])
    return squared_distance(centre_m, centre_m) < np.square(limit)


def connected(
    touch: Bool[np.ndarray, "segment segment"], member: Bool[np.ndarray, " segment"]
) -> Int[np.ndarray, " segment"]:
    """The largest index in each one's component; chains have the same greatest length."""
    index = np.arange(len(member))
    at = np.flatnonzero(member)
    if not len(at):
        return index
    close = touch[np.ix_(at, at)]
    close[np.diag_indices(len(at))] = True
    own = np.arange(len(at))
    for _ in range(original._ROUNDS):
        last, own = own, np.where(close, own[None], -1).max(axis=1)
        own = own[own][own[own]]
        if np.array_equal(last, own):
            break
    index[at] = at[own]
    return index


def reached(
    touch: Bool[np.ndarray, "segment segment"], member: Bool[np.ndarray, "tag segment"], start: Int[np.ndarray, " tag"]
) -> Bool[np.ndarray, "tag segment"]:
    """Members that are connected with each tag's segment `start` by members, itself included."""
    begin = np.arange(touch.shape[0])[None] == start[:, None]
    found, close = begin, touch.astype(np.float32)
    for _ in range(original._STEPS):
        last, found = found, begin | (member & (found.astype(np.float32) @ close > 0))
        if np.array_equal(last, found):
            break
    return found
