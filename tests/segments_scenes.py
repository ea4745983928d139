"""Cameras, scenes and runs that the tests of segments share."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from tagjax.tagattention.segments import SegmentFrame, SegmentTracker
from tagjax.tagattention.segments.step import focal_px
from tagjax.tracing.tracer import Camera

DT_S = 1 / 30
ANTENNAS_M = np.array([[0.4, -0.3, 0.1], [-0.5, 0.2, 0.0]], np.float32)


def pinhole(height: int, width: int, focal: float) -> Camera:
    y, x = np.mgrid[:height, :width].astype(np.float32)
    rays = np.stack([(x - (width - 1) / 2) / focal, (y - (height - 1) / 2) / focal, np.ones_like(x)], axis=-1)
    return Camera(jnp.asarray(rays.astype(np.float32)), jnp.asarray(ANTENNAS_M))


def scalar(value: float) -> jax.Array:
    return jnp.asarray(value, jnp.float32)


def random_scene(seed: int, num_frames: int, *, height: int = 23, width: int = 31):
    """A noisy wall and a nearer box that moves and pauses, holes in the depth, and flow with errors."""
    rng = np.random.default_rng(seed)
    wall = 1.6 + 0.01 * np.arange(width)[None] + rng.normal(0, 0.002, (height, width))
    left = 3.0
    for t in range(num_frames):
        speed = 0.0 if t % 12 > 7 else 1.0 + seed % 2
        left += speed
        depth = wall + rng.normal(0, 0.002, wall.shape)
        box = slice(6, 17), slice(int(left), int(left) + 9)
        depth[box] = 0.8 - 0.004 * t + rng.normal(0, 0.002, depth[box].shape)
        depth[rng.random(depth.shape) < 0.01] = 0.0
        flow = rng.normal(0, 0.02, (height, width, 2))
        flow[box] += (-speed, 0.0)
        flow[rng.random(depth.shape) < 0.02] += 3.0
        yield depth.astype(np.float32), flow.astype(np.float32)


def box_frame(t: float, dt: float, camera: Camera, *, velocity=(0.5, 0.06, -0.2), slope: float = 0.4):
    """Depth, exact backward flow and mask of a slanted square, 24 cm wide, in front of a wall at 2.5 m, at time `t`."""
    rays = np.asarray(camera.rays, np.float64)
    velocity = np.array(velocity)
    start = np.array([-0.25, 0.0, 1.3])
    place = start + velocity * t
    # A plane through the place: z = place_z + slope * (x - place_x), with x = ray_x * z.
    depth = (place[2] - slope * place[0]) / (1 - slope * rays[..., 0])
    point = rays * depth[..., None]
    mask = (np.abs(point[..., :2] - place[:2]) < 0.12).all(axis=-1)
    before = point - velocity * dt
    focal = float(focal_px(camera))
    flow = (before[..., :2] / before[..., 2:] - rays[..., :2]) * focal
    depth = np.where(mask, depth, 2.5)
    return depth.astype(np.float32), np.where(mask[..., None], flow, 0).astype(np.float32), mask, point


def run(tracker: SegmentTracker, camera: Camera, frames, dt: float = DT_S) -> list[SegmentFrame]:
    step, state, out = eqx.filter_jit(tracker.step), tracker.init(camera), []
    for depth, flow in frames:
        state, frame = step(camera, state, jnp.asarray(depth), jnp.asarray(flow), scalar(dt))
        out.append(frame)
    return out


def noisy(depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return (depth + rng.normal(0, 0.001, depth.shape)).astype(np.float32)


def segment_frame(
    centre_m, motion_m, *, area, life_s=0.0, displacement_m=None, source=None, size_m=0.06, front=1.0
) -> SegmentFrame:
    """A frame of segments with this motion, all of it known; slot 0 is the background. No pixels."""
    num_segments = len(area)
    motion_m = jnp.asarray(motion_m, jnp.float32)
    return SegmentFrame(
        labels=jnp.zeros((1, 1), jnp.int32),
        increment_m=motion_m.T[:1],
        motion_m=motion_m,
        known=jnp.ones(num_segments, bool),
        centre_m=jnp.asarray(centre_m, jnp.float32),
        area=jnp.asarray(area, jnp.float32),
        size_m=jnp.full(num_segments, size_m, jnp.float32),
        life_s=jnp.broadcast_to(jnp.asarray(life_s, jnp.float32), (num_segments,)),
        displacement_m=motion_m if displacement_m is None else jnp.asarray(displacement_m, jnp.float32),
        moved=jnp.ones(num_segments, bool),
        front=jnp.broadcast_to(jnp.asarray(front, jnp.float32), (num_segments,)),
        source=jnp.full(num_segments, -2, jnp.int32) if source is None else source,
        num_unplaced=jnp.zeros((), jnp.int32),
        background_lost=jnp.zeros(()),
    )
