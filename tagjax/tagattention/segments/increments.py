"""How far each segment's surface moved since the last frame: its range increment to each antenna, and its motion in space.

Increments add up: the mean of each pixel's own change has no steps where pixels join or leave a segment, as differences of
mean ranges have on slanted surfaces.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...image.warp import gather_taps, pixel_grid
from ...tracing.tracer import Camera
from .labels import STATIC

_SAME_SURFACE = 0.03  # taps whose depth differs from the nearest tap's by less than this fraction
_MIN_WEIGHT = 1e-3
_MIN_PIXELS = 2


class SegmentMotion(eqx.Module):
    """The motion of every segment since the last frame; 0 where it is not known."""

    increment_m: Float[Array, "antenna segment"]  # change of the range
    motion_m: Float[Array, "segment 3"]  # camera frame
    known: Bool[Array, " segment"]  # at least two pixels were measured; the static background's is known to be 0


def pixel_sources(
    rays: Float[Array, "height width 3"],
    last_depth_m: Float[Array, "height width"],
    backward_px: Float[Array, "height width 2"],
) -> tuple[Float[Array, "height width 3"], Bool[Array, "height width"]]:
    """The point of the last frame that each pixel shows: bilinear, over taps on the surface of the nearest tap.

    A surface is a depth within 3 % of the nearest tap's. Returns the points, and where the flow's source lies in the
    picture and has depth; the points are 0 elsewhere. Differentiable in depth and flow.
    """
    height, width = last_depth_m.shape
    points = rays * last_depth_m[..., None]
    taps = gather_taps(points, backward_px)
    nearest, largest = jnp.zeros_like(last_depth_m), jnp.full(last_depth_m.shape, -1.0, last_depth_m.dtype)
    for value, weight in taps:
        nearest, largest = jnp.where(weight > largest, value[..., 2], nearest), jnp.maximum(weight, largest)
    total, summed = jnp.zeros_like(last_depth_m), jnp.zeros_like(points)
    for value, weight in taps:
        same = (value[..., 2] > 0) & (jnp.abs(value[..., 2] - nearest) < _SAME_SURFACE * nearest)
        weight = jnp.where(same, weight, 0.0)
        total, summed = total + weight, summed + weight[..., None] * value
    x, y = pixel_grid(height, width, backward_px.dtype)
    x, y = x + backward_px[..., 0], y + backward_px[..., 1]
    known = (total > _MIN_WEIGHT) & (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    return jnp.where(known[..., None], summed / jnp.where(known, total, 1.0)[..., None], 0.0), known


def segment_motion(
    camera: Camera,
    labels: Int[Array, "height width"],
    counted: Bool[Array, "height width"],
    depth_m: Float[Array, "height width"],
    last_depth_m: Float[Array, "height width"],
    backward_px: Float[Array, "height width 2"],
    num_segments: int,
) -> SegmentMotion:
    """Each segment's mean change over its `counted` pixels of known source; 0 with fewer than two of them, and in slot 0.

    Labels are constants; the gradient flows through depth and flow.
    """
    points = camera.rays * depth_m[..., None]
    before, known = pixel_sources(camera.rays, last_depth_m, backward_px)
    measured = (counted & known & (depth_m > 0) & (labels > STATIC)).reshape(-1, 1)
    ranges = camera.ranges_m(points) - camera.ranges_m(before)
    num_antennas = ranges.shape[0]
    changes = jnp.concatenate([jnp.moveaxis(ranges, 0, -1), points - before], axis=-1).reshape(-1, num_antennas + 3)
    columns = jnp.concatenate([jnp.where(measured, changes, 0.0), measured.astype(changes.dtype)], axis=-1)
    total = jax.ops.segment_sum(columns, jnp.maximum(labels, 0).reshape(-1), num_segments)
    enough = total[:, -1] >= _MIN_PIXELS
    mean = jnp.where(enough[:, None], total[:, :-1] / jnp.where(enough, total[:, -1], 1.0)[:, None], 0.0)
    known_segment = enough | (jnp.arange(num_segments) == STATIC)
    return SegmentMotion(jnp.moveaxis(mean[:, :num_antennas], -1, 0), mean[:, num_antennas:], known_segment)
