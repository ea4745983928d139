"""Lines of sight between points of a world, and the bodies they pass through, in closed form (without ray casting)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from .bodies import METAL_REFLECTION, Body, Shape, World, rotation_matrix
from .objects import bounds

_GRAZE_M = 0.001


@dataclasses.dataclass(frozen=True)
class Sight:
    """The result for lines of sight: length inside each body, and the one-way loss of a radio wave."""

    inside_m: np.ndarray  # (lines, bodies)
    loss_db: np.ndarray  # (lines,) 0 = free, infinite behind metal

    @property
    def crossed(self) -> np.ndarray:
        """Which bodies each line passes through, (lines, bodies). Touching a body does not count."""
        return self.inside_m > _GRAZE_M


def line_of_sight(
    world: World, start_m: np.ndarray, end_m: np.ndarray, steps: np.ndarray, *, exclude: Sequence[int] = ()
) -> Sight:
    """Bodies between starts (lines, 3) and ends (lines, 3), metres, each line at its own step (lines,), rounded.

    The chords of all shapes are exact, and a line may pass through any number of bodies. Bodies in `exclude` are ignored
    (the tag's own). The loss of a body is that of the most lossy material crossed; the limbs of a person (bodies of one
    name) count once together; metal blocks completely.
    """
    start, end = np.broadcast_arrays(np.asarray(start_m, float), np.asarray(end_m, float))
    when = np.rint(np.asarray(steps)).astype(int)
    if start.shape != (len(when), 3):
        raise ValueError(f"Lines of shape {start.shape} at {len(when)} steps; expected ({len(when)}, 3).")
    inside = np.zeros((len(start), len(world.bodies)))
    loss: dict[tuple[str, int], np.ndarray] = {}
    for number, body in enumerate(world.bodies):
        if number in exclude:
            continue
        group = (body.name, -1) if body.role == "person" else (body.name, number)
        worst = loss.setdefault(group, np.zeros(len(start)))
        near, one, two = _near(body, start, end, when)
        for shape in body.shapes if near.size else ():
            chord = chord_m(shape, one, two)
            inside[near, number] = np.maximum(inside[near, number], chord)
            material = shape.material
            lost_db = np.inf if material.reflection <= METAL_REFLECTION else material.transmission_db
            worst[near] = np.maximum(worst[near], np.where(chord > _GRAZE_M, lost_db, 0.0))
    return Sight(inside, sum(loss.values(), np.zeros(len(start))))


def is_free(
    world: World, start_m: np.ndarray, end_m: np.ndarray, steps: np.ndarray, *, exclude: Sequence[int] = ()
) -> np.ndarray:
    """Whether nothing lies between starts and ends, (lines,): a faster `~line_of_sight(...).crossed.any(axis=1)`."""
    start, end, when = np.asarray(start_m, float), np.asarray(end_m, float), np.rint(np.asarray(steps)).astype(int)
    free = np.ones(len(when), bool)
    for number, body in enumerate(world.bodies):
        if number in exclude:
            continue
        left = np.flatnonzero(free)
        near, one, two = _near(body, start[left], end[left], when[left])
        for shape in body.shapes if near.size else ():
            free[left[near[chord_m(shape, one, two) > _GRAZE_M]]] = False
    return free


def _near(
    body: Body, start: np.ndarray, end: np.ndarray, when: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lines that come near a body at their steps, and their starts and ends in the body's frame."""
    index = np.clip(when, 0, len(body.poses.position_m) - 1)
    place = body.poses.position_m[index]
    low, high = bounds(body.shapes)
    reach = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high))))
    near = np.flatnonzero(_distance(start, end, place) <= reach)
    turn = rotation_matrix(body.poses.quaternion[index[near]])
    one, two = (np.einsum("nji,nj->ni", turn, p[near] - place[near]) for p in (start, end))
    return near, one, two


def chord_m(shape: Shape, start_m: np.ndarray, end_m: np.ndarray) -> np.ndarray:
    """Length (lines,) of segments (lines, 3) to (lines, 3), in the body's frame, inside a convex shape."""
    turn = rotation_matrix(np.asarray(shape.quaternion, float))
    start = (start_m - np.asarray(shape.position_m)) @ turn
    ray = (end_m - np.asarray(shape.position_m)) @ turn - start
    size = np.asarray(shape.size_m, float)
    if shape.kind == "box":
        enter, leave = _slab(start, ray, size)
    elif shape.kind in ("sphere", "ellipsoid"):
        axes = np.full(3, size[0]) if shape.kind == "sphere" else size
        enter, leave = _ball(start / axes, ray / axes)
    else:
        around = _ball(start[:, :2] / size[0], ray[:, :2] / size[0])
        within = _slab(start[:, 2:], ray[:, 2:], size[1:2])
        enter, leave = np.maximum(around[0], within[0]), np.minimum(around[1], within[1])
        if shape.kind == "capsule":
            # A capsule is convex: its span is the union of the spans of its three parts.
            enter, leave = np.where(enter < leave, enter, np.inf), np.where(enter < leave, leave, -np.inf)
            for side in (-1.0, 1.0):
                one, two = _ball((start - [0, 0, side * size[1]]) / size[0], ray / size[0])
                enter, leave = np.minimum(enter, one), np.maximum(leave, two)
    span = np.clip(leave, 0, 1) - np.clip(enter, 0, 1)
    return np.maximum(span, 0) * np.linalg.norm(ray, axis=-1)


def _distance(start: np.ndarray, end: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Distance (lines,) of points (lines, 3) from segments."""
    ray, away = end - start, point - start
    fraction = np.sum(ray * away, axis=-1) / np.maximum(np.sum(ray * ray, axis=-1), 1e-18)
    return np.linalg.norm(away - np.clip(fraction, 0, 1)[:, None] * ray, axis=-1)


def _slab(start: np.ndarray, ray: np.ndarray, half: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    safe = np.where(np.abs(ray) < 1e-12, 1e-12, ray)
    ends = np.stack([(-half - start) / safe, (half - start) / safe])
    return ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)


def _ball(start: np.ndarray, ray: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where lines enter and leave the unit ball (or disc), as fractions of `ray`; infinities that cross for a miss."""
    a = np.maximum(np.sum(ray * ray, axis=-1), 1e-18)
    b, c = np.sum(start * ray, axis=-1), np.sum(start * start, axis=-1) - 1
    root = b * b - a * c
    half = np.sqrt(np.maximum(root, 0))
    return np.where(root > 0, (-b - half) / a, np.inf), np.where(root > 0, (-b + half) / a, -np.inf)
