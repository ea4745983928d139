"""Stories of hand-held objects and standing people: objects are waved, hidden, handed over and put down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..world.bodies import STEP_S, Body, Material, Poses, Shape, rotation_matrix
from ..world.figure import PersonModel
from ..world.mounting import mounted
from ..world.objects import ObjectModel, make_object
from ..world.people import Hands, carried_poses, hand_target, make_person, move_person
from ..world.rooms import make_room
from ..world.rotation import quaternion_of
from ..world.trajectory import smooth_step
from ..world.walks import Walk
from .builder import (
    ScenarioBuilder,
    add_static_tags,
    add_walkers,
    ease,
    facing_towards,
    standing_places,
    standing_walk,
    waving_hand,
)
from .scenario import Scenario

_DRAWS = 8  # draws of waves until one is within reach of the arms
_NEAR_M = 5.0  # static tags farther away are rarely read


def handheld(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kinds: Sequence[str] = ("bottle",),
    lookalikes: Sequence[str] = (),
    speed_m_s: float = 1.0,
    stationary_s: float = 0.7,
    num_walkers: int = 0,
    one_grip: bool = False,
    notebook_occluder: bool = False,
    num_static_tags: int = 0,
    num_antennas: int = 1,
    distance_m: Sequence[float] = (1.7, 2.3),
    mounting: str = "as_drawn",
) -> Scenario:
    """People in front of the camera wave an object in each hand, after `stationary_s` without motion.

    `stationary_s` is limited to two fifths of the duration. Objects of the kinds in `lookalikes` look identical;
    `one_grip` puts all objects into one hand, side by side; with `notebook_occluder` a notebook in the other hand moves
    in front of the (only) object; `num_walkers` people walk behind; `num_static_tags` tagged objects lie in the room;
    `mounting` of the objects' tags as in `mounted`.
    """
    if notebook_occluder and len(kinds) != 1:
        raise ValueError(
            f"notebook_occluder with {len(kinds)} kinds; expected one kind, as the other hand holds the notebook."
        )
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    looks = {kind: int(rng.integers(2**31)) for kind in lookalikes}
    models = [mounted(make_object(kind, rng, look=looks.get(kind)), mounting) for kind in kinds]
    count = 1 if one_grip else -(-len(models) // 2)
    places = standing_places(builder.room, rng, count, (distance_m[0], distance_m[1]))
    camera = builder.room.camera_position_m
    for number, place in enumerate(places):
        facing = facing_towards(place, camera) + float(rng.uniform(-0.2, 0.2))
        walk = standing_walk(place, facing, builder.steps)
        mine = models if one_grip else models[2 * number : 2 * number + 2]
        sides = (-1, 1) if len(mine) > 1 and not one_grip else (-1,)
        waves = [waving_hand(walk, side, rng, duration_s, speed_m_s, stationary_s) for side in sides]
        person = make_person(rng)
        for _ in range(_DRAWS):
            # A hand at the limit of its arm's length stops abruptly: draw another wave.
            if _reaches(person, walk, waves):
                break
            waves = [waving_hand(walk, side, rng, duration_s, speed_m_s, stationary_s) for side in sides]
        left = (
            _occluding_hand(walk, waves[0], camera, duration_s)
            if notebook_occluder
            else (waves[1] if len(waves) > 1 else None)
        )
        hands = Hands(left=left, right=waves[0])
        motion = builder.person(person, walk, hands)
        if one_grip:
            _add_bundle(builder, mine, motion.right_hand)
        else:
            for model, hand in zip(mine, (motion.right_hand, motion.left_hand), strict=False):
                builder.object(model, carried_poses(hand, model.grip_m), held=True)
        if notebook_occluder:
            notebook = make_object("notebook", rng, scale=1.25)
            builder.object(notebook, _facing_camera(notebook, motion.left_hand, camera), tagged=False, held=True)
    add_walkers(builder, rng, num_walkers, duration_s, places)
    add_static_tags(builder, rng, num_static_tags, within_m=_NEAR_M)
    middle = np.mean(places, axis=0)
    return builder.scenario(
        "people wave objects", look_at_m=(middle[0], 0.8 * middle[1], 1.1), num_antennas=num_antennas
    )


def _reaches(person: PersonModel, walk: Walk, waves: Sequence[np.ndarray]) -> bool:
    """Whether the right hand, and the left one if it waves, follow their targets to 2 mm."""
    motion = move_person(person, walk, Hands(right=waves[0], left=waves[1] if len(waves) > 1 else None))
    hands = (motion.right_hand, motion.left_hand)
    return all(np.abs(wave - hand.position_m).max() < 0.002 for wave, hand in zip(waves, hands, strict=False))


def _add_bundle(builder: ScenarioBuilder, models: Sequence[ObjectModel], hand: Poses) -> None:
    """Add all objects as one rigid bundle in a hand."""
    first = carried_poses(hand, models[0].grip_m)
    turn = rotation_matrix(first.quaternion)
    reach = 0.0
    for number, model in enumerate(models):
        if number:
            reach += models[number - 1].half_size_m[1] + model.half_size_m[1] + 0.005
        builder.object(model, Poses(first.position_m + turn @ np.array([0.0, reach, 0.0]), first.quaternion), held=True)


def _occluding_hand(walk: Walk, object_m: np.ndarray, camera_m: Sequence[float], duration_s: float) -> np.ndarray:
    """Path of a hand that holds a notebook between camera and object for a second, in the middle of the recording."""
    time_s = np.arange(len(object_m)) * STEP_S
    toward = np.asarray(camera_m) - object_m
    cover = object_m + 0.2 * toward / np.linalg.norm(toward, axis=1, keepdims=True)
    aside = hand_target(walk, (0.3, 0.45, 1.0))
    begin = 0.55 * duration_s
    fraction = np.clip(np.minimum((time_s - begin) / 0.5, (begin + 2.0 - time_s) / 0.5), 0, 1)
    fraction = (ease(fraction))[:, None]
    return (1 - fraction) * aside + fraction * cover


def _facing_camera(model: ObjectModel, hand: Poses, camera_m: Sequence[float]) -> Poses:
    """Poses of a flat object that faces the camera, held at its centre."""
    toward = np.asarray(camera_m) - hand.position_m
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    side = np.cross([0.0, 0.0, 1.0], toward)
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    thin = int(np.argmin(model.half_size_m))
    axes: list[np.ndarray] = [np.cross(toward, side), side, toward]
    columns = [axes[(k - thin - 1) % 3] for k in range(3)]  # the thin axis points to the camera
    return Poses(hand.position_m.copy(), quaternion_of(np.stack(columns, axis=-1)))


def handover(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "box",
    speed_m_s: float = 0.9,
) -> Scenario:
    """One person waves an object and hands it to another person, who goes on waving it."""
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    (place,) = standing_places(builder.room, rng, 1, (2.0, 2.6))
    half = 0.45
    camera = np.array(builder.room.camera_position_m[:2])
    across = np.array([-(place[1] - camera[1]), place[0] - camera[0]])
    across = across / np.linalg.norm(across)
    spots = [np.array(place) - half * across, np.array(place) + half * across]
    # The headings are halfway between the other person and the camera.
    toward = (camera - place) / np.linalg.norm(camera - place)
    walks = []
    for spot, side in zip(spots, (1, -1), strict=True):
        ahead = toward + side * across
        walks.append(
            standing_walk((float(spot[0]), float(spot[1])), float(np.arctan2(ahead[1], ahead[0])), builder.steps)
        )
    time_s = np.arange(builder.steps) * STEP_S
    meet_s = 0.5 * duration_s
    meeting = np.array([*(0.5 * (spots[0] + spots[1]) + 0.3 * toward), 1.15])
    away = [waving_hand(walk, side, rng, duration_s, speed_m_s, 0.5) for walk, side in zip(walks, (1, -1), strict=True)]
    near = np.clip(1.25 * (1 - np.abs(time_s - meet_s) / 0.9), 0, 1)
    near = (ease(near))[:, None]
    targets = [(1 - near) * path + near * meeting for path in away]
    people = [make_person(rng), make_person(rng)]
    hands = [Hands(left=targets[0]), Hands(right=targets[1])]
    motions = [builder.person(person, walk, hand) for person, walk, hand in zip(people, walks, hands, strict=True)]
    model = make_object(kind, rng)
    giver, taker = carried_poses(motions[0].left_hand, model.grip_m), carried_poses(motions[1].right_hand, model.grip_m)
    # Both hands are at the meeting point for a moment; the object changes hands within it.
    fraction = np.clip((time_s - meet_s) / 0.2 + 0.5, 0, 1)[:, None]
    fraction = ease(fraction)
    turn = (1 - fraction) * giver.quaternion + fraction * taker.quaternion * np.sign(
        np.sum(giver.quaternion * taker.quaternion, axis=1, keepdims=True) + 1e-12
    )
    position = (1 - fraction) * giver.position_m + fraction * taker.position_m
    builder.object(model, Poses(position, turn / np.linalg.norm(turn, axis=1, keepdims=True)))
    return builder.scenario("an object is handed over", look_at_m=(place[0], 0.8 * place[1], 1.1))


def put_down(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "bottle",
    speed_m_s: float = 1.0,
) -> Scenario:
    """A person waves an object, puts it down on a stand, and takes the hand away; the object stays there."""
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    (place,) = standing_places(builder.room, rng, 1, (1.9, 2.5))
    camera = builder.room.camera_position_m
    walk = standing_walk(place, facing_towards(place, camera), builder.steps)
    time_s = np.arange(builder.steps) * STEP_S
    down_s = 0.6 * duration_s
    waved = waving_hand(walk, -1, rng, duration_s, speed_m_s, 0.5)
    spot, aside = hand_target(walk, (0.42, -0.3, 0.95)), hand_target(walk, (0.12, -0.34, 0.85))
    # The hand moves down to the stand, pauses there, then moves to the side.
    lower = smooth_step(np.clip((time_s - down_s + 0.8) / 0.8, 0, 1))[:, None]
    leave = smooth_step(np.clip((time_s - down_s - 0.2) / 0.6, 0, 1))[:, None]
    hands = Hands(right=(1 - leave) * ((1 - lower) * waved + lower * spot) + leave * aside)
    person, model = make_person(rng), make_object(kind, rng)
    held = carried_poses(builder.person(person, walk, hands).right_hand, model.grip_m)
    release = min(int(np.ceil((down_s + 0.1) / STEP_S)), builder.steps - 1)
    index = np.minimum(np.arange(builder.steps), release)
    builder.object(model, Poses(held.position_m[index], held.quaternion[index]))
    x, y, z = held.position_m[release]
    top = z - model.half_size_m[2]
    wood = Material((0.45, 0.32, 0.2), "stripes", 25.0, 0.25, transmission_db=2.0)
    stand = Shape("box", (0.16, 0.16, float(top) / 2), wood)
    builder.bodies.append(Body("stand", (stand,), Poses.fixed((x, y, top / 2)), "furniture"))
    return builder.scenario("an object is put down", look_at_m=(place[0], 0.8 * place[1], 1.0))
