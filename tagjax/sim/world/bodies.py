"""What a simulated world is made of: materials, shapes, bodies with their motion, tags. Plain data, no MuJoCo.

World frame: x away from the camera's wall, y to the left, z up, metres. Poses are sampled every `STEP_S`.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import numpy as np

STEP_S = 0.01
"""Sampling period of every motion. Frames and reads are interpolated between these times."""

MIN_APART_M = 0.01
"""Objects whose centres are closer than this at the start count as placed at the same spot."""

METAL_REFLECTION = -0.95
"""Field reflection coefficient from which a material counts as metal, which lets no radio wave through."""

Texture = Literal["plain", "noise", "checker", "stripes", "speckle", "photo"]
ShapeKind = Literal["box", "sphere", "capsule", "cylinder", "ellipsoid"]
Role = Literal["room", "furniture", "person", "object"]


@dataclasses.dataclass(frozen=True)
class Material:
    """How a surface looks to the camera and to the radio."""

    colour: tuple[float, float, float]  # 0 to 1, linear
    texture: Texture = "noise"
    scale: float = 6.0  # texture cells a metre; for a photograph: metres a picture
    contrast: float = 0.3  # 0 = plain
    photo: str = ""  # name of a photograph, where texture is "photo"
    seed: int = 0
    shine: float = 0.0  # 0 matt to 1 mirror: causes highlights and missing depth
    transmission_db: float = 20.0  # one-way loss of a radio wave that passes through the body
    reflection: float = -0.3  # field reflection coefficient of a plane of this material; metal is -1


@dataclasses.dataclass(frozen=True)
class Shape:
    """A convex part of a body, fixed in the body's frame. Sizes follow MuJoCo: half lengths, radius first."""

    kind: ShapeKind
    size_m: tuple[float, float, float]  # box: half x y z; capsule, cylinder: radius, half length, 0; sphere: radius
    material: Material
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    quaternion: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)  # w x y z


@dataclasses.dataclass(frozen=True)
class Poses:
    """Pose of a body at every step: position (steps, 3), unit quaternion w x y z (steps, 4). One row: it never moves."""

    position_m: np.ndarray
    quaternion: np.ndarray

    @classmethod
    def fixed(cls, position_m, quaternion=(1.0, 0.0, 0.0, 0.0)) -> Poses:
        """A body that never moves."""
        return cls(np.asarray(position_m, float)[None], np.asarray(quaternion, float)[None])

    @property
    def moves(self) -> bool:
        """Whether there is more than one pose."""
        return len(self.position_m) > 1

    def at(self, step: int) -> tuple[np.ndarray, np.ndarray]:
        """Position and quaternion at a step; after the last step they stay as they are."""
        index = min(step, len(self.position_m) - 1)
        return self.position_m[index], self.quaternion[index]


@dataclasses.dataclass(frozen=True)
class Body:
    """Shapes that move together (a limb, an object, a table). `label` is the value in the label masks, 0 for the room.

    All limbs of a person have the same `name`, and the same label if the person is labelled. `holder` is the name of the
    person who holds an object from the first step to the last, empty where no one does.
    """

    name: str
    shapes: tuple[Shape, ...]
    poses: Poses
    role: Role = "room"
    label: int = 0
    holder: str = ""


@dataclasses.dataclass(frozen=True)
class Tag:
    """A tag fixed to a body: index into the world's bodies, position and dipole direction in the body's frame."""

    epc: str
    body: int
    position_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    dipole: tuple[float, float, float] = (0.0, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Light:
    """A point light with shadows; `power` 1 lights a white wall 2 m away fully."""

    position_m: tuple[float, float, float]
    power: float = 1.0


@dataclasses.dataclass(frozen=True)
class World:
    """All bodies, tags and lights for `num_steps` steps of `STEP_S`. `size_m` is the room's length, width, height."""

    bodies: tuple[Body, ...]
    tags: tuple[Tag, ...]
    num_steps: int
    size_m: tuple[float, float, float]
    lights: tuple[Light, ...] = (Light((2.5, 0.8, 2.6)),)
    ambient: float = 0.35
    names: dict[int, str] = dataclasses.field(default_factory=dict)  # label: name
    note: str = ""

    def check(self) -> None:
        """Raise `ValueError` for an impossible world.

        That is a world without steps, with a tag that has no body or leaves the room, or with two objects at one spot.
        """
        if self.num_steps < 1:
            raise ValueError(f"num_steps is {self.num_steps}; expected at least 1.")
        for body in self.bodies:
            rows = len(body.poses.position_m)
            if rows not in (1, self.num_steps):
                raise ValueError(f"Body {body.name}: {rows} poses; expected 1 or {self.num_steps}.")
            if not np.all(np.isfinite(body.poses.position_m)):
                raise ValueError(f"Body {body.name}: a position is not finite.")
        objects = [body for body in self.bodies if body.role == "object"]
        for number, one in enumerate(objects):
            for other in objects[:number]:
                apart = float(np.linalg.norm(one.poses.position_m[0] - other.poses.position_m[0]))
                if apart < MIN_APART_M:
                    raise ValueError(
                        f"{other.name} and {one.name} start {apart * 1e3:.0f} mm apart; objects need "
                        f"{MIN_APART_M * 1e3:.0f} mm between their centres. Place one elsewhere."
                    )
        for tag in self.tags:
            if not 0 <= tag.body < len(self.bodies):
                raise ValueError(
                    f"Tag {tag.epc}: body is {tag.body}; expected an index below {len(self.bodies)}, the number of bodies."
                )
            path = tag_path(self, tag)
            low, high = path.min(axis=0), path.max(axis=0)
            length, width, height = self.size_m
            if low[0] < -0.5 or high[0] > length or abs(path[:, 1]).max() > width / 2 or low[2] < 0 or high[2] > height:
                raise ValueError(
                    f"Tag {tag.epc} leaves the room: it spans {low.round(2)} to {high.round(2)} m in a room of "
                    f"{self.size_m} m. Move the object, or enlarge the room."
                )


def rotation_matrix(quaternion: np.ndarray) -> np.ndarray:
    """Rotation matrices (..., 3, 3) of unit quaternions w x y z (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(quaternion, float), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def tag_path(world: World, tag: Tag) -> np.ndarray:
    """World position of a tag at every step, (num_steps, 3); constant where the body never moves."""
    poses = world.bodies[tag.body].poses
    path = poses.position_m + rotation_matrix(poses.quaternion) @ np.asarray(tag.position_m)
    return np.broadcast_to(path, (world.num_steps, 3)) if len(path) == 1 else path


def tag_dipole(world: World, tag: Tag) -> np.ndarray:
    """World direction of a tag's dipole at every step, (num_steps, 3)."""
    poses = world.bodies[tag.body].poses
    turned = rotation_matrix(poses.quaternion) @ np.asarray(tag.dipole)
    return np.broadcast_to(turned, (world.num_steps, 3)) if len(turned) == 1 else turned
