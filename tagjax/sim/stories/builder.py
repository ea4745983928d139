"""Building blocks of stories: the scenario builder, standing places, waving hands, walkers, static tags."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from ...recording.virtual_tags import default_epc
from ..radio.inventory import InventorySettings
from ..world.bodies import Body, Poses, Tag, World
from ..world.crowd import is_free
from ..world.figure import PersonModel
from ..world.objects import ObjectModel, make_object
from ..world.people import Hands, PersonMotion, badge_m, hand_target, limb_bodies, make_person, move_person
from ..world.rooms import Room
from ..world.rotation import turn_about
from ..world.trajectory import num_steps, wait_then_move, wave
from ..world.walks import Walk, random_walks, walk_along
from .scenario import Scenario

UP = (0.0, 0.0, 1.0)

HAND_M = (0.36, 0.27, 1.12)  # position of a hand in front of the body: ahead, to the side, above the floor


Badge = Literal["level", "upright"]
"""How the dipole of a badge lies on the chest: across it, or along the body."""

_BADGE_DIPOLES: dict[Badge, tuple[float, float, float]] = {"level": (0.0, 1.0, 0.0), "upright": (0.0, 0.0, 1.0)}


class ScenarioBuilder:
    """Collects bodies, tags and labels, and returns the finished scenario."""

    def __init__(self, room: Room, duration_s: float):
        self.room, self.steps = room, num_steps(duration_s)
        self.bodies: list[Body] = list(room.bodies)
        self.tags: list[Tag] = []
        self.names: dict[int, str] = {}

    def person(self, model: PersonModel, walk: Walk, hands: Hands, *, badge: Badge | None = None) -> PersonMotion:
        """Add a person on a walk. Returns the motion, with the hands' real positions.

        With a `badge` the person wears a tag on the chest and has a label: the person is what is to be tracked.
        """
        name, motion = f"person {self.num_people + 1}", move_person(model, walk, hands)
        label = 0 if badge is None else len(self.names) + 1
        limbs = limb_bodies(model, motion, label=label, name=name)
        if badge is not None:
            self.names[label] = name
            torso = len(self.bodies) + list(motion.limbs).index("torso")
            self.tags.append(Tag(default_epc(len(self.tags) + 1), torso, badge_m(model), _BADGE_DIPOLES[badge]))
        self.bodies += limbs
        return motion

    @property
    def num_people(self) -> int:
        return len({body.name for body in self.bodies if body.role == "person"})

    def object(
        self, model: ObjectModel, poses: Poses, *, tagged: bool = True, labelled: bool = True, held: bool = False
    ) -> None:
        """Add an object. With `held` the person added last holds it from the first step to the last."""
        label = len(self.names) + 1 if labelled else 0
        holder = f"person {self.num_people}" if held else ""
        if labelled:
            self.names[label] = model.name
        self.bodies.append(Body(model.name, model.shapes, poses, "object", label, holder))
        if tagged:
            self.tags.append(Tag(default_epc(len(self.tags) + 1), len(self.bodies) - 1, model.tag_m, model.dipole))

    def inside_room(self, path_m: np.ndarray) -> np.ndarray:
        """A hand's path limited to 0.3 m from the walls: a person at a wall does not reach through it."""
        length, width, _ = self.room.size_m
        low, high = np.array([0.0, 0.3 - width / 2, 0.0]), np.array([length - 0.3, width / 2 - 0.3, np.inf])
        return np.clip(path_m, low, high)

    def scenario(
        self, note: str, *, look_at_m: Sequence[float] | None = None, num_antennas: int = 1, **inventory: Any
    ) -> Scenario:
        room = self.room
        if not 1 <= num_antennas <= len(room.antennas_m):
            raise ValueError(
                f"num_antennas is {num_antennas}; expected 1 to {len(room.antennas_m)}, the positions in the {room.name}."
            )
        world = World(
            bodies=tuple(self.bodies),
            tags=tuple(self.tags),
            num_steps=self.steps,
            size_m=room.size_m,
            lights=room.lights,
            ambient=room.ambient,
            names=self.names,
            note=note,
        )
        x, y, z = room.camera_look_at_m if look_at_m is None else look_at_m
        return Scenario(
            world,
            room.camera_position_m,
            (float(x), float(y), float(z)),
            room.antennas_m[:num_antennas],
            room.panels,
            InventorySettings(**inventory),
            None if room.antenna_axes is None else room.antenna_axes[:num_antennas],
        )


def standing_walk(place: tuple[float, float], heading_rad: float, steps: int) -> Walk:
    """A walk that stays at one position (x, y)."""
    return walk_along(np.broadcast_to(np.array(place), (steps, 2)), heading_rad)


def facing_towards(place: Sequence[float], other: Sequence[float]) -> float:
    """Heading from one position on the floor towards another, radians."""
    return float(np.arctan2(other[1] - place[1], other[0] - place[0]))


