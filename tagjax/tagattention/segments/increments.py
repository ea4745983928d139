"""How far each segment's surface moved since the last frame: its range increment to each antenna, and its motion in space.

Increments add up: the mean of each pixel's own change has no steps where pixels join or leave a segment, as differences of
mean ranges have on slanted surfaces.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import entries, safe_sqrt
from ...image.warp import pixel_grid
from ...tracing.tracer import Camera
from .labels import STATIC, slot_sums

_SAME_SURFACE = 0.03  # taps whose depth differs from the nearest tap's by less than this fraction
_MIN_WEIGHT = 1e-3


# x, y, z: three maps, not one of three channels, which XLA gathers from several times as slowly on a CPU.
Maps = tuple[Float[Array, "height width"], Float[Array, "height width"], Float[Array, "height width"]]


class SegmentMotion(eqx.Module):
    """The motion of every segment since the last frame; 0 where it is not known."""

    increment_m: Float[Array, "antenna segment"]  # change of the range
    motion_m: Float[Array, "segment 3"]  # camera frame
    known: Bool[Array, " segment"]  # enough pixels were measured; the static background's is known to be 0


def pixel_sources(
    rays: Float[Array, "height width 3"],
    last_depth_m: Float[Array, "height width"],
    backward_px: Float[Array, "height width 2"],
) -> tuple[Maps, Bool[Array, "height width"]]:
    """The point of the last frame that each pixel shows: on the ray at the flow's end, at the depth of the surface there.

    That depth is bilinear over the taps within 3 % of the nearest tap's. Returns the points, and where the flow's source
    lies in the picture and has depth; the points are 0 elsewhere. Differentiable in depth and flow.
    """
    height, width = last_depth_m.shape
    x, y = pixel_grid(height, width, backward_px.dtype)
    x, y = x + backward_px[..., 0], y + backward_px[..., 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    x, y = jnp.where(inside, x, 0.0), jnp.where(inside, y, 0.0)
    left, top = jnp.floor(x), jnp.floor(y)
    right_weight, down_weight = x - left, y - top
    column, row = left.astype(jnp.int32), top.astype(jnp.int32)
    taps_m, weight = [], []
    for down in (0, 1):
        for right in (0, 1):
            below, beside = jnp.minimum(row + down, height - 1), jnp.minimum(column + right, width - 1)
            taps_m.append(entries(last_depth_m.reshape(-1), below * width + beside))
            weight.append(
                (down_weight if down else 1.0 - down_weight) * (right_weight if right else 1.0 - right_weight)
            )
    above_m, below_m = (jnp.where(right_weight > 0.5, right_m, left_m) for left_m, right_m in (taps_m[:2], taps_m[2:]))
    nearest_m = jnp.where(down_weight > 0.5, below_m, above_m)
    for tap, tap_m in enumerate(taps_m):
        same = (tap_m > 0) & (jnp.abs(tap_m - nearest_m) < _SAME_SURFACE * nearest_m)
        weight[tap] = jnp.where(same, weight[tap], 0.0)
    total = weight[0] + weight[1] + weight[2] + weight[3]
    known = inside & (total > _MIN_WEIGHT)
    mixed = [one * tap_m for one, tap_m in zip(weight, taps_m, strict=True)]
    before_m = jnp.where(known, (mixed[0] + mixed[1] + mixed[2] + mixed[3]) / jnp.where(known, total, 1.0), 0.0)
    # Rays are affine in the pixel: a pinhole's, with z = 1.
    across = (rays[0, -1, 0] - rays[0, 0, 0]) / max(width - 1, 1)
    down = (rays[-1, 0, 1] - rays[0, 0, 1]) / max(height - 1, 1)
    ray_x, ray_y = rays[..., 0] + across * backward_px[..., 0], rays[..., 1] + down * backward_px[..., 1]
    return (jnp.where(known, ray_x, 0.0) * before_m, jnp.where(known, ray_y, 0.0) * before_m, before_m), known


def _range_m(
    points_m: Sequence[Float[Array, "height width"]], antenna_m: Float[Array, " axis"]
) -> Float[Array, "height width"]:
    x, y, z = (axis - place for axis, place in zip(points_m, antenna_m, strict=True))
    return safe_sqrt(x * x + y * y + z * z)


def segment_motion(
    camera: Camera,
    labels: Int[Array, "height width"],
    counted: Bool[Array, "height width"],
    depth_m: Float[Array, "height width"],
    last_depth_m: Float[Array, "height width"],
    backward_px: Float[Array, "height width 2"],
    max_change_m: Float[Array, ""],
    num_segments: int,
    min_pixels: int = 2,
) -> SegmentMotion:
    """Each segment's mean change over its `counted` pixels of known source; 0 with fewer than `min_pixels`, and in slot 0.

    A source whose depth differs by `max_change_m` or more is another surface.
    Labels are constants; the gradient flows through depth and flow.
    """
    points = [camera.rays[..., axis] * depth_m for axis in range(3)]
    before, known = pixel_sources(camera.rays, last_depth_m, backward_px)
    measured = counted & known & (depth_m > 0) & (jnp.abs(depth_m - before[2]) < max_change_m) & (labels > STATIC)
    ranges = [_range_m(points, antenna) - _range_m(before, antenna) for antenna in camera.antennas_m]
    changes = [*ranges, *(now - then for now, then in zip(points, before, strict=True))]
    number, *summed = slot_sums([jnp.ones_like(depth_m), *changes], measured, labels, num_segments)
    enough = number >= min_pixels
    means = jnp.stack([jnp.where(enough, total / jnp.where(enough, number, 1.0), 0.0) for total in summed])
    num_antennas = len(ranges)
    known_segment = enough | (jnp.arange(num_segments) == STATIC)
    return SegmentMotion(means[:num_antennas], jnp.moveaxis(means[num_antennas:], 0, -1), known_segment)
