"""Where on an object its tag is mounted."""

from __future__ import annotations

import dataclasses

import numpy as np

from .objects import TAG_GAP_M, ObjectModel
from .sightline import chord_m

MOUNTINGS = ("as_drawn", "clear")

_STEP_M = 5e-4
_FLUSH_M = 0.01
"""A tag this near to the front surface is on the front: foam keeps some a few millimetres away."""


def mounted(model: ObjectModel, mounting: str) -> ObjectModel:
    """The object with its tag mounted `as_drawn` with the object, or `clear`. Raises `ValueError` for another mounting.

    `clear` is the mounting of a user who wants the tag to be read: on the front (the side that faces away from the
    person who holds the object), which no hand covers, with the dipole vertical, so that it never points at an antenna
    at the height of the object. A tag that is drawn on the front keeps its place, one on the back moves to the front at
    its height, and one on top moves to the middle of the front. Nothing else changes: a world looks the same.
    """
    if mounting not in MOUNTINGS:
        raise ValueError(f"mounting is {mounting!r}; expected one of {', '.join(MOUNTINGS)}.")
    if mounting == "as_drawn":
        return model
    x, y, z = model.tag_m
    front = front_m(model, y, z)
    if not np.isfinite(front):
        y = z = 0.0
        front = front_m(model, y, z)
    if not front - _FLUSH_M < x < front + _FLUSH_M:
        x = front + TAG_GAP_M
    return dataclasses.replace(model, tag_m=(x, y, z), dipole=(0.0, 0.0, 1.0))


def front_m(model: ObjectModel, y: float, z: float) -> float:
    """The largest x of an object's surface at a place (y, z), metres in its frame; infinite where it has no surface."""
    reach = model.half_size_m[0] + 2 * _STEP_M
    x = np.arange(reach, -reach, -_STEP_M)
    end = np.stack([x, np.full_like(x, y), np.full_like(x, z)], axis=-1)
    start = np.broadcast_to([reach, y, z], end.shape)
    inside = np.any([chord_m(shape, start, end) > 0 for shape in model.shapes], axis=0)
    return float(x[np.argmax(inside)]) if inside.any() else np.inf
