"""Reflectors of radio waves: flat panels of a room, and compact scatterers such as people."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from ..world.furniture import Panel

PERSON_RCS_M2 = 1.0
"""Radar cross section of a standing person at 900 MHz: the upper end of the measured values (see `Scatterers`)."""


def _floats(x: Any) -> Array:
    return jnp.asarray(x, dtype=float)


def _complexes(x: Any) -> Array:
    return jnp.asarray(x, dtype=complex)


class Planes(eqx.Module):
    """Flat reflectors: walls, floor, ceiling, cabinet sides; each a rectangle, of any size up to infinite.

    `normal` and `along` are orthogonal unit vectors; the rectangle reaches `half_size_m[0]` from the centre along
    `along` and `half_size_m[1]` along normal x along. `reflection` is the ratio of fields, -1 for metal.
    """

    centre_m: Float[Array, "planes 3"] = eqx.field(converter=_floats)
    normal: Float[Array, "planes 3"] = eqx.field(converter=_floats)
    along: Float[Array, "planes 3"] = eqx.field(converter=_floats)
    half_size_m: Float[Array, "planes 2"] = eqx.field(converter=_floats)
    reflection: Complex[Array, " planes"] = eqx.field(converter=_complexes)


class Scatterers(eqx.Module):
    """Compact reflectors, bodies and metal objects: vertical or slanted cylinders, and points (length and radius 0).

    `rcs_m2` is the radar cross section, `reflection` the ratio of fields that goes with it (absorption, sign), `axis`
    a unit vector. A man has 0.03 to 2.3 m^2 at 410 MHz and 0.1 to 1.0 m^2 at 1.12 GHz, by aspect and polarisation
    (Schultz, Burgener and King, Proc. IRE 46, 1958).
    """

    position_m: Float[Array, "scatterers 3"] = eqx.field(converter=_floats)
    rcs_m2: Float[Array, " scatterers"] = eqx.field(converter=_floats)
    reflection: Complex[Array, " scatterers"] = eqx.field(converter=_complexes)
    axis: Float[Array, "scatterers 3"] = eqx.field(converter=_floats)
    half_length_m: Float[Array, " scatterers"] = eqx.field(converter=_floats)
    radius_m: Float[Array, " scatterers"] = eqx.field(converter=_floats)


class Environment(eqx.Module):
    """Everything that reflects. Arrays of length 0 make free space."""

    planes: Planes
    scatterers: Scatterers


def room_environment(panels: Sequence[Panel], num_people: int) -> Environment:
    """The room's reflectors, and one cylinder per person at the origin (its path is given to the inventory)."""
    rows = [(p.centre_m, p.normal, p.along, p.half_size_m, p.reflection) for p in panels]
    centre, normal, along, half, reflection = zip(*rows, strict=True) if rows else ((), (), (), (), ())
    shape = (len(rows), 3)
    planes = Planes(
        np.reshape(centre, shape), np.reshape(normal, shape), np.reshape(along, shape),
        np.reshape(half, (len(rows), 2)), np.asarray(reflection, float),
    )  # fmt: skip
    people = Scatterers(
        np.zeros((num_people, 3)),
        np.full(num_people, PERSON_RCS_M2),
        np.full(num_people, -0.6),
        np.broadcast_to([0.0, 0.0, 1.0], (num_people, 3)),
        np.full(num_people, 0.5),
        np.full(num_people, 0.16),
    )
    return Environment(planes, people)
