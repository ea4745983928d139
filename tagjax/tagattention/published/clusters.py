"""K-means clusters of position, and the mask refined by them (TagAttention, III.G, after Jaimez et al., 2017)."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def seed_grid(num_clusters: int) -> tuple[int, int]:
    """Rows and columns, as equal as they can be, of a grid with so many cells."""
    rows = max(side for side in range(1, math.isqrt(num_clusters) + 1) if num_clusters % side == 0)
    return rows, num_clusters // rows


def seed_centres(
    points_m: Float[Array, "height width 3"], valid: Bool[Array, "height width"], num_clusters: int
) -> Float[Array, "cluster 3"]:
    """Mean position of each cell of a grid over the picture; the mean of all where a cell has no valid pixel."""
    height, width = valid.shape
    rows, columns = seed_grid(num_clusters)
    row = jnp.arange(height) * rows // height
    column = jnp.arange(width) * columns // width
    cell = (row[:, None] * columns + column[None]).reshape(-1)
    mean, count = means(points_m.reshape(-1, 3), valid.reshape(-1), cell, num_clusters)
    total = jnp.maximum(jnp.sum(count), 1.0)
    overall = jnp.sum(mean * count[:, None], axis=0) / total
    return jnp.where(count[:, None] > 0, mean, overall[None])


def assign(points_m: Float[Array, "pixel 3"], centres_m: Float[Array, "cluster 3"]) -> Int[Array, " pixel"]:
    """The cluster with the nearest centre for each point; the first of equally near ones."""
    # One centre at a time: an argmin over a matrix of all distances takes ten times as long on a CPU.
    points_m, centres_m = jax.lax.stop_gradient((points_m, centres_m))
    x, y, z = points_m.T

    def compare(carry, at):
        nearest, cluster = carry
        number, centre = at
        apart = jnp.square(x - centre[0]) + jnp.square(y - centre[1]) + jnp.square(z - centre[2])
        return (jnp.minimum(apart, nearest), jnp.where(apart < nearest, number, cluster)), None

    numbers = jnp.arange(centres_m.shape[0], dtype=jnp.int32)
    start = jnp.full(points_m.shape[0], jnp.inf, points_m.dtype), jnp.zeros(points_m.shape[0], jnp.int32)
    return jax.lax.scan(compare, start, (numbers, centres_m))[0][1]


def k_means(
    points_m: Float[Array, "pixel 3"],
    valid: Bool[Array, " pixel"],
    centres_m: Float[Array, "cluster 3"],
    *,
    num_iterations: int,
) -> Float[Array, "cluster 3"]:
    """Centres after some iterations of Lloyd's algorithm; a cluster that loses all of its points keeps its centre."""

    def iterate(centres: Float[Array, "cluster 3"], _: None) -> tuple[Float[Array, "cluster 3"], None]:
        mean, count = means(points_m, valid, assign(points_m, centres), centres.shape[0])
        return jnp.where(count[:, None] > 0, mean, centres), None

    out, _ = jax.lax.scan(iterate, centres_m, None, length=num_iterations)
    return out


def means(
    values: Float[Array, "pixel channel"],
    valid: Bool[Array, " pixel"],
    cluster: Int[Array, " pixel"],
    num_clusters: int,
) -> tuple[Float[Array, "cluster channel"], Float[Array, " cluster"]]:
    """Each cluster's mean over its valid pixels, 0 where it has none; and their number."""
    weight = valid.astype(values.dtype)
    count = jax.ops.segment_sum(weight, cluster, num_clusters)
    total = jax.ops.segment_sum(values * weight[:, None], cluster, num_clusters)
    return total / jnp.maximum(count, 1.0)[:, None], count


def refined(
    mask: Bool[Array, " pixel"],
    cluster: Int[Array, " pixel"],
    valid: Bool[Array, " pixel"],
    num_clusters: int,
    *,
    whole: Float[Array, ""],
    part: Float[Array, ""],
) -> Bool[Array, " pixel"]:
    """A mask refined by clusters: all of a cluster of which it covers the fraction `whole`, its own pixels from `part` on."""
    covered, _ = means(mask.astype(jnp.float32)[:, None], valid, cluster, num_clusters)
    fraction = covered[cluster, 0]
    return valid & ((fraction >= whole) | (mask & (fraction >= part)))
