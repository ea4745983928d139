"""A story of people who enter a room through a door, walk about in it, and leave through the same door."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ..rendering.visibility import intervals, sampled_steps, visible_fraction
from ..world.bodies import STEP_S
from ..world.crowd import BODY_RADIUS_M, is_free, is_walkable
from ..world.objects import CARRIED_KINDS, make_object
from ..world.people import Hands, carried_poses, hand_target, make_person
from ..world.rooms import Room, make_room
from ..world.trajectory import num_steps, path_through, smooth_step, wait_then_move
from ..world.walks import Walk, walk_along
from .builder import HAND_M, ScenarioBuilder, waving_hand, with_length
from .scenario import Scenario

INSIDE_S = 3.0
"""Minimum time for which every person is visible."""

AWAY_S = 0.3
"""Minimum time at the start and at the end in which no person is visible."""

_APART_M = 0.7
_DOOR_M = 0.45  # distance before and behind the opening that is walked straight
_TRIES = 400
_PERIOD_S = 0.15  # sampling period of the visibility check


def enter_leave(
    rng: np.random.Generator,
    duration_s: float,
    *,
    num_people: int = 2,
    speed_m_s: Sequence[float] = (0.9, 1.3),
) -> Scenario:
    """People enter through a door one after the other, walk about, and leave, each with an object in the right hand.

    No person is visible in the first and the last `AWAY_S`; each is visible for at least `INSIDE_S` in between, in one
    interval or, where others occlude, in several. Raises `ValueError` where the time is too short for so many people.
    """
    room = make_room("entrance", rng)
    assert room.door is not None
    if not 1 <= num_people <= len(room.door.outside_m):
        raise ValueError(
            f"num_people is {num_people}; expected 1 to {len(room.door.outside_m)}, the places behind the door."
        )
    builder = ScenarioBuilder(room, duration_s)
    for walk in _visits(rng, room, duration_s, num_people, (speed_m_s[0], speed_m_s[1])):
        model = make_object(str(rng.choice(CARRIED_KINDS)), rng)
        hands = Hands(right=_hand(walk, room, rng, duration_s))
        motion = builder.person(make_person(rng), walk, hands)
        builder.object(model, carried_poses(motion.right_hand, model.grip_m), held=True)
    scenario = builder.scenario(f"{num_people} people enter through a door and leave through it")
    _check(scenario)
    return scenario


def _visits(rng, room: Room, duration_s: float, num_people: int, speed: tuple[float, float]) -> list[Walk]:
    """A walk for each person: from behind the door into the room and back, never near another person or furniture."""
    found: list[np.ndarray] = []
    for number in range(num_people):
        for _ in range(_TRIES):
            path = _visit(rng, room, number, duration_s, speed)
            if path is None:
                continue
            if all(np.linalg.norm(path - other, axis=1).min() >= _APART_M for other in found):
                found.append(path)
                break
        else:
            raise ValueError(
                f"No walk in and out within {duration_s} s for person {number + 1} of {num_people}; give more time, or "
                "ask for fewer people."
            )
    # They face the door while they wait.
    return [walk_along(path) for path in found]


def _visit(rng, room: Room, number: int, duration_s: float, speed: tuple[float, float]) -> np.ndarray | None:
    """Positions (steps, 2) of one visit; None where it touches furniture or takes too long."""
    assert room.door is not None
    x, y = room.door.opening_m
    before, behind = np.array([x - _DOOR_M - 0.1, y]), np.array([x + _DOOR_M, y])
    wait = np.array(room.door.outside_m[number])
    way, at = [wait, behind, before], before
    area, obstacles = room.walk_area_m, room.obstacles_m
    for _ in range(int(rng.integers(1, 5))):
        goal = np.array([rng.uniform(area[0] + 0.3, area[2] - 0.6), rng.uniform(area[1], area[3])])
        far = np.linalg.norm(goal - at) > 0.8
        if not (far and is_free(goal, area, obstacles, BODY_RADIUS_M + 0.1) and is_walkable(at, goal, obstacles)):
            return None
        way.append(goal)
        at = goal
    if np.linalg.norm(at - before) < 0.8 or not is_walkable(at, before, obstacles):
        return None
    way += [before, behind, wait]
    pace = float(rng.uniform(*speed))
    walking_s = float(np.linalg.norm(np.diff(way, axis=0), axis=1).sum()) / pace
    if not 0.4 * duration_s < walking_s < duration_s - 2 * AWAY_S:
        return None
    path = path_through([(*place, 0.0) for place in way], speed_m_s=pace, max_acceleration_m_s2=2.0)
    spare = duration_s - (len(path) - 1) * STEP_S - 2 * AWAY_S
    if spare < 0:
        return None
    # The start is delayed at random within the spare time.
    delay = AWAY_S + rng.uniform(0.0, spare)
    path = with_length(wait_then_move(path, delay), num_steps(duration_s))[:, :2]
    clear = [_clearance(path, box) for box in obstacles]
    return path if min(clear) >= BODY_RADIUS_M else None


def _clearance(path: np.ndarray, box: tuple[float, float, float, float]) -> float:
    away = np.maximum(np.maximum(np.array(box[:2]) - path, path - np.array(box[2:])), 0.0)
    return float(np.linalg.norm(away, axis=1).min())


def _hand(walk: Walk, room: Room, rng: np.random.Generator, duration_s: float) -> np.ndarray:
    """The right hand's path: waves a little in the room, stays close to the body in the doorway and behind it."""
    assert room.door is not None
    waved = waving_hand(walk, -1, rng, duration_s, 0.5, 0.0)
    close = hand_target(walk, (HAND_M[0] - 0.06, -0.14, 1.05))
    fraction = smooth_step((room.door.opening_m[0] - 0.5 - walk.position_m[:, 0]) / 0.8)[:, None]
    return fraction * waved + (1 - fraction) * close


def _check(scenario: Scenario) -> None:
    """Raise `ValueError` unless every person is invisible at both ends and visible in between."""
    world = scenario.world
    sampled = sampled_steps(world, _PERIOD_S)
    away = 1 + int(AWAY_S / _PERIOD_S)
    bodies: dict[str, list[int]] = {}
    for number, body in enumerate(world.bodies):
        if body.role == "person":
            bodies.setdefault(body.name, []).append(number)
    for (name, limbs), tag in zip(bodies.items(), world.tags, strict=True):
        seen = visible_fraction(world, (*limbs, tag.body), scenario.camera_position_m, sampled) > 0
        if seen[:away].any() or seen[-away:].any():
            raise ValueError(f"{name} is visible at the start or the end; try another seed.")
        shown = float(np.diff(intervals(seen), axis=1).sum()) * _PERIOD_S
        if shown < INSIDE_S:
            raise ValueError(f"{name} is visible for {shown:.1f} s; expected at least {INSIDE_S} s. Try another seed.")
