"""What all tags share of a frame: its points, their 3D segments, how both have moved, and what stands in front."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..tracing.tracer import Camera
from .attention import centre_first
from .background import Background, in_front
from .motion import MotionMap
from .segmentation import Segments, pool, segment, segment_affinity, unpool

T = TypeVar("T")


class Grouping(eqx.Module):
    """How pixels are grouped, in physical units."""

    temperature: Float[Array, ""]  # softness of K-means, cells
    affinity_length: Float[Array, ""]  # cells over which segments share
    affinity_speed_m_s: Float[Array, ""]  # difference of speed at which they do no longer
    pool_motion: Float[Array, ""]  # share of the segment's mean in a pixel's motion
    cell: int = eqx.field(static=True)


class Ranging(eqx.Module):
    """What one antenna would see of a frame: how far everything is, and how that has changed over the window."""

    distance_m: Float[Array, "*antenna height width"]
    rho: Float[Array, "*antenna height width window"]
    known: Bool[Array, "*antenna height width"]
    segment_range_m: Float[Array, "*antenna rows columns"]
    rho_segment: Float[Array, "*antenna rows columns window"]


class View(eqx.Module):
    """One frame as all tags share it; `ranging` has a leading axis of antennas."""

    points_m: Float[Array, "height width 3"]
    valid: Bool[Array, "height width"]
    front: Float[Array, "height width"]
    time_s: Float[Array, " window"]
    segments: Segments
    segment_mass: Float[Array, "rows columns"]
    affinity: Float[Array, "9 rows columns"]
    ranging: Ranging

    @property
    def elapsed_s(self) -> Float[Array, ""]:
        return elapsed_s(self.time_s)


def of_each_antenna(function: Callable[..., T], *parts: Any) -> T:
    """What `function` makes of every antenna's part, stacked: written out, since antennas are few and batched gathers slow."""
    num_antennas = jax.tree.leaves(parts)[0].shape[0]
    each = [function(*jax.tree.map(lambda leaf, i=i: leaf[i], parts)) for i in range(num_antennas)]
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *each)


def elapsed_s(time_s: Float[Array, " window"]) -> Float[Array, ""]:
    """Since the frame before."""
    return jnp.maximum(time_s[-1] - time_s[-2], 1e-3)


def view_of(
    camera: Camera,
    points_m: Float[Array, "height width 3"],
    distance_m: Float[Array, "antenna height width"],
    valid: Bool[Array, "height width"],
    motion: MotionMap,
    step_m: Float[Array, "antenna height width"],
    time_s: Float[Array, " window"],
    background: Background,
    grouping: Grouping,
    objects: Float[Array, "object height width"] | None = None,
) -> View:
    """Segments, their motion, and what stands in front: once a frame, for all tags.

    The first antenna's distances serve where one will do: for the segments' motion, and for the background.
    """
    features = _features(camera, points_m, valid, step_m[0], elapsed_s(time_s), grouping)
    segments = segment(features, valid, grouping.temperature, cell=grouping.cell, objects=objects)
    rho, known, rho_segment = of_each_antenna(lambda one: _pooled_motion(segments, one, grouping.pool_motion), motion)
    means, mass = pool(
        segments,
        jnp.concatenate([features, jnp.moveaxis(distance_m, 0, -1)], axis=-1),
        valid.astype(points_m.dtype),
    )
    return View(
        points_m=points_m,
        valid=valid,
        front=in_front(background, distance_m[0], valid),
        time_s=time_s,
        segments=segments,
        segment_mass=mass,
        affinity=segment_affinity(segments, means[..., :3], means[..., 3], grouping.affinity_length),
        ranging=Ranging(distance_m, rho, known, jnp.moveaxis(means[..., 4:], -1, 0), rho_segment),
    )


def _features(
    camera: Camera,
    points_m: Float[Array, "height width 3"],
    valid: Bool[Array, "height width"],
    step_m: Float[Array, "height width"],
    elapsed_s: Float[Array, ""],
    grouping: Grouping,
) -> Float[Array, "height width 4"]:
    """Position in cells, (x, y) / cell and (f / cell) log z, and step in units of `affinity_speed_m_s`.

    Differences of position are metric ones over the width of a cell at that depth: segments of a thing in the
    hand and of a walker far away are made alike.
    """
    focal_px = 1.0 / (camera.rays[0, 1, 0] - camera.rays[0, 0, 0])
    depth_m = jnp.where(valid, points_m[..., 2], 1.0)
    place = jnp.stack([camera.rays[..., 0], camera.rays[..., 1], jnp.log(depth_m)], axis=-1) * focal_px / grouping.cell
    step = step_m / (grouping.affinity_speed_m_s * elapsed_s)
    return jnp.concatenate([place, step[..., None]], axis=-1)


def _pooled_motion(
    segments: Segments, motion: MotionMap, mix: Float[Array, ""]
) -> tuple[Float[Array, "height width window"], Bool[Array, "height width"], Float[Array, "rows columns window"]]:
    """Motion vectors of pixels mixed with their segment's mean, where that is known, and the segments' own."""
    num_window = motion.distance_m.shape[-1]
    full = jnp.all(motion.valid, axis=-1)
    own = jnp.where(full[..., None], centre_first(motion.distance_m, motion.valid), 0.0)
    mean, mass = pool(segments, own, full.astype(own.dtype))
    solid = (mass > 1.0).astype(own.dtype)[..., None]
    spread = unpool(segments, jnp.concatenate([mean * solid, solid], axis=-1))
    share = spread[..., num_window:]
    has = share[..., 0] > 0.5
    pooled = spread[..., :num_window] / jnp.maximum(share, 1e-3)
    blended = jnp.where(has[..., None], (1 - mix) * own + mix * pooled, own)
    return jnp.where(full[..., None], blended, pooled), full | has, mean * solid
