"""Stories of people who walk, and of a shop: to and fro, in a crowd, out of the exit; and its calibration grid."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ._stage_set import (
    StageSet,
    add_still_tags,
    ease,
    fitted,
    is_clear,
    trimmed,
    waved_hand,
)
from .motion import num_steps, path_through, random_walks, still_then_move, walk_along
from .objects import make_object
from .people import Hands, carried, hold, make_person
from .record import Filmed
from .rooms import make_room
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
    """A person walks towards the sensor and away again, to and fro, at a speed, an object in the right hand."""
    stage = StageSet(make_room(room, rng), duration_s)
    area = stage.room.walk_area_m
    camera = np.array(stage.room.camera_position_m)
    for _ in range(500):
        y = rng.uniform(area[1] + 0.3, area[3] - 0.3) * 0.6
        near = max(camera[0] + 1.5, area[0] - 0.1)
        far = min(area[2], near + rng.uniform(1.6, 2.9))
        line = np.linspace(near, far, 20)
        if all(is_clear(stage.room, (x, y)) for x in line):
            break
    else:
        raise ValueError(f"No free line towards the camera in the {stage.room.name}; try another seed.")
    turns = max(2, int(np.ceil(speed_m_s * duration_s / (far - near))) + 2)
    ends = [(far if k % 2 == 0 else near, y + (0.12 if k % 2 else 0.0), 0.0) for k in range(turns)]
    path = path_through(ends, speed_m_s=speed_m_s, max_acceleration_m_s2=3.0)
    walk = trimmed(walk_along(path), stage.steps)
    person, model = make_person(rng), make_object(kind, rng)
    hands = Hands(right=hold(walk, (0.25, -0.3, 1.0)))
    motion = stage.person(person, walk, hands)
    stage.object(model, carried(motion.right_hand, model.grip_m))
    return stage.filmed(f"a person walks to and fro at {speed_m_s} m/s", look_at_m=((near + far) / 2, 0.5 * y, 0.95))


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
        for number in range(tags_each):
            model = make_object(str(rng.choice(["bag", "box", "bottle", "toy"])), rng, scale=0.8)
            hand = (motion.right_hand, motion.left_hand)[number % 2]
            pose = carried(hand, model.grip_m)
            lift = 0.22 * (number // 2)
            stage.object(model, Poses(pose.position_m + np.array([0.0, 0.0, lift]), pose.quaternion))
    add_still_tags(stage, rng, num_still_tags)
    return stage.filmed(
        f"{num_people} people, {tags_each} tags each, {num_still_tags} still", num_antennas=3, rounds_per_antenna=2
    )


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
