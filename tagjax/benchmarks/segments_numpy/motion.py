"""How far each segment's surface moved since the last frame: `tagattention.segments.increments` on the counted pixels."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import increments as original
from ...tagattention.segments.labels import STATIC


def _range_m(points: tuple[np.ndarray, ...], antenna_m: np.ndarray) -> np.ndarray:
    x, y, z = (axis - place for axis, place in zip(points, antenna_m, strict=True))
    return np.sqrt(x * x + y * y + z * z)


def segment_motion(
    rays: tuple[np.ndarray, np.ndarray],
    antennas_m: Float[np.ndarray, "antenna 3"],
    labels: Int[np.ndarray, "height width"],
    counted: Bool[np.ndarray, "height width"],
    depth_m: Float[np.ndarray, "height width"],
    last_depth_m: Float[np.ndarray, "height width"],
    backward_px: Float[np.ndarray, "height width 2"],
    max_change_m: np.float32,
    num_segments: int,
    min_pixels: int,
) -> tuple[Float[np.ndarray, "antenna segment"], Float[np.ndarray, "segment 3"], Bool[np.ndarray, " segment"]]:
    """Each segment's mean increment to each antenna, its mean motion, and where they are known."""
    height, width = depth_m.shape
    at = np.flatnonzero(counted & (depth_m > 0) & (labels > STATIC))
    flow = backward_px.reshape(-1, 2)[at]
    x, y = (at % width).astype(np.float32) + flow[:, 0], (at // width).astype(np.float32) + flow[:, 1]
    inside = (x >= 0) & (x <= width - 1) & (y >= 0) & (y <= height - 1)
    at, flow, x, y = at[inside], flow[inside], x[inside], y[inside]
    left, top = np.floor(x), np.floor(y)
    part_x, part_y = x - left, y - top
    column, row, flat = left.astype(np.int32), top.astype(np.int32), last_depth_m.ravel()
    beside, below = np.minimum(column + 1, width - 1), np.minimum(row + 1, height - 1)
    taps = [flat[r * width + c] for r in (row, below) for c in (column, beside)]
    nearest = np.where(part_y > 0.5, np.where(part_x > 0.5, taps[3], taps[2]), np.where(part_x > 0.5, taps[1], taps[0]))
    one = np.float32(1)
    total, mixed = np.zeros_like(x), np.zeros_like(x)
    for tap, weight_y, weight_x in zip(
        taps, (one - part_y, one - part_y, part_y, part_y), (one - part_x, part_x, one - part_x, part_x), strict=True
    ):
        same = (tap > 0) & (np.abs(tap - nearest) < original._SAME_SURFACE * nearest)
        weight = np.where(same, weight_y * weight_x, np.float32(0))
        total, mixed = total + weight, mixed + weight * tap
    known = total > original._MIN_WEIGHT
    before_m = np.where(known, mixed / np.where(known, total, one), np.float32(0))
    z, rays_x, rays_y = depth_m.ravel()[at], rays[0].ravel()[at], rays[1].ravel()[at]
    measured = known & (np.abs(z - before_m) < max_change_m)
    across = (rays[0][0, -1] - rays[0][0, 0]) / max(width - 1, 1)
    down = (rays[1][-1, 0] - rays[1][0, 0]) / max(height - 1, 1)
    now = rays_x * z, rays_y * z, z
    then = (rays_x + across * flow[:, 0]) * before_m, (rays_y + down * flow[:, 1]) * before_m, before_m
    changes = [_range_m(now, antenna) - _range_m(then, antenna) for antenna in antennas_m]
    changes += [one - other for one, other in zip(now, then, strict=True)]
    slot = labels.ravel()[at[measured]]
    number = np.bincount(slot, minlength=num_segments)
    enough = number >= min_pixels
    scale = np.where(enough, 1.0 / np.maximum(number, 1), 0.0)
    means = [(np.bincount(slot, change[measured], num_segments) * scale).astype(np.float32) for change in changes]
    known_segment = enough.copy()
    known_segment[STATIC] = True
    num_antennas = len(antennas_m)
    return np.stack(means[:num_antennas]), np.stack(means[num_antennas:], axis=-1), known_segment