def placed_object(model: ObjectModel, place: Sequence[float], yaw_rad: float = 0.0) -> Poses:
    """Poses of a static object that stands at x, y and the height of the surface below it."""
    x, y, z = place
    return Poses.fixed((x, y, z + model.half_size_m[2]), turn_about(UP, yaw_rad))


def waving_hand(
    walk: Walk, side: int, rng: np.random.Generator, duration_s: float, speed_m_s: float, stationary_s: float
) -> np.ndarray:
    """World path of a hand that is stationary in front of the body, then waves randomly with the given peak speed."""
    offset = (HAND_M[0], side * HAND_M[1], HAND_M[2] + float(rng.uniform(-0.05, 0.1)))
    start = hand_target(walk, offset)
    stationary_s = min(stationary_s, 0.4 * duration_s)
    moving = duration_s - stationary_s
    # An arm in front of the body reaches about 0.3 m around; faster waves need more acceleration.
    push = max(12.0, 5.5 * speed_m_s**2)
    path = wave("random", (0.0, 0.0, 0.0), moving, peak_speed_m_s=speed_m_s, max_acceleration_m_s2=push, rng=rng)
    offsets = wait_then_move(path, stationary_s, duration_s)
    return start + with_length(offsets, len(start))


def ease(fraction: np.ndarray) -> np.ndarray:
    """0 to 1 with the first derivative zero at both ends; less steep in the middle than `smooth_step`."""
    return fraction * fraction * (3 - 2 * fraction)


def with_length(path: np.ndarray, steps: int) -> np.ndarray:
    """The path with a given number of steps: shortened, or extended by its last position."""
    return path[np.minimum(np.arange(steps), len(path) - 1)]


def standing_places(
    room: Room, rng: np.random.Generator, count: int, distance_m: tuple[float, float]
) -> list[tuple[float, float]]:
    """Positions (x, y) beside each other in front of the camera, clear of furniture."""
    camera = np.array(room.camera_position_m[:2])
    for _ in range(2000):
        away = rng.uniform(*distance_m)
        gap = 1.15
        middle = rng.uniform(-0.4, 0.4)
        places = [(camera[0] + away, camera[1] + middle + gap * (k - (count - 1) / 2)) for k in range(count)]
        if all(is_clear(room, place) for place in places):
            return places
    raise ValueError(
        f"No free positions for {count} people {distance_m} m in front of the camera of the {room.name}; try another seed."
    )


def is_clear(room: Room, place: tuple[float, float]) -> bool:
    """Whether a person can stand there: in the walk area, or up to 0.2 m nearer to the camera."""
    x0, y0, x1, y1 = room.walk_area_m
    return is_free(np.asarray(place), (x0 - 0.2, y0, x1, y1), room.obstacles_m, 0.35)


def add_walkers(
    builder: ScenarioBuilder,
    rng: np.random.Generator,
    count: int,
    duration_s: float,
    taken: Sequence[tuple[float, float]],
) -> None:
    """Add people with empty hands who walk behind the standing ones."""
    if not count:
        return
    room = builder.room
    x0, y0, x1, y1 = room.walk_area_m
    behind = max((place[0] for place in taken), default=x0) + 0.7
    walks = random_walks(
        count, duration_s, rng, area_m=(min(behind, x1 - 1.2), y0, x1, y1), obstacles_m=room.obstacles_m
    )
    for walk in walks:
        builder.person(make_person(rng), walk_of_length(walk, builder.steps), Hands())


def walk_of_length(walk: Walk, steps: int) -> Walk:
    """The walk with a given number of steps: shortened, or extended by its last position."""
    index = np.minimum(np.arange(steps), len(walk.heading_rad) - 1)
    return Walk(*(getattr(walk, field.name)[index] for field in dataclasses.fields(walk)))


def add_static_tags(
    builder: ScenarioBuilder, rng: np.random.Generator, count: int, *, within_m: float = np.inf
) -> None:
    """Add small tagged objects that lie on tables, shelves and the floor; they are not labelled.

    Of several random positions the first one `within_m` of the first antenna is taken, or else the last one.
    """
    antenna = np.array(builder.room.antennas_m[0])
    for _ in range(count):
        model = make_object(str(rng.choice(["book", "mug", "box"])), rng, scale=0.8)
        place = _static_position(builder.room, rng)
        for _ in range(_MAX_DRAWS):
            if np.linalg.norm(np.array(place) - antenna) <= within_m:
                break
            place = _static_position(builder.room, rng)
        builder.object(model, placed_object(model, place, rng.uniform(0, 2 * np.pi)), labelled=False)


_MAX_DRAWS = 30


def _static_position(room: Room, rng: np.random.Generator) -> tuple[float, float, float]:
    """A random position on a table or a shelf (probability 0.8), or on the floor."""
    tables = room.tables
    if tables and rng.random() < 0.8:
        table = tables[int(rng.integers(len(tables)))]
        x0, y0, x1, y1 = table.top_m
        return rng.uniform(x0 + 0.05, x1 - 0.05), rng.uniform(y0 + 0.05, y1 - 0.05), table.height_m
    return (*room.free_place(rng), 0.0)
