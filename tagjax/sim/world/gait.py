"""Footsteps of a given walk: feet that do not slide while they stand, and the height of the pelvis between them.

The walk is known beforehand, so every footfall is planned: a foot lands where it will be under its hip halfway through
its stance. Stance is 60 % and swing 40 % of a cycle (Perry, Gait Analysis, 1992).
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .bodies import STEP_S
from .trajectory import smooth_step
from .walks import Walk

_SWING_FRACTION = 0.8  # of the time between two footfalls; both feet stand in the remaining time


@dataclasses.dataclass(frozen=True)
class FootPlan:
    """One foot over time: ankle (steps, 3), heading and pitch (steps,; toes down positive), and when it stands."""

    ankle_m: np.ndarray
    heading_rad: np.ndarray
    pitch_rad: np.ndarray
    contact: np.ndarray  # (steps,) bool


@dataclasses.dataclass(frozen=True)
class FootSize:
    """Ankle height, and how far the ball of the foot and the heel lie ahead of and behind the ankle, m."""

    ankle_m: float
    ball_m: float
    heel_m: float
    hip_m: float  # half the distance between the hip joints


def step_time_s(speed_m_s: float) -> float:
    """Time between footfalls: 1.3 steps per second at 0.5 m/s and 2.1 at 1.4 m/s, as of adults at a brisk walk."""
    return 1.0 / float(np.clip(0.9 + 0.85 * speed_m_s, 1.25, 3.2))


def plan_feet(walk: Walk, size: FootSize) -> tuple[FootPlan, FootPlan]:
    """Left and right foot of a walk."""
    steps = len(walk.heading_rad)
    neutral = [_neutral(walk, side * size.hip_m) for side in (1.0, -1.0)]
    heading = np.unwrap(walk.heading_rad)
    plants: list[list[tuple[int, int, np.ndarray, float]]] = [[], []]  # lift, land, place, heading
    at = [(neutral[side][0], heading[0]) for side in (0, 1)]
    start = [at[0], at[1]]
    step, side = 0, 0
    while step < steps:
        moved = False
        for foot in (side, 1 - side):
            ahead = min(step + round(0.6 / STEP_S), steps - 1)
            speed = float(np.linalg.norm(walk.position_m[ahead] - walk.position_m[step])) / 0.6
            between = step_time_s(speed) / STEP_S
            land = step + max(2, round(_SWING_FRACTION * between))
            middle = min(land + round(0.6 * between), steps - 1)
            target, facing = neutral[foot][middle], heading[middle]
            if np.linalg.norm(target - at[foot][0]) > 0.03 or abs(facing - at[foot][1]) > 0.15:
                plants[foot].append((step, land, target, facing))
                at[foot] = (target, facing)
                step = land + max(1, round((1 - _SWING_FRACTION) * between))
                side, moved = 1 - foot, True
                break
        if not moved:
            step += 1
    left, right = (_foot_motion(start[foot], plants[foot], steps, size) for foot in (0, 1))
    return left, right


def _neutral(walk: Walk, aside_m: float) -> np.ndarray:
    """Position of a foot while standing: under its hip, (steps, 2)."""
    left = np.stack([-np.sin(walk.heading_rad), np.cos(walk.heading_rad)], axis=-1)
    return walk.position_m + aside_m * left


def _foot_motion(start, plants, steps: int, size: FootSize) -> FootPlan:
    """Ankle, heading and pitch from the list of swings."""
    place, heading = np.empty((steps, 2)), np.empty(steps)
    lift, pitch = np.zeros(steps), np.zeros(steps)
    contact = np.ones(steps, bool)
    place[:], heading[:] = start[0], start[1]
    # Positive pitch rotates about the ball (heel up), negative pitch about the heel (toes up).
    previous = start
    for number, (off, land, target, facing) in enumerate(plants):
        length = float(np.linalg.norm(target - previous[0]))
        strength = min(1.0, length / 1.3)
        swing = np.arange(off, min(land, steps))
        fraction = (swing - off) / (land - off)
        ease = smooth_step(fraction)
        place[swing] = previous[0] + ease[:, None] * (target - previous[0])
        heading[swing] = previous[1] + ease * (facing - previous[1])
        lift[swing] = (0.02 + 0.07 * strength) * np.sin(np.pi * fraction) ** 2
        up, down = 0.95 * strength, -0.3 * strength
        pitch[swing] = up + smooth_step(fraction) * (down - up)
        place[land:], heading[land:] = target, facing
        contact[swing] = False
        # The heel rises in the second half of the previous stance, and the sole comes down after the landing.
        begun = plants[number - 1][1] if number else 0
        rise = np.arange(max(begun, off - (land - off)), min(off, steps))
        if len(rise):
            pitch[rise] += up * smooth_step((rise - rise[0] + 1) / len(rise))
        settle = np.arange(min(land, steps), min(land + max(3, (land - off) // 4), steps))
        pitch[settle] += down * smooth_step(1 - (settle - land + 1) / max(3, (land - off) // 4))
        previous = (target, facing)
    ankle = _ankle(place, heading, pitch, size)
    ankle[:, 2] += lift
    return FootPlan(ankle, heading, pitch, contact)


def _ankle(place: np.ndarray, heading: np.ndarray, pitch: np.ndarray, size: FootSize) -> np.ndarray:
    """Ankle (steps, 3) of a foot that is pitched about its ball (heel up) or its heel (toes up), both on the floor."""
    pivot = np.where(pitch >= 0, size.ball_m, -size.heel_m)
    c, s = np.cos(pitch), np.sin(pitch)
    # The vector from pivot to ankle, (-pivot, ankle height), rotated: toes down moves the ankle forward and up.
    forward = pivot + c * -pivot + s * size.ankle_m
    up = s * pivot + c * size.ankle_m
    ahead = np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    return np.concatenate([place + forward[:, None] * ahead, up[:, None]], axis=-1)


def pelvis_height(
    hips_m: tuple[np.ndarray, np.ndarray], ankles_m: tuple[np.ndarray, np.ndarray], leg_m: float, standing_m: float
) -> np.ndarray:
    """Smooth height (steps,) of the hip joints, at most `standing_m`, at which both legs reach the ankles."""
    height = np.full(len(hips_m[0]), standing_m)
    for hip, ankle in zip(hips_m, ankles_m, strict=True):
        across = np.linalg.norm(hip[:, :2] - ankle[:, :2], axis=-1)
        height = np.minimum(height, ankle[:, 2] + np.sqrt(np.maximum((0.997 * leg_m) ** 2 - across**2, 0.2 * leg_m**2)))
    # In a sharp turn the feet are far apart for a moment: then one lifts off, and the person does not crouch.
    height = np.maximum(height, 0.86 * standing_m)
    half = round(0.05 / STEP_S)
    padded = np.pad(height, 2 * half, mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(padded, 2 * half + 1)
    # The mean of a running minimum over the same window never exceeds the curve itself.
    weight = np.hanning(2 * half + 3)[1:-1]
    low = windows.min(axis=-1)
    return np.lib.stride_tricks.sliding_window_view(low, 2 * half + 1) @ (weight / weight.sum())
