"""Stories of people who stand: objects waved, hidden, handed over and put down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..world.bodies import STEP_S, Body, Material, Poses, Shape, rotation_matrix
from ..world.figure import PersonModel
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

_DRAWS = 8  # of waves within reach of the arms
_NEAR_M = 5.0  # still tags farther away are hardly read


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
) -> Scenario:
    """People before the camera wave an object in each hand, at rest for `stationary_s` first
    (two fifths of the time at most).

    `lookalikes` names kinds whose objects look exactly alike; `one_grip` puts all objects into one hand, side by side;
    `passing` lets a notebook in the other hand pass before the (one) object; `num_walkers` walk behind;
    `num_static_tags` lie around.
    """
    if notebook_occluder and len(kinds) != 1:
        raise ValueError(f"A notebook passes before one object; found {len(kinds)} kinds.")
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    looks = {kind: int(rng.integers(2**31)) for kind in lookalikes}
    models = [make_object(kind, rng, look=looks.get(kind)) for kind in kinds]
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
            # An arm that is too short stops its hand short of the wave, with a jerk.
            if _reaches(person, walk, waves):
                break
            waves = [waving_hand(walk, side, rng, duration_s, speed_m_s, stationary_s) for side in sides]
        left = (
            _before(walk, waves[0], camera, duration_s) if notebook_occluder else (waves[1] if len(waves) > 1 else None)
        )
        hands = Hands(left=left, right=waves[0])
        motion = builder.person(person, walk, hands)
        if one_grip:
            _together(builder, mine, motion.right_hand)
        else:
            for model, hand in zip(mine, (motion.right_hand, motion.left_hand), strict=False):
                builder.object(model, carried_poses(hand, model.grip_m))
        if notebook_occluder:
            notebook = make_object("notebook", rng, scale=1.25)
            builder.object(notebook, _upright_sheet(notebook, motion.left_hand, camera), tagged=False)
    add_walkers(builder, rng, num_walkers, duration_s, places)
    add_static_tags(builder, rng, num_static_tags, within_m=_NEAR_M)
    middle = np.mean(places, axis=0)
    return builder.scenario(
        "people wave objects", look_at_m=(middle[0], 0.8 * middle[1], 1.1), num_antennas=num_antennas
    )


def _reaches(person: PersonModel, walk: Walk, waves: Sequence[np.ndarray]) -> bool:
    """Whether the right hand, and the left if it has a wave, keep to their waves, to 2 mm."""
    motion = move_person(person, walk, Hands(right=waves[0], left=waves[1] if len(waves) > 1 else None))
    hands = (motion.right_hand, motion.left_hand)
    return all(np.abs(wave - hand.position_m).max() < 0.002 for wave, hand in zip(waves, hands, strict=False))


def _together(builder: ScenarioBuilder, models: Sequence[ObjectModel], hand: Poses) -> None:
    """All objects as one rigid bundle in a hand."""
    first = carried_poses(hand, models[0].grip_m)
    turn = rotation_matrix(first.quaternion)
    reach = 0.0
    for number, model in enumerate(models):
        if number:
            reach += models[number - 1].half_size_m[1] + model.half_size_m[1] + 0.005
        builder.object(model, Poses(first.position_m + turn @ np.array([0.0, reach, 0.0]), first.quaternion))


def _before(walk: Walk, object_m: np.ndarray, camera_m: Sequence[float], duration_s: float) -> np.ndarray:
    """A hand that brings a notebook between camera and object for a second, about the middle, and takes it away."""
    time_s = np.arange(len(object_m)) * STEP_S
    toward = np.asarray(camera_m) - object_m
    cover = object_m + 0.2 * toward / np.linalg.norm(toward, axis=1, keepdims=True)
    aside = hand_target(walk, (0.3, 0.45, 1.0))
    begin = 0.55 * duration_s
    fraction = np.clip(np.minimum((time_s - begin) / 0.5, (begin + 2.0 - time_s) / 0.5), 0, 1)
    fraction = (ease(fraction))[:, None]
    return (1 - fraction) * aside + fraction * cover


def _upright_sheet(model: ObjectModel, hand: Poses, camera_m: Sequence[float]) -> Poses:
    """A flat object that faces the camera, held at its middle."""
    toward = np.asarray(camera_m) - hand.position_m
    toward = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    side = np.cross([0.0, 0.0, 1.0], toward)
    side = side / np.linalg.norm(side, axis=1, keepdims=True)
    thin = int(np.argmin(model.half_size_m))
    axes: list[np.ndarray] = [np.cross(toward, side), side, toward]
    columns = [axes[(k - thin - 1) % 3] for k in range(3)]  # the thin axis looks at the camera
    return Poses(hand.position_m.copy(), quaternion_of(np.stack(columns, axis=-1)))


def handover(
    rng: np.random.Generator,
    duration_s: float,
    *,
    room: str = "meeting_room",
    kind: str = "box",
    speed_m_s: float = 0.9,
) -> Scenario:
    """One person waves an object and hands it to another, who waves it on."""
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    (place,) = standing_places(builder.room, rng, 1, (2.0, 2.6))
    half = 0.45
    camera = np.array(builder.room.camera_position_m[:2])
    across = np.array([-(place[1] - camera[1]), place[0] - camera[0]])
    across = across / np.linalg.norm(across)
    spots = [np.array(place) - half * across, np.array(place) + half * across]
    # Half turned to each other, half to the camera.
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
    # Both hands are at the meeting point for a moment; the object goes over within it.
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
    """A person waves an object, puts it down on a stand, and takes the hand away: it stays there."""
    builder = ScenarioBuilder(make_room(room, rng), duration_s)
    (place,) = standing_places(builder.room, rng, 1, (1.9, 2.5))
    camera = builder.room.camera_position_m
    walk = standing_walk(place, facing_towards(place, camera), builder.steps)
    time_s = np.arange(builder.steps) * STEP_S
    down_s = 0.6 * duration_s
    waved = waving_hand(walk, -1, rng, duration_s, speed_m_s, 0.5)
    spot, aside = hand_target(walk, (0.42, -0.3, 0.95)), hand_target(walk, (0.12, -0.34, 0.85))
    # Down to the spot, a moment of rest there, then back to the side.
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
