"""Smooth motion: walks on a floor alone and in company, a walker's limbs, and paths in space (`_trajectory`)."""

from __future__ import annotations

import dataclasses

import numpy as np

from ._crowd import Door, Rectangle, simulate
from ._trajectory import (
    blend,
    join,
    max_acceleration,
    max_speed,
    num_steps,
    path_through,
    rest,
    smooth_step,
    still_then_move,
    wave,
)
from .world import STEP_S

__all__ = [
    "CHEST_M",
    "LIMB_NAMES",
    "MAX_ACCELERATION_M_S2",
    "Door",
    "Rectangle",
    "Walk",
    "blend",
    "chest",
    "heading_matrix",
    "join",
    "limb_poses",
    "limb_shapes",
    "max_acceleration",
    "max_speed",
    "num_steps",
    "path_through",
    "random_walk",
    "random_walks",
    "rest",
    "smooth_step",
    "still_then_move",
    "walk_along",
    "wave",
]

MAX_ACCELERATION_M_S2 = 2.0
"""Of the simulated walks; people start and stop at 1 to 2 m/s^2."""


@dataclasses.dataclass(frozen=True)
class Walk:
    """A body's place on the floor and heading over time."""

    position_m: np.ndarray  # (num_steps, 2) world x y
    velocity_m_s: np.ndarray  # (num_steps, 2)
    heading_rad: np.ndarray  # (num_steps,)
    gait_rad: np.ndarray  # (num_steps,) phase of the stride


def random_walk(
    duration_s: float,
    step_s: float,
    rng: np.random.Generator,
    *,
    area_m: tuple[float, float, float, float],
    speed_m_s: tuple[float, float] = (0.5, 1.4),
    stop_share: float = 0.15,
) -> Walk:
    """Walk from way point to way point inside `area_m` (x0, y0, x1, y1), now and then standing for a while.

    The walker steers towards the next way point with acceleration at most `MAX_ACCELERATION_M_S2`.
    """
    x0, y0, x1, y1 = area_m
    place = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1)])
    velocity = np.zeros(2)
    target, speed, wait = place, 0.0, 0.0
    heading = rng.uniform(-np.pi, np.pi)
    gait = rng.uniform(0, 2 * np.pi)
    rows = []
    for _ in range(int(np.ceil(duration_s / step_s)) + 1):
        if np.linalg.norm(target - place) < 0.4 and wait <= 0:
            target = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1)])
            speed = rng.uniform(*speed_m_s)
            wait = rng.uniform(0.5, 2.0) if rng.random() < stop_share else 0.0
        direction = target - place
        distance = float(np.linalg.norm(direction))
        # Slow down in time to turn, rather than orbit the way point.
        wanted = direction / max(distance, 1e-6) * min(speed, np.sqrt(2 * 0.7 * max(distance, 0.05)))
        if wait > 0:
            wanted, wait = np.zeros(2), wait - step_s
        change = wanted - velocity
        limit = MAX_ACCELERATION_M_S2 * step_s
        velocity = velocity + change * min(1.0, limit / max(float(np.linalg.norm(change)), 1e-9))
        place = place + velocity * step_s
        pace = float(np.linalg.norm(velocity))
        if pace > 0.1:
            turn = (np.arctan2(velocity[1], velocity[0]) - heading + np.pi) % (2 * np.pi) - np.pi
            heading = heading + np.clip(turn, -4 * step_s, 4 * step_s)
        gait = gait + 2 * np.pi * step_s * (pace / 1.4)
        rows.append((place, velocity, heading, gait))
    return Walk(
        np.array([row[0] for row in rows]),
        np.array([row[1] for row in rows]),
        np.array([row[2] for row in rows]),
        np.array([row[3] for row in rows]),
    )


def random_walks(
    num: int,
    duration_s: float,
    rng: np.random.Generator,
    *,
    area_m: Rectangle,
    obstacles_m: tuple[Rectangle, ...] = (),
    speed_m_s: tuple[float, float] = (0.5, 1.4),
    min_distance_m: float = 0.6,
    door: Door | None = None,
    num_door: int = 0,
    stop_share: float = 0.15,
) -> tuple[Walk, ...]:
    """Walks of `num` people in one area, sampled every `STEP_S`: their centres stay `min_distance_m` apart.

    They walk from way point to way point round `obstacles_m`, veer to the right of each other and brake in time. The
    first `num_door` of them start at the door's outside places, come in, and go out again if crowd and time (20 s or
    more) let them. Acceleration is at most
    `MAX_ACCELERATION_M_S2`. Raises `ValueError` where there is no room for all, or the distance could not be kept.
    """
    if num_door > num or num_door > (len(door.outside_m) if door else 0):
        raise ValueError(f"{num_door} of {num} people through a door with {len(door.outside_m) if door else 0} places.")
    steps = num_steps(duration_s)
    for _ in range(8):
        place, velocity = simulate(
            num,
            steps,
            STEP_S,
            rng,
            area_m,
            obstacles_m,
            speed_m_s,
            min_distance_m,
            door,
            num_door,
            stop_share,
            MAX_ACCELERATION_M_S2,
        )
        # Braking is planned, yet a squeeze from several sides can eat the margin: such a draw is thrown away.
        if _nearest(place) >= min_distance_m:
            return tuple(_as_walk(place[:, i], velocity[:, i], rng) for i in range(num))
    raise ValueError(
        f"{num} walkers could not keep {min_distance_m} m apart in {area_m}: fewer walkers, a smaller distance or less "
        "furniture."
    )


