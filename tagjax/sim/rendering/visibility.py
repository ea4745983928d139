"""Visibility of bodies from a camera, computed from the poses alone, without rendering."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int

from ..world.bodies import STEP_S, Shape, World, rotation_matrix
from ..world.sightline import is_free
from .viewpoint import Viewpoint

_CUBE = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)], float)
_CUBE = _CUBE[np.isin(np.abs(_CUBE).sum(axis=1), (1, 3))]  # faces and corners


def surface_points(shapes: Sequence[Shape]) -> Float[np.ndarray, "points 3"]:
    """14 points on the surface of every shape, in the frame of its body: faces and corners, or evenly around."""
    parts = []
    for shape in shapes:
        a, b, c = shape.size_m
        around = _CUBE / np.linalg.norm(_CUBE, axis=1, keepdims=True)
        if shape.kind == "box":
            local = _CUBE * np.array([a, b, c])
        elif shape.kind in ("sphere", "ellipsoid"):
            local = around * (a if shape.kind == "sphere" else np.array([a, b, c]))
        elif shape.kind == "capsule":
            local = around * a + np.sign(_CUBE) * np.array([0.0, 0.0, b])
        else:
            across = _CUBE[:, :2] / np.maximum(np.linalg.norm(_CUBE[:, :2], axis=1, keepdims=True), 1.0)
            local = np.concatenate([across * a, _CUBE[:, 2:] * b], axis=1)
        turn = rotation_matrix(np.asarray(shape.quaternion, float))
        parts.append(local @ turn.T + np.asarray(shape.position_m))
    return np.concatenate(parts)


def visible_fraction(
    world: World,
    bodies: Sequence[int],
    camera: Viewpoint | Sequence[float],
    steps: Int[np.ndarray, " steps"],
) -> Float[np.ndarray, " steps"]:
    """Fraction of the surface points of some bodies that no other body hides from a camera, at steps of the world.

    With a `Viewpoint` only points within its picture count; a position (x, y, z) looks in all directions. The bodies do
    not hide themselves: a free line to a point on the far side enters by a visible point on the near side.
    """
    place = camera.position_m if isinstance(camera, Viewpoint) else np.asarray(camera, float)
    points = np.concatenate([_placed(world, body, steps) for body in bodies], axis=1)
    count = points.shape[1]
    ends = points.reshape(-1, 3)
    start = np.broadcast_to(place, ends.shape)
    free = is_free(world, start, ends, np.repeat(steps, count), exclude=bodies)
    if isinstance(camera, Viewpoint):
        k = camera.intrinsics
        x, y, z = camera.to_camera(ends).T
        ahead = z > 1e-6
        u, v = (f * p / np.where(ahead, z, 1.0) + c for f, p, c in ((k.fx_px, x, k.cx_px), (k.fy_px, y, k.cy_px)))
        free &= ahead & (u >= -0.5) & (u < k.width - 0.5) & (v >= -0.5) & (v < k.height - 0.5)
    return free.reshape(len(steps), count).mean(axis=1)


def intervals(seen: Bool[np.ndarray, " steps"]) -> Int[np.ndarray, "intervals 2"]:
    """First and one past the last index of every maximal run of True values."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], seen, [False]]).astype(np.int8)))
    return edges.reshape(-1, 2)


def sampled_steps(world: World, period_s: float) -> Int[np.ndarray, " steps"]:
    """Steps of a world, `period_s` apart, and its last step."""
    return np.unique(np.append(np.arange(0, world.num_steps, max(1, round(period_s / STEP_S))), world.num_steps - 1))


def _placed(world: World, body: int, steps: np.ndarray) -> np.ndarray:
    """Surface points (steps, points, 3) of a body in the world."""
    poses = world.bodies[body].poses
    index = np.minimum(steps, len(poses.position_m) - 1)
    turn = rotation_matrix(poses.quaternion[index])
    local = surface_points(world.bodies[body].shapes)
    return poses.position_m[index][:, None] + np.einsum("tij,pj->tpi", turn, local)
