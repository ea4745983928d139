"""Stories of a shop with ceiling antennas: people with tagged objects leave or stay, or hand one over; and calibration.

The shop of a `site` is always the same, as calibration requires; people, objects and walks differ.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Literal

import numpy as np

from ..world.bodies import STEP_S, Body, Material, Poses, Shape
from ..world.objects import ObjectModel, make_object
from ..world.people import Hands, carried_poses, hand_target, make_person
from ..world.rooms import make_room
from ..world.rotation import turn_about
from ..world.trajectory import num_steps, path_through, smooth_step, wait_then_move
from ..world.walks import Walk, walk_along
from .builder import UP, ScenarioBuilder, add_static_tags, ease, placed_object, walk_of_length, with_length
from .scenario import Scenario

EXIT_X_M = 1.4
"""Where the exit begins: below the first antenna, room frame."""

KINDS = ("bag", "box", "bottle", "toy")
"""Kinds of objects that people carry out of the shop."""

_GREY = Material((0.4, 0.4, 0.42), "speckle", 20.0, 0.1, transmission_db=2.0)

_BOX_HALF_M = 0.27
_BOX_SIDE_M = 1.2  # distance of its centre from the line of the antennas, clear of people who walk along the line

_LANE_M = 0.35  # distance of each person from the centre line at a hand-over: neither occludes the other
_REACH_M = 0.35  # distance ahead of the body at which hands meet


def shop_exit(
    rng: np.random.Generator,
    duration_s: float,
    *,
    num_people: int = 1,
    tags_each: int = 1,
    num_static_tags: int = 0,
    num_bystanders: int = 0,
    stay_probability: float = 0.5,
    tags: Literal["object", "level"] = "object",
    static_within_m: float | None = None,
    site: int | None = None,
) -> Scenario:
    """People with tagged objects walk about a shop of 3 x 7 m; each leaves through the exit, or stays.

    Each stays with `stay_probability`. Bystanders carry nothing and walk back and forth between the exit and the far end
    of the shop. Static tags lie anywhere, or, with `static_within_m`, on a grey box at most that far inwards of the exit's
    antenna, which reads them all the time. `tags`: "object" uses the tag of each object; "level" makes all dipoles
    horizontal in random directions, as suits ceiling antennas: a dipole that points at the antenna is in its null.
    """
    if not 1 <= tags_each <= 4:
        raise ValueError(f"tags_each is {tags_each}; expected 1 to 4 objects in two hands.")
    builder = _shop(rng, duration_s, site)
    x0, _, x1, _ = builder.room.walk_area_m
    everyone = num_people + num_bystanders
    lanes = np.linspace(-0.5, 0.5, everyone) if everyone > 1 else np.zeros(1)
    for lane in lanes[:num_people]:
        points = [(rng.uniform(x1 - 1.2, x1), lane, 0.0)]
        leaves = rng.random() >= stay_probability
        inner = rng.uniform(3.2, 4.2)
        points.append((inner, lane + rng.uniform(-0.15, 0.15), 0.0))
        points.append((x0 - 0.9 if leaves else rng.uniform(x1 - 1.5, x1 - 0.3), lane, 0.0))
        path = path_through(points, speed_m_s=rng.uniform(0.7, 1.2), max_acceleration_m_s2=2.0)
        walk = walk_of_length(walk_along(wait_then_move(path, rng.uniform(0.0, 1.0))), builder.steps)
        _add_customer(builder, rng, walk, tags_each)
    for lane in lanes[num_people:]:
        # Near and far positions alternate, so that bystanders meet the people who leave.
        ends = [(rng.uniform(1.6, 3.2) if k % 2 == 0 else rng.uniform(4.2, x1 - 0.3), lane, 0.0) for k in range(12)]
        path = path_through(ends, speed_m_s=rng.uniform(0.6, 1.1), max_acceleration_m_s2=2.0)
        builder.person(make_person(rng), walk_of_length(walk_along(path), builder.steps), Hands())
    if static_within_m is None:
        add_static_tags(builder, rng, num_static_tags)
    elif num_static_tags:
        _add_static_tags_on_box(builder, rng, num_static_tags, static_within_m)
    if tags == "level":
        _make_dipoles_horizontal(builder, rng)
    return builder.scenario(
        f"{num_people} people, {tags_each} tags each, {num_static_tags} static tags",
        num_antennas=3,
        rounds_per_antenna=2,
    )


def shop_handover(
    rng: np.random.Generator, duration_s: float, *, speed_m_s: float = 0.9, kind: str = "box", site: int | None = None
) -> Scenario:
    """One person brings an object and hands it to another, who puts it on a box farther inside; both leave by the exit.

    Fig. 7 of Goller et al.: the tag belongs to the first person, then to the second, then to the background. The two
    walk towards each other, meet at 0.25 of the duration below the second antenna and part at once, so that each carries
    the object from one antenna's zone to the next: within one zone a tag seems stationary. The dipole is horizontal.
    """
    if duration_s < 19.0:
        raise ValueError(f"duration_s is {duration_s}; expected at least 19 s for a hand-over.")
    builder = _shop(rng, duration_s, site)
    x0, _, x1, _ = builder.room.walk_area_m
    meet_s, meet_x, box_x = 0.25 * duration_s, float(rng.uniform(3.4, 3.8)), float(rng.uniform(5.8, 6.1))
    time_s = np.arange(builder.steps) * STEP_S

    def half_s(start: float, end: float) -> float:
        """Half of the time that a walk between two positions takes."""
        return 0.7 * abs(end - start) / speed_m_s

    def walk(stops: Sequence[tuple[float, float]], lane: float, heading: float) -> Walk:
        """A walk from the first position through (time at half of the way, position), with pauses in between."""
        x = np.full(builder.steps, stops[0][1])
        for (_, start), (middle_s, end) in itertools.pairwise(stops):
            x = x + (end - start) * smooth_step(np.clip((time_s - middle_s) / (2 * half_s(start, end)) + 0.5, 0, 1))
        return walk_along(np.column_stack([x, np.full(builder.steps, lane)]), heading)

    near, far, out = EXIT_X_M + 0.2, x1 - 0.1, x0 - 0.9
    giver, taker = meet_x - _REACH_M, meet_x + _REACH_M
    before, after = meet_s - 0.3, meet_s + 0.3
    down_s = after + 2 * half_s(taker, box_x)
    ways = (
        [(0.0, near), (before - half_s(near, giver), giver), (after + half_s(giver, out), out)],
        [(0.0, far), (before - half_s(far, taker), taker), (after + half_s(taker, box_x), box_x),
         (down_s + 0.6 + half_s(box_x, out), out)],
    )  # fmt: skip
    walks = [walk(ways[0], -_LANE_M, 0.0), walk(ways[1], _LANE_M, np.pi)]
    meeting = np.array([meet_x, 0.0, 1.1])
    close = ease(np.clip(1.25 * (1 - np.abs(time_s - meet_s) / 0.9), 0, 1))[:, None]
    held = [hand_target(one, (0.3, 0.2, 1.0)) for one in walks]
    targets = [(1 - close) * path + close * meeting for path in held]
    spot = np.array([box_x + 0.1, _LANE_M + 0.45, 0.95])
    lower = smooth_step(np.clip((time_s - down_s + 0.7) / 0.7, 0, 1))[:, None]
    lift = smooth_step(np.clip((time_s - down_s - 0.1) / 0.4, 0, 1))[:, None]
    targets[1] = (1 - lower) * targets[1] + lower * ((1 - lift) * spot + lift * held[1])
    motions = [
        builder.person(make_person(rng), one, Hands(left=target)) for one, target in zip(walks, targets, strict=True)
    ]
    model = make_object(kind, rng, scale=0.8)
    one, other = (carried_poses(motion.left_hand, model.grip_m) for motion in motions)
    fraction = ease(np.clip((time_s - meet_s) / 0.2 + 0.5, 0, 1))[:, None]
    # The two hold it half a rotation apart: the direction of the rotation is chosen once.
    middle = int(meet_s / STEP_S)
    sign = 1.0 if one.quaternion[middle] @ other.quaternion[middle] >= 0 else -1.0
    turn = (1 - fraction) * one.quaternion + fraction * other.quaternion * sign
    place = (1 - fraction) * one.position_m + fraction * other.position_m
    index = np.minimum(np.arange(builder.steps), int(np.ceil((down_s + 0.05) / STEP_S)))
    builder.object(model, Poses(place[index], (turn / np.linalg.norm(turn, axis=1, keepdims=True))[index]))
    x, y, z = (float(value) for value in place[index[-1]])
    top = z - model.half_size_m[2]
    stand = Shape("box", (0.16, 0.16, top / 2), _GREY)
    builder.bodies.append(Body("stand", (stand,), Poses.fixed((x, y, top / 2)), "furniture"))
    _make_dipoles_horizontal(builder, rng)
    return builder.scenario("an object is handed over in a shop", num_antennas=3, rounds_per_antenna=2)


def grid(
    rng: np.random.Generator,
    duration_s: float,
    *,
    spacing_m: float = 0.5,
    height_m: float = 1.0,
    pause_s: float = 2.0,
    tags: Literal["object", "level"] = "object",
    site: int | None = None,
) -> Scenario:
    """A tag that pauses at each point of a grid on the shop floor in turn, for antenna calibration.

    `tags` as in `shop_exit`; a level dipole is rotated by 90 degrees halfway through each pause, between along and
    across the line of the antennas.
    """
    builder = _shop(rng, duration_s, site)
    x0, y0, x1, y1 = builder.room.walk_area_m
    points = [
        (x, y)
        for row, x in enumerate(np.arange(x0, x1 + 1e-9, spacing_m))
        for y in (np.arange(y0, y1 + 1e-9, spacing_m)[:: 1 if row % 2 == 0 else -1])
    ]
    model = make_object("box", rng, scale=0.5)
    path, across, pause = [], [], num_steps(pause_s)
    for number, (x, y) in enumerate(points):
        path += [(x, y)] * pause
        across += [number % 2 == 0] * (pause // 2) + [number % 2 == 1] * (pause - pause // 2)
        if number + 1 < len(points):
            fraction = np.linspace(0, 1, 51)[1:-1, None]
            smooth = ease(fraction)
            path += list((1 - smooth) * np.array([x, y]) + smooth * np.array(points[number + 1]))
            across += [number % 2 == 1] * len(fraction)
    line, turned = with_length(np.array(path), builder.steps), with_length(np.array(across), builder.steps)
    place = np.column_stack([line, np.full(builder.steps, height_m)])
    turn = np.where(turned[:, None] & (tags == "level"), turn_about(UP, np.pi / 2), [1.0, 0.0, 0.0, 0.0])
    builder.object(model, Poses(place, turn))
    if tags == "level":
        on_top = (0.0, 0.0, float(model.half_size_m[2]))  # at the centre, so that a rotation does not move it
        builder.tags[0] = dataclasses.replace(builder.tags[0], position_m=on_top, dipole=(0.0, 1.0, 0.0))
    return builder.scenario("a tag pauses at each point of a grid", num_antennas=3, rounds_per_antenna=2)


def _shop(rng: np.random.Generator, duration_s: float, site: int | None) -> ScenarioBuilder:
    return ScenarioBuilder(make_room("shop_floor", rng if site is None else np.random.default_rng(site)), duration_s)


def _add_customer(builder: ScenarioBuilder, rng: np.random.Generator, walk: Walk, num_tags: int) -> None:
    """Add a person with objects in the right hand and, from the second object on, in the left and right hand in turn."""
    person = make_person(rng)
    left = hand_target(walk, (0.2, 0.28, 0.95)) if num_tags > 1 else None
    motion = builder.person(person, walk, Hands(right=hand_target(walk, (0.2, -0.28, 0.95)), left=left))
    held: list[ObjectModel] = []
    for number in range(num_tags):
        model = make_object(str(rng.choice(KINDS)), rng, scale=0.8)
        pose = carried_poses((motion.right_hand, motion.left_hand)[number % 2], model.grip_m)
        lift = _lift(held[number - 2], model) if number > 1 else 0.0
        builder.object(model, Poses(pose.position_m + np.array([0.0, 0.0, lift]), pose.quaternion), held=True)
        held.append(model)


def _lift(first: ObjectModel, second: ObjectModel) -> float:
    """Vertical offset of the second object in a hand, which puts it just above or below the first."""
    room = first.half_size_m[2] + second.half_size_m[2] + 0.01
    grips = second.grip_m[2] - first.grip_m[2]
    return min(grips + room, grips - room, key=abs)


def _add_static_tags_on_box(builder: ScenarioBuilder, rng: np.random.Generator, count: int, within_m: float) -> None:
    """Add small tagged objects on a grey box at a wall, up to `within_m` inwards of the first antenna."""
    if not 1 <= count <= 4:
        raise ValueError(f"{count} static tags; expected 1 to 4 on the box.")
    antenna, half = np.array(builder.room.antennas_m[0]), _BOX_HALF_M
    for _ in range(200):
        x = float(antenna[0] + rng.uniform(0.3, max(within_m, 0.35)))
        y = float(rng.choice([-1, 1])) * _BOX_SIDE_M
        if all(
            b[0] > x + half or b[2] < x - half or b[1] > y + half or b[3] < y - half for b in builder.room.obstacles_m
        ):
            break
    else:
        raise ValueError(f"No free position for a box within {within_m} m of the exit's antenna; try another seed.")
    top = float(rng.uniform(0.5, 0.9))
    shape = Shape("box", (half, half, top / 2), _GREY)
    builder.bodies.append(Body("grey box", (shape,), Poses.fixed((x, y, top / 2)), "furniture"))
    for number in range(count):
        model = make_object(str(rng.choice(["book", "mug", "box"])), rng, scale=0.6)
        spot = (x + half * (number % 2 - 0.5), y + half * (number // 2 % 2 - 0.5), top)
        builder.object(model, placed_object(model, spot, float(rng.uniform(0, 2 * np.pi))), labelled=False)


def _make_dipoles_horizontal(builder: ScenarioBuilder, rng: np.random.Generator) -> None:
    """Make every tag's dipole horizontal, in a random direction (objects here stay upright)."""
    for number, angle in enumerate(rng.uniform(0, 2 * np.pi, len(builder.tags))):
        axis = (float(np.cos(angle)), float(np.sin(angle)), 0.0)
        builder.tags[number] = dataclasses.replace(builder.tags[number], dipole=axis)
