"""Reflectors for the tests of the simulated radio channel: endless planes, box-shaped rooms, points, free space."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from tagjax.sim.radio.environment import Environment, Planes, Scatterers


def infinite_planes(
    normal: Float[np.ndarray, "planes 3"], offset_m: Float[np.ndarray, " planes"], reflection: np.ndarray
) -> Planes:
    """Planes normal . x = offset_m without edges; normals of any length, `reflection` (planes,)."""
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    unit = normal / length
    # Any direction in the plane serves an endless one: the axis that the normal leans to least, made orthogonal.
    axis = np.eye(3)[np.argmin(np.abs(unit), axis=1)]
    along = axis - np.sum(axis * unit, axis=1, keepdims=True) * unit
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    return Planes(unit * (offset_m[:, None] / length), unit, along, np.full((len(unit), 2), np.inf), reflection)


def box_room(
    low_m: Float[np.ndarray, " 3"], high_m: Float[np.ndarray, " 3"], reflection: float | complex | np.ndarray = -0.5
) -> Planes:
    """The six inner faces of an axis-aligned room between two corners, in the order x low, x high, y low, ... z high.

    `reflection` is one coefficient or one for each face; -0.5 is the middle of `REFLECTION` for the sign of a dense wall.
    """
    low, high = np.asarray(low_m, float), np.asarray(high_m, float)
    middle, half = (low + high) / 2, (high - low) / 2
    centre, normal, along, size = [], [], [], []
    for axis in range(3):
        for corner, inward in ((low, 1.0), (high, -1.0)):
            place = middle.copy()
            place[axis] = corner[axis]
            centre.append(place)
            normal.append(inward * np.eye(3)[axis])
            along.append(np.eye(3)[(axis + 1) % 3])
            size.append([half[(axis + 1) % 3], half[(axis + 2) % 3]])
    return Planes(
        np.array(centre), np.array(normal), np.array(along), np.array(size), np.broadcast_to(np.asarray(reflection), 6)
    )


def point_scatterers(
    position_m: Float[np.ndarray, "scatterers 3"],
    rcs_m2: Float[np.ndarray, " scatterers"],
    reflection: float | complex | np.ndarray = -1.0,
) -> Scatterers:
    """Scatterers without extent at (scatterers, 3) metres; an empty array gives none."""
    num = len(position_m)
    up, zero = np.broadcast_to([0.0, 0.0, 1.0], (num, 3)), np.zeros(num)
    return Scatterers(position_m, rcs_m2, np.broadcast_to(np.asarray(reflection), num), up, zero, zero)


def free_space() -> Environment:
    """Nothing that reflects."""
    planes = infinite_planes(np.zeros((0, 3)), np.zeros(0), np.zeros(0))
    return Environment(planes, point_scatterers(np.zeros((0, 3)), np.zeros(0)))
