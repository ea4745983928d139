"""A furnished room with walking people, as a MuJoCo model. Needs the `sim` extra."""

# MuJoCo's names come from a compiled module that the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from .motion import Walk, limb_poses, limb_shapes, random_walk

try:
    import mujoco
except ImportError as error:  # pragma: no cover - depends on the installation
    raise ImportError(
        "Simulated scenes need MuJoCo, which is not installed: pip install 'tagjax[sim]' (or -e '.[sim]' in a clone)."
    ) from error

ROOM_M = (6.0, 5.0, 2.8)
"""Length (away from the camera), width and height of the room."""

WALK_AREA_M = (1.3, -1.7, 5.3, 1.7)
"""Where people walk: x0, y0, x1, y1 (x away from the camera's wall, y to the left)."""


@dataclasses.dataclass(frozen=True)
class Person:
    """A walker: label in the truth, height, walk."""

    label: int
    height_m: float
    walk: Walk


@dataclasses.dataclass(frozen=True)
class Scene:
    """A compiled room with its people, and what each geom looks like."""

    model: Any
    data: Any
    people: tuple[Person, ...]
    geom_label: np.ndarray  # (num_geoms,) uint8: 0 room, else a person's label
    geom_colour: np.ndarray  # (num_geoms, 3) 0 to 1
    geom_contrast: np.ndarray  # (num_geoms,) of the surface's texture
    geom_scale: np.ndarray  # (num_geoms,) texture cells a metre
    geom_seed: np.ndarray  # (num_geoms,)

    def pose(self, step: int) -> None:
        """Move everybody to where they are at a step of their walks."""
        number = 0
        for person in self.people:
            centres, axes = limb_poses(person.walk, step, person.height_m)
            for centre, axis in zip(centres, axes, strict=True):
                self.data.mocap_pos[number] = centre
                mujoco.mju_quatZ2Vec(self.data.mocap_quat[number], axis)
                number += 1
        mujoco.mj_kinematics(self.model, self.data)


def build_scene(
    num_people: int, duration_s: float, step_s: float, rng: np.random.Generator, *, num_furniture: int = 7
) -> Scene:
    """Draw a room: walls, floor, tables and cabinets along the sides, and people on random walks."""
    length, width, height = ROOM_M
    spec = mujoco.MjSpec()
    looks: list[tuple[int, np.ndarray, float, float]] = []

    def box(centre, half, colour, contrast, scale):
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=centre, size=half)
        looks.append((0, np.asarray(colour), contrast, scale))

    wall = rng.uniform(0.55, 0.85) + rng.uniform(-0.06, 0.06, 3)
    floor = rng.uniform(0.3, 0.65) + rng.uniform(-0.08, 0.08, 3)
    box([length / 2, 0, -0.05], [length / 2 + 0.6, width / 2 + 0.1, 0.05], floor, 0.35, 4.0)
    box([length + 0.05, 0, height / 2], [0.05, width / 2 + 0.1, height / 2], wall, 0.25, 2.0)
    for side in (-1, 1):
        box([length / 2, side * (width / 2 + 0.05), height / 2], [length / 2, 0.05, height / 2], wall, 0.25, 2.0)
    for _ in range(num_furniture):
        side = rng.choice([-1, 1])
        half = np.array([rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.3), rng.uniform(0.35, 0.9)])
        centre = [rng.uniform(1.2, length - 0.5), side * (width / 2 - half[1] - 0.02), half[2]]
        box(centre, half, rng.uniform(0.15, 0.8, 3), rng.uniform(0.2, 0.7), rng.uniform(3, 10))
    for _ in range(2):
        half = np.array([rng.uniform(0.3, 0.6), rng.uniform(0.5, 0.9), 0.025])
        centre = [length - half[0] - 0.05, rng.uniform(-1.2, 1.2), 0.74]
        box(centre, half, rng.uniform(0.3, 0.7, 3), 0.3, 6.0)
    people = []
    for label in range(1, num_people + 1):
        tall = rng.uniform(1.6, 1.9)
        walk = random_walk(duration_s, step_s, rng, area_m=WALK_AREA_M)
        people.append(Person(label, tall, walk))
        shirt, trousers, skin = rng.uniform(0.05, 0.9, 3), rng.uniform(0.05, 0.6, 3), np.array([0.8, 0.62, 0.5])
        for name, radius, half_length in limb_shapes(tall):
            body = spec.worldbody.add_body(mocap=True)
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, half_length, 0])
            colour = {"head": skin, "hips": trousers, "left leg": trousers, "right leg": trousers}.get(name, shirt)
            looks.append((label, colour, 0.6, rng.uniform(8, 20)))
    model = spec.compile()
    return Scene(
        model=model,
        data=mujoco.MjData(model),
        people=tuple(people),
        geom_label=np.array([look[0] for look in looks], np.uint8),
        geom_colour=np.array([look[1] for look in looks]),
        geom_contrast=np.array([look[2] for look in looks]),
        geom_scale=np.array([look[3] for look in looks]),
        geom_seed=rng.integers(0, 2**31, len(looks)),
    )