def walk_along(path_m: np.ndarray, heading_rad: float | None = None) -> Walk:
    """A walk (steps, 2) or (steps, 3: z left out) that follows a given path, such as one of `path_through`.

    `heading_rad` is where the walker faces before the first move; along the first move if None.
    """
    place = np.asarray(path_m, float)[:, :2]
    velocity = np.gradient(place, STEP_S, axis=0) if len(place) > 1 else np.zeros_like(place)
    return _as_walk(place, velocity, np.random.default_rng(0), heading_rad)


def _nearest(place: np.ndarray) -> float:
    """Smallest distance between any two walkers at any step, from (steps, num, 2)."""
    num = place.shape[1]
    pairs = [np.linalg.norm(place[:, i] - place[:, j], axis=-1).min() for i in range(num) for j in range(i)]
    return min(pairs, default=np.inf)


def _as_walk(place: np.ndarray, velocity: np.ndarray, rng: np.random.Generator, start: float | None = None) -> Walk:
    """Add the heading, which follows the velocity at 4 rad/s or less, and the gait."""
    pace = np.linalg.norm(velocity, axis=-1)
    course = np.arctan2(velocity[:, 1], velocity[:, 0])
    moving = pace > 0.1
    first = course[np.argmax(moving)] if moving.any() else rng.uniform(-np.pi, np.pi)
    heading = np.empty(len(place))
    now, rate = first if start is None else start, 0.0
    for step in range(len(place)):
        turn = (course[step] - now + np.pi) % (2 * np.pi) - np.pi if moving[step] else 0.0
        # A turn starts and ends gently: bounded rate, and rate that follows in 0.1 s.
        rate += (np.clip(5.0 * turn, -4.0, 4.0) - rate) * min(1.0, STEP_S / 0.1)
        now += rate * STEP_S
        heading[step] = now
    gait = rng.uniform(0, 2 * np.pi) + np.cumsum(2 * np.pi * STEP_S * pace / 1.4)
    return Walk(place, velocity, heading, gait)


# name, radius m, ends in the body frame (x ahead, y left, z up) for a person of 1.75 m; swing: (amplitude rad, sign)
_LIMBS: tuple[tuple[str, float, tuple[float, float, float], tuple[float, float, float], float], ...] = (
    ("torso", 0.155, (0.0, 0.0, 1.00), (0.0, 0.0, 1.36), 0.0),
    ("hips", 0.145, (0.0, 0.0, 0.88), (0.0, 0.0, 0.98), 0.0),
    ("shoulders", 0.09, (0.0, -0.15, 1.42), (0.0, 0.15, 1.42), 0.0),
    ("head", 0.105, (0.02, 0.0, 1.60), (0.02, 0.0, 1.66), 0.0),
    ("left arm", 0.055, (0.0, 0.24, 1.40), (0.0, 0.26, 0.85), -0.45),
    ("right arm", 0.055, (0.0, -0.24, 1.40), (0.0, -0.26, 0.85), 0.45),
    ("left leg", 0.085, (0.0, 0.10, 0.88), (0.0, 0.10, 0.08), 0.42),
    ("right leg", 0.085, (0.0, -0.10, 0.88), (0.0, -0.10, 0.08), -0.42),
)

LIMB_NAMES = tuple(limb[0] for limb in _LIMBS)
CHEST_M = (0.16, 0.0, 1.28)
"""Where a tag is worn, body frame of a person of 1.75 m: on the chest's surface."""


def limb_shapes(height_m: float) -> list[tuple[str, float, float]]:
    """Name, radius and half length (of the capsule's axis) of every limb of a person."""
    scale = height_m / 1.75
    return [
        (name, radius * scale, 0.5 * scale * float(np.linalg.norm(np.subtract(end, start))))
        for name, radius, start, end, _ in _LIMBS
    ]


def limb_poses(walk: Walk, step: int, height_m: float) -> tuple[np.ndarray, np.ndarray]:
    """World centre (limbs, 3) and axis direction (limbs, 3, unit) of every limb at a step of the walk."""
    scale = height_m / 1.75
    pace = min(1.0, float(np.linalg.norm(walk.velocity_m_s[step])) / 1.0)
    centres, axes = [], []
    for _, _, start, end, swing in _LIMBS:
        a, b = np.array(start) * scale, np.array(end) * scale
        if swing:
            angle = swing * pace * np.sin(walk.gait_rad[step])
            arm = b - a
            c, s = np.cos(angle), np.sin(angle)
            b = a + np.array([c * arm[0] - s * arm[2], arm[1], s * arm[0] + c * arm[2]])
        centres.append((a + b) / 2)
        axes.append((b - a) / np.linalg.norm(b - a))
    turn = heading_matrix(float(walk.heading_rad[step]))
    base = np.array([*walk.position_m[step], 0.0])
    return base + np.array(centres) @ turn.T, np.array(axes) @ turn.T


def chest(walk: Walk, step: int, height_m: float) -> np.ndarray:
    """World position of a tag worn on the chest."""
    place = np.array(CHEST_M) * height_m / 1.75
    return np.array([*walk.position_m[step], 0.0]) + heading_matrix(float(walk.heading_rad[step])) @ place


def heading_matrix(heading_rad: float) -> np.ndarray:
    """Rotation about the vertical."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
