"""Stories of walking people: towards the sensor and away, in a crowd, and with badges in an open hall."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..world.crowd import is_free
from ..world.objects import CARRIED_KINDS, make_object
from ..world.people import Hands, carried_poses, hand_target, make_person
from ..world.rooms import Room, make_room
from ..world.trajectory import path_through
from ..world.walks import random_walks, walk_along
from .builder import ScenarioBuilder, add_static_tags, walk_of_length, waving_hand
from .scenario import Scenario


def approach(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str | None = None,
    speed_m_s: float = 0.8,
) -> Scenario:
    """A person with a badge on the chest walks towards the sensor and away again, in a narrow loop.

    With a `kind`, an object of that kind in the right hand is tagged and labelled instead of the person. The person walks
    at `speed_m_s` on the straight parts. The narrow right turns at the ends are slower, and the object, on their inner
    side, never moves faster than the person does on the straight parts.
    """
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    # Slow enough in the turns that the object, farther from the centre of the turn, is not faster than the person.
    push = min(3.0, 2.8 * speed_m_s**2)
    # The straight part is long enough for acceleration, braking, and 0.3 s at full speed.
    min_length = 1.2 * speed_m_s**2 / push + 0.3 * speed_m_s + 2 * _TURN_M
    near, far, y = _lane(builder.room, rng, max(min_length, 1.8))
    laps = int(np.ceil(speed_m_s * duration_s / (2 * (far - near)))) + 1
    path = path_through(_loops(near, far, y, laps), speed_m_s=speed_m_s, max_acceleration_m_s2=push)
    walk = walk_of_length(walk_along(path), builder.steps)
    person = make_person(rng)
    if kind is None:
        builder.person(person, walk, Hands(), badge="level")
    else:
        model = make_object(kind, rng)
        motion = builder.person(person, walk, Hands(right=hand_target(walk, (0.26, -0.16, 1.0))))
        builder.object(model, carried_poses(motion.right_hand, model.grip_m), held=True)
    return builder.scenario(
        f"a person walks back and forth at {speed_m_s} m/s", look_at_m=((near + far) / 2, 0.5 * y, 0.95)
    )


_TURN_M = 0.25  # radius of the turn at the ends


def _lane(room: Room, rng: np.random.Generator, min_length_m: float) -> tuple[float, float, float]:
    """Near end, far end and centre (x, x, y) of a free lane towards the camera, at least `min_length_m` long."""
    _, y0, x1, y1 = room.walk_area_m
    camera = room.camera_position_m
    near = camera[0] + 1.4
    for _ in range(500):
        far = near + rng.uniform(min_length_m, max(min_length_m, 2.9))
        y = camera[1] + rng.uniform(-0.8, 0.8)
        places = [(x, y + side * _TURN_M) for x in np.linspace(near, far, 20) for side in (-1, 1)]
        if all(is_free(np.array(place), (near, y0, x1, y1), room.obstacles_m, 0.33) for place in places):
            return near, float(far), float(y)
    raise ValueError(f"No free lane of {min_length_m:.1f} m towards the camera in the {room.name}; try another seed.")


def _loops(near: float, far: float, y: float, laps: int) -> np.ndarray:
    """Points (points, 3) of a narrow clockwise loop from its far end: towards the camera at y - r, back at y + r."""
    r = _TURN_M
    turn = np.linspace(-np.pi / 2, np.pi / 2, 7)
    legs = np.linspace(far - r, near + r, max(3, round((far - near) / 0.4)))
    out = []
    for _ in range(laps):
        out += [(x, y - r) for x in legs[:-1]]
        out += [(near + r - r * np.cos(a), y + r * np.sin(a)) for a in turn]
        out += [(x, y + r) for x in legs[::-1][1:-1]]
        out += [(far - r + r * np.cos(a), y - r * np.sin(a)) for a in turn[:-1]]
    return np.column_stack([np.array(out), np.zeros(len(out))])


def crowd(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "office",
    num_people: int = 6,
    objects_each: int = 2,
    speed_m_s: Sequence[float] = (0.4, 1.2),
    num_door: int = 0,
    num_static_tags: int = 0,
) -> Scenario:
    """People walk about with an object in one hand or in both; `num_door` of them enter and leave through a door."""
    if objects_each not in (1, 2):
        raise ValueError(f"objects_each is {objects_each}; expected 1 or 2, one for each hand.")
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    walks = random_walks(
        num_people,
        duration_s,
        rng,
        area_m=builder.room.walk_area_m,
        obstacles_m=builder.room.obstacles_m,
        speed_m_s=(speed_m_s[0], speed_m_s[1]),
        door=builder.room.door,
        num_door=num_door,
    )
    for walk in walks:
        walk = walk_of_length(walk, builder.steps)
        swing = [builder.inside_room(waving_hand(walk, side, rng, duration_s, 0.5, 0.0)) for side in (-1, 1)]
        hands = Hands(right=swing[0], left=swing[1] if objects_each == 2 else None)
        person = make_person(rng)
        motion = builder.person(person, walk, hands)
        for hand in (motion.right_hand, motion.left_hand)[:objects_each]:
            model = make_object(str(rng.choice(CARRIED_KINDS)), rng)
            builder.object(model, carried_poses(hand, model.grip_m), held=True)
    add_static_tags(builder, rng, num_static_tags)
    return builder.scenario(f"{num_people} people walk, {objects_each} objects each")


def walkers(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "hall",
    num_people: int = 3,
    speed_m_s: Sequence[float] = (0.5, 1.2),
    num_antennas: int = 1,
) -> Scenario:
    """People with empty hands walk about a room, each with a badge tag, its dipole upright, on the chest."""
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    walks = random_walks(
        num_people,
        duration_s,
        rng,
        area_m=builder.room.walk_area_m,
        obstacles_m=builder.room.obstacles_m,
        speed_m_s=(speed_m_s[0], speed_m_s[1]),
    )
    for walk in walks:
        builder.person(make_person(rng), walk_of_length(walk, builder.steps), Hands(), badge="upright")
    return builder.scenario(f"{num_people} people with badges walk about", num_antennas=num_antennas)
