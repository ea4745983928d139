"""RGB-D pictures of a scene by ray casting (no OpenGL), with depth noise, labels and exact flow."""

# MuJoCo's names come from a compiled module that the type checker cannot read.
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from ..core.geometry import pixel_rays
from ..recording import Intrinsics
from .scene import Scene

MAX_DEPTH_M = 9.0
"""Of the simulated sensor (Xtion: 0.5 to about 9 m)."""

MIN_DEPTH_M = 0.5


@dataclasses.dataclass(frozen=True)
class Viewpoint:
    """A camera in the room: `rotation` takes camera axes (x right, y down, z forward) to the world's."""

    intrinsics: Intrinsics
    position_m: np.ndarray
    rotation: np.ndarray

    def to_camera(self, points_m: np.ndarray) -> np.ndarray:
        """World points (..., 3) in the camera frame."""
        return (points_m - self.position_m) @ self.rotation


def corner_camera(intrinsics: Intrinsics, rng: np.random.Generator) -> Viewpoint:
    """A camera high on the near wall, looking down along the room."""
    position = np.array([rng.uniform(-0.3, 0.3), rng.uniform(-0.5, 0.5), rng.uniform(2.0, 2.45)])
    pitch, yaw = np.radians(rng.uniform(16, 26)), np.radians(rng.uniform(-8, 8))
    forward = np.array([np.cos(pitch) * np.cos(yaw), np.cos(pitch) * np.sin(yaw), -np.sin(pitch)])
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    return Viewpoint(intrinsics, position, np.stack([right, down, forward], axis=1))


@dataclasses.dataclass(frozen=True)
class Hits:
    """What every pixel's ray meets."""

    geom: np.ndarray  # (height, width) int32, -1 = nothing
    depth_m: np.ndarray  # (height, width) z, 0 = nothing
    normal: np.ndarray  # (height, width, 3) world
    local_m: np.ndarray  # (height, width, 3) hit point in the geom's frame
    world_m: np.ndarray  # (height, width, 3)


def cast(scene: Scene, view: Viewpoint) -> Hits:
    """Cast one ray a pixel through the posed scene."""
    rays = pixel_rays(view.intrinsics).astype(np.float64)
    length = np.linalg.norm(rays, axis=-1)
    world = (rays / length[..., None]) @ view.rotation.T
    shape = length.shape
    count = length.size
    geom = np.full(count, -1, np.int32)
    distance, normal = np.zeros(count), np.zeros(3 * count)
    mujoco.mj_multiRay(
        scene.model, scene.data, view.position_m, world.reshape(-1), None, True, -1, geom, distance, normal, count, 50.0
    )
    geom = geom.reshape(shape)
    hit = geom >= 0
    away = np.where(hit, distance.reshape(shape), 0.0)
    points = view.position_m + world * away[..., None]
    index = np.maximum(geom, 0)
    turn = scene.data.geom_xmat.reshape(-1, 3, 3)
    local = np.einsum("hwji,hwj->hwi", turn[index], points - scene.data.geom_xpos[index])
    return Hits(geom, np.where(hit, away / length, 0.0), normal.reshape(*shape, 3), local, points)


def shade(scene: Scene, hits: Hits, rng: np.random.Generator, *, noise: float = 0.012) -> np.ndarray:
    """The colour picture, uint8 RGB: textured surfaces under a ceiling light and ambient light, with sensor noise."""
    index = np.maximum(hits.geom, 0)
    light = np.array([0.35, -0.25, 0.9]) / np.linalg.norm([0.35, -0.25, 0.9])
    lambert = np.abs(hits.normal @ light) * 0.6 + np.clip(-hits.normal[..., 0], 0, 1) * 0.2 + 0.3
    texture = _texture(hits.local_m * scene.geom_scale[index][..., None], scene.geom_seed[index])
    tint = 1.0 + scene.geom_contrast[index] * (texture - 0.5) * 2.0
    colour = scene.geom_colour[index] * (lambert * tint)[..., None]
    colour = np.where((hits.geom >= 0)[..., None], colour, 0.02)
    colour = colour + rng.normal(0, noise, colour.shape)
    return (np.clip(colour, 0, 1) ** (1 / 1.6) * 255).astype(np.uint8)


