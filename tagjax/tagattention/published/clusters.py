"""Few K-means clusters of position, and the mask refined by them (TagAttention, III.G, after Jaimez et al., 2017)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int


def seed_centres(
    points_m: Float[Array, "height width 3"], valid: Bool[Array, "height width"], rows: int, columns: int
) -> Float[Array, "cluster 3"]:
    """Mean position of each of rows x columns cells of the picture; the mean of all where a cell has no valid pixel."""
    height, width = valid.shape
    row = jnp.arange(height) * rows // height
    column = jnp.arange(width) * columns // width
    cell = (row[:, None] * columns + column[None]).reshape(-1)
    mean, count = _means(points_m.reshape(-1, 3), valid.reshape(-1), cell, rows * columns)
    total = jnp.maximum(jnp.sum(count), 1.0)
    overall = jnp.sum(mean * count[:, None], axis=0) / total
    return jnp.where(count[:, None] > 0, mean, overall[None])


def assign(points_m: Float[Array, "pixel 3"], centres_m: Float[Array, "cluster 3"]) -> Int[Array, " pixel"]:
    """The cluster with the nearest centre for each point; the first of equally near ones."""
    # The points' own squares are the same for all centres. A common origin keeps the rest small in float32.
    origin = jnp.mean(centres_m, axis=0)
    points, centres = points_m - origin[None], centres_m - origin[None]
    apart = jnp.sum(jnp.square(centres), axis=-1)[None] - 2.0 * points @ centres.T
    return jnp.argmin(apart, axis=-1).astype(jnp.int32)


def k_means(
    points_m: Float[Array, "pixel 3"],
    valid: Bool[Array, " pixel"],
    centres_m: Float[Array, "cluster 3"],
    *,
    num_iterations: int,
) -> Float[Array, "cluster 3"]:
    """Centres after some iterations of Lloyd's algorithm; a cluster that loses all of its points keeps its centre."""

    def iterate(centres: Float[Array, "cluster 3"], _: None) -> tuple[Float[Array, "cluster 3"], None]:
        mean, count = _means(points_m, valid, assign(points_m, centres), centres.shape[0])
        return jnp.where(count[:, None] > 0, mean, centres), None

    out, _ = jax.lax.scan(iterate, centres_m, None, length=num_iterations)
    return out


def _means(
    points_m: Float[Array, "pixel 3"], valid: Bool[Array, " pixel"], cluster: Int[Array, " pixel"], num: int
) -> tuple[Float[Array, "cluster 3"], Float[Array, " cluster"]]:
    weight = valid.astype(points_m.dtype)
    member = jax.nn.one_hot(cluster, num, dtype=points_m.dtype) * weight[:, None]
    count = jnp.sum(member, axis=0)
    return member.T @ points_m / jnp.maximum(count, 1.0)[:, None], count


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
    ones = valid.astype(jnp.float32)
    size = jnp.zeros(num_clusters).at[cluster].add(ones)
    covered = jnp.zeros(num_clusters).at[cluster].add(ones * mask.astype(ones.dtype))
    fraction = (covered / jnp.maximum(size, 1.0))[cluster]
    return valid & ((fraction >= whole) | (mask & (fraction >= part)))
