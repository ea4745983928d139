"""Stories of people who walk, and of a shop: to and fro, in a crowd, out of the exit; and its calibration grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ._crowd import is_free
from ._stage_set import (
    StageSet,
    add_still_tags,
    ease,
    fitted,
    trimmed,
    waved_hand,
)
from .motion import num_steps, path_through, random_walks, still_then_move, walk_along
from .objects import ObjectModel, make_object
from .people import Hands, carried, hold, make_person
from .record import Filmed
from .rooms import Room, make_room
from .world import Poses

KINDS = ("bottle", "box", "toy", "notebook", "bag")
"""What people in a crowd carry: the five objects of the single-object experiments."""


def approach(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "bag",
    speed_m_s: float = 0.8,
) -> Filmed:
    """A person walks towards the sensor and away again, round and round, an object in the right hand.

    Straight legs are walked at `speed_m_s` once it is reached; the narrow turns at the ends, to the right, are slower,
    and the object, on their inner side, never moves faster than the person does on the legs.
    """
    stage = StageSet(make_room(room, rng), duration_s)
    # Slow enough in the turns that the object, which is farther from their middle than the person, is not the faster.
    push = min(3.0, 2.8 * speed_m_s**2)
    # Speeding up and braking take a length; a leg is longer by what is walked in 0.3 s.
    least = 1.2 * speed_m_s**2 / push + 0.3 * speed_m_s + 2 * _TURN_M
    near, far, y = _lane(stage.room, rng, max(least, 1.8))
    laps = int(np.ceil(speed_m_s * duration_s / (2 * (far - near)))) + 1
    path = path_through(_loops(near, far, y, laps), speed_m_s=speed_m_s, max_acceleration_m_s2=push)
    walk = trimmed(walk_along(path), stage.steps)
    person, model = make_person(rng), make_object(kind, rng)
    motion = stage.person(person, walk, Hands(right=hold(walk, (0.26, -0.16, 1.0))))
    stage.object(model, carried(motion.right_hand, model.grip_m))
    return stage.filmed(f"a person walks to and fro at {speed_m_s} m/s", look_at_m=((near + far) / 2, 0.5 * y, 0.95))


_TURN_M = 0.25  # radius of the turn at the ends


def _lane(room: Room, rng: np.random.Generator, least_m: float) -> tuple[float, float, float]:
    """Near end, far end and middle (x, x, y) of a free lane towards the camera, at least so long."""
    _, y0, x1, y1 = room.walk_area_m
    camera = room.camera_position_m
    near = camera[0] + 1.4
    for _ in range(500):
        far = near + rng.uniform(least_m, max(least_m, 2.9))
        y = camera[1] + rng.uniform(-0.8, 0.8)
        places = [(x, y + side * _TURN_M) for x in np.linspace(near, far, 20) for side in (-1, 1)]
        if all(is_free(np.array(place), (near, y0, x1, y1), room.obstacles_m, 0.33) for place in places):
            return near, float(far), float(y)
    raise ValueError(f"No free lane of {least_m:.1f} m towards the camera in the {room.name}; try another seed.")


def _loops(near: float, far: float, y: float, laps: int) -> np.ndarray:
    """Points (points, 3) of a narrow loop, walked clockwise from its far end: in at y - r, back at y + r."""
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
    num_still_tags: int = 0,
) -> Filmed:
    """People walk about, each with an object in one hand or in both; `num_door` of them enter and leave."""
    if objects_each not in (1, 2):
        raise ValueError(f"objects_each is {objects_each}; people have two hands: 1 or 2.")
    stage = StageSet(make_room(room, rng), duration_s)
    walks = random_walks(
        num_people,
        duration_s,
        rng,
        area_m=stage.room.walk_area_m,
        obstacles_m=stage.room.obstacles_m,
        speed_m_s=(speed_m_s[0], speed_m_s[1]),
        door=stage.room.door,
        num_door=num_door,
    )
    for walk in walks:
        walk = trimmed(walk, stage.steps)
        swing = [stage.inside(waved_hand(walk, side, rng, duration_s, 0.5, 0.0)) for side in (-1, 1)]
        hands = Hands(right=swing[0], left=swing[1] if objects_each == 2 else None)
        person = make_person(rng)
        motion = stage.person(person, walk, hands)
        for hand in (motion.right_hand, motion.left_hand)[:objects_each]:
            model = make_object(str(rng.choice(KINDS)), rng)
            stage.object(model, carried(hand, model.grip_m))
    add_still_tags(stage, rng, num_still_tags)
    return stage.filmed(f"{num_people} people walk, {objects_each} objects each")


def shop_exit(
    rng: np.random.Generator,
    duration_s: float,
    *,
    num_people: int = 1,
    tags_each: int = 1,
    num_still_tags: int = 0,
    stay_share: float = 0.5,
) -> Filmed:
    """People with tagged things walk about a shop of 3 x 7 m; each leaves through the exit, or stays (`stay_share`)."""
    if not 1 <= tags_each <= 4:
        raise ValueError(f"tags_each is {tags_each}; two hands carry 1 to 4 things.")
    stage = StageSet(make_room("shop_floor", rng), duration_s)
    room = stage.room
    x0, _, x1, _ = room.walk_area_m
    lanes = np.linspace(-0.5, 0.5, num_people) if num_people > 1 else [0.0]
    for lane in lanes:
        points = [(rng.uniform(x1 - 1.2, x1), lane, 0.0)]
        leaves = rng.random() >= stay_share
        inner = rng.uniform(3.2, 4.2)
        points.append((inner, lane + rng.uniform(-0.15, 0.15), 0.0))
        points.append((x0 - 0.9 if leaves else rng.uniform(x1 - 1.5, x1 - 0.3), lane, 0.0))
        path = path_through(points, speed_m_s=rng.uniform(0.7, 1.2), max_acceleration_m_s2=2.0)
        walk = trimmed(walk_along(still_then_move(path, rng.uniform(0.0, 1.0))), stage.steps)
        person = make_person(rng)
        hands = Hands(
            right=hold(walk, (0.2, -0.28, 0.95)), left=hold(walk, (0.2, 0.28, 0.95)) if tags_each > 1 else None
        )
        motion = stage.person(person, walk, hands)
        held: list[ObjectModel] = []
        for number in range(tags_each):
            model = make_object(str(rng.choice(["bag", "box", "bottle", "toy"])), rng, scale=0.8)
            hand = (motion.right_hand, motion.left_hand)[number % 2]
            pose = carried(hand, model.grip_m)
            lift = _lift(held[number - 2], model) if number > 1 else 0.0
            stage.object(model, Poses(pose.position_m + np.array([0.0, 0.0, lift]), pose.quaternion))
            held.append(model)
    add_still_tags(stage, rng, num_still_tags)
    return stage.filmed(
        f"{num_people} people, {tags_each} tags each, {num_still_tags} still", num_antennas=3, rounds_per_antenna=2
    )


def _lift(first: ObjectModel, second: ObjectModel) -> float:
    """Height to add to the second object of a hand, so that it is just above or below the first."""
    room = first.half_size_m[2] + second.half_size_m[2] + 0.01
    grips = second.grip_m[2] - first.grip_m[2]
    return min(grips + room, grips - room, key=abs)


def grid(
    rng: np.random.Generator, duration_s: float, *, spacing_m: float = 0.5, height_m: float = 1.0, rest_s: float = 2.0
) -> Filmed:
    """A tag on a stand that rests at each point of a grid on the shop floor in turn: for antenna calibration."""
    stage = StageSet(make_room("shop_floor", rng), duration_s)
    x0, y0, x1, y1 = stage.room.walk_area_m
    points = [
        (x, y)
        for row, x in enumerate(np.arange(x0, x1 + 1e-9, spacing_m))
        for y in (np.arange(y0, y1 + 1e-9, spacing_m)[:: 1 if row % 2 == 0 else -1])
    ]
    model = make_object("box", rng, scale=0.5)
    path, pause = [], num_steps(rest_s)
    for number, (x, y) in enumerate(points):
        path += [(x, y)] * pause
        if number + 1 < len(points):
            share = np.linspace(0, 1, 51)[1:-1, None]
            smooth = ease(share)
            path += list((1 - smooth) * np.array([x, y]) + smooth * np.array(points[number + 1]))
    line = fitted(np.array(path), stage.steps)
    place = np.column_stack([line, np.full(stage.steps, height_m)])
    stage.object(model, Poses(place, np.broadcast_to([1.0, 0.0, 0.0, 0.0], (stage.steps, 4)).copy()))
    return stage.filmed("a tag rests at each point of a grid", num_antennas=3, rounds_per_antenna=2)
