"""What all tags share of a frame: its points, their 3D segments, how both have moved, and what stands in front."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from .attention import centre_first
from .background import Background, in_front
from .motion import MotionMap
from .segmentation import Segments, pool, segment, segment_affinity, unpool
from .tracer import Camera


class Grouping(eqx.Module):
    """How pixels are grouped, in physical units."""

    temperature: Float[Array, ""]  # softness of K-means, cells
    affinity_length: Float[Array, ""]  # cells over which segments share
    affinity_speed_m_s: Float[Array, ""]  # difference of speed at which they do no longer
    pool_motion: Float[Array, ""]  # share of the segment's mean in a pixel's motion
    cell: int = eqx.field(static=True)


class View(eqx.Module):
    """One frame as all tags share it."""

    points_m: Float[Array, "height width 3"]
    distance_m: Float[Array, "height width"]
    valid: Bool[Array, "height width"]
    front: Float[Array, "height width"]
    time_s: Float[Array, " window"]
    segments: Segments
    segment_range_m: Float[Array, "rows columns"]
    segment_mass: Float[Array, "rows columns"]
    affinity: Float[Array, "9 rows columns"]
    rho: Float[Array, "height width window"]
    known: Bool[Array, "height width"]
    rho_segment: Float[Array, "rows columns window"]

    @property
    def elapsed_s(self) -> Float[Array, ""]:
        return elapsed_s(self.time_s)


def elapsed_s(time_s: Float[Array, " window"]) -> Float[Array, ""]:
    """Since the frame before."""
    return jnp.maximum(time_s[-1] - time_s[-2], 1e-3)


def view_of(
    camera: Camera,
    points_m: Float[Array, "height width 3"],
    distance_m: Float[Array, "height width"],
    valid: Bool[Array, "height width"],
    motion: MotionMap,
    step_m: Float[Array, "height width"],
    time_s: Float[Array, " window"],
    background: Background,
    grouping: Grouping,
) -> View:
    """Segments, their motion, and what stands in front: once a frame, for all tags."""
    features = _features(camera, points_m, valid, step_m, elapsed_s(time_s), grouping)
    segments = segment(features, valid, grouping.temperature, cell=grouping.cell)
    rho, known, rho_segment = _pooled_motion(segments, motion, grouping.pool_motion)
    means, mass = pool(
        segments, jnp.concatenate([features, distance_m[..., None]], axis=-1), valid.astype(points_m.dtype)
    )
    return View(
        points_m=points_m,
        distance_m=distance_m,
        valid=valid,
        front=in_front(background, distance_m, valid),
        time_s=time_s,
        segments=segments,
        segment_range_m=means[..., 4],
        segment_mass=mass,
        affinity=segment_affinity(segments, means[..., :3], means[..., 3], grouping.affinity_length),
        rho=rho,
        known=known,
        rho_segment=rho_segment,
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