def _texture(points: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Value noise of two octaves in 3D, 0 to 1: fixed to the surface, so it moves with it."""
    return 0.65 * _value_noise(points, seed) + 0.35 * _value_noise(points * 2.7 + 11.0, seed)


def _value_noise(points: np.ndarray, seed: np.ndarray) -> np.ndarray:
    base = np.floor(points).astype(np.int64)
    part = points - base
    part = part * part * (3 - 2 * part)
    out = np.zeros(points.shape[:-1])
    for corner in range(8):
        offset = np.array([corner & 1, corner >> 1 & 1, corner >> 2 & 1])
        weight = np.prod(np.where(offset, part, 1 - part), axis=-1)
        out += weight * _hash01(base + offset, seed)
    return out


def _hash01(cell: np.ndarray, seed: np.ndarray) -> np.ndarray:
    mixed = (cell[..., 0] * 73856093) ^ (cell[..., 1] * 19349663) ^ (cell[..., 2] * 83492791) ^ seed
    mixed = ((mixed ^ (mixed >> 13)) * 1274126177) & 0x7FFFFFFF
    return ((mixed ^ (mixed >> 16)) & 0xFFFF) / 65535.0


def sense_depth(hits: Hits, view: Viewpoint, rng: np.random.Generator) -> np.ndarray:
    """Depth as a structured-light sensor reports it, uint16 millimetres, 0 = missing.

    Axial noise 1.2 mm + 1.9 mm/m^2 (z - 0.4 m)^2 (Nguyen et al., 2012), quantisation of disparity in 1/8 px (about
    2.9 mm/m^2 z^2), missing at grazing angles, outside 0.5 to 9 m, and beside depth edges.
    """
    z = hits.depth_m
    sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
    noisy = z + rng.normal(size=z.shape) * sigma * 0.6
    # 580 px focal length, 75 mm baseline, 1/8 px of disparity.
    disparity = 8 * 580 * 0.075 / np.maximum(noisy, 0.1)
    quantised = 8 * 580 * 0.075 / np.rint(disparity)
    ray = hits.world_m - view.position_m
    ray = ray / np.maximum(np.linalg.norm(ray, axis=-1, keepdims=True), 1e-9)
    facing = np.abs(np.sum(ray * hits.normal, axis=-1))
    edge = np.zeros(z.shape, bool)
    jump = np.abs(np.diff(z, axis=1)) > 0.1 + 0.05 * z[:, 1:]
    edge[:, 1:] |= jump & (rng.random(jump.shape) < 0.5)
    missing = (facing < 0.12) | (z < MIN_DEPTH_M) | (z > MAX_DEPTH_M) | (hits.geom < 0) | edge
    missing |= rng.random(z.shape) < 0.002
    return np.where(missing, 0, np.rint(quantised * 1000)).astype(np.uint16)


def exact_flow(before: Hits, after: Hits, scene_after: Scene, view: Viewpoint) -> tuple[np.ndarray, np.ndarray]:
    """Flow of `before`'s pixels into the next picture, float32 (height, width, 2), and where its target is hidden.

    The scene must be posed for `after`: each hit point is carried along by its geom.
    """
    index = np.maximum(before.geom, 0)
    turn = scene_after.data.geom_xmat.reshape(-1, 3, 3)
    world = np.einsum("hwij,hwj->hwi", turn[index], before.local_m) + scene_after.data.geom_xpos[index]
    camera = view.to_camera(world)
    k = view.intrinsics
    z = np.maximum(camera[..., 2], 1e-6)
    x, y = k.fx_px * camera[..., 0] / z + k.cx_px, k.fy_px * camera[..., 1] / z + k.cy_px
    column, row = np.meshgrid(np.arange(k.width), np.arange(k.height))
    flow = np.stack([x - column, y - row], axis=-1).astype(np.float32)
    u, v = np.rint(x).astype(np.int64), np.rint(y).astype(np.int64)
    inside = (u >= 0) & (u < k.width) & (v >= 0) & (v < k.height) & (camera[..., 2] > 0)
    seen = after.depth_m[np.clip(v, 0, k.height - 1), np.clip(u, 0, k.width - 1)]
    hidden = ~inside | (seen < z - 0.03 * z)
    miss = before.geom < 0
    return np.where(miss[..., None], 0, flow).astype(np.float32), hidden & ~miss
