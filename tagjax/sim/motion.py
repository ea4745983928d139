"""Smooth walks on a floor: random way points, turns and stops, bounded acceleration; and a walker's limbs."""

from __future__ import annotations

import dataclasses

import numpy as np

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
