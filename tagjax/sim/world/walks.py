"""Walks on a floor: several people in one area, or one person along a given path."""

from __future__ import annotations

import dataclasses

import numpy as np

from .bodies import STEP_S
from .crowd import Door, Rectangle, simulate
from .trajectory import num_steps

MAX_ACCELERATION_M_S2 = 2.0
"""Acceleration limit of the simulated walks; people start and stop at 1 to 2 m/s^2."""


@dataclasses.dataclass(frozen=True)
class Walk:
    """Position on the floor and heading of a walking person over time."""

    position_m: np.ndarray  # (num_steps, 2) world x y
    velocity_m_s: np.ndarray  # (num_steps, 2)
    heading_rad: np.ndarray  # (num_steps,)


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
    stop_probability: float = 0.15,
) -> tuple[Walk, ...]:
    """Walks of `num` people in one area, sampled every `STEP_S`. Their centres stay `min_distance_m` apart.

    They walk between random way points around `obstacles_m`, evade each other to the right and brake in time. The first
    `num_door` of them start outside the door, come in, and leave again if the crowd and the time (at least 20 s) allow
    it. Acceleration is at most `MAX_ACCELERATION_M_S2`. Raises `ValueError` where there is not enough room for all, or
    the distance could not be kept.
    """
    if num_door > num or num_door > (len(door.outside_m) if door else 0):
        raise ValueError(
            f"num_door is {num_door}; expected at most {num} people and {len(door.outside_m) if door else 0} places outside."
        )
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
            stop_probability,
            MAX_ACCELERATION_M_S2,
        )
        # Braking is planned, but people on several sides can use up the margin: such a draw is rejected.
        if _nearest(place) >= min_distance_m:
            return tuple(_as_walk(place[:, i], velocity[:, i], rng) for i in range(num))
    raise ValueError(
        f"{num} walkers could not keep {min_distance_m} m apart in {area_m}; ask for fewer walkers, a smaller distance or "
        "less furniture."
    )


def walk_along(path_m: np.ndarray, heading_rad: float | None = None) -> Walk:
    """A walk along a given path (steps, 2) or (steps, 3), of which z is ignored, such as one of `path_through`.

    `heading_rad` is the heading before the first motion; None takes the direction of the first motion.
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
    """Add the heading, which follows the velocity at 4 rad/s at most."""
    pace = np.linalg.norm(velocity, axis=-1)
    course = np.arctan2(velocity[:, 1], velocity[:, 0])
    moving = pace > 0.1
    first = course[np.argmax(moving)] if moving.any() else rng.uniform(-np.pi, np.pi)
    heading = np.empty(len(place))
    now, rate = first if start is None else start, 0.0
    for step in range(len(place)):
        turn = (course[step] - now + np.pi) % (2 * np.pi) - np.pi if moving[step] else 0.0
        # Turns start and end smoothly: the turn rate is bounded and low-pass filtered with 0.1 s.
        rate += (np.clip(5.0 * turn, -4.0, 4.0) - rate) * min(1.0, STEP_S / 0.1)
        now += rate * STEP_S
        heading[step] = now
    rng.uniform()  # unused; the frozen suites depend on the order of random numbers
    return Walk(place, velocity, heading)
