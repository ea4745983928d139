"""Polynomial resampling of a tag's distance at camera times (TagAttention, III.C)."""

from __future__ import annotations

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..core.numerics import safe_divide


def resample_polynomial(
    time_s: Float[Array, " samples"],
    value: Float[Array, " samples"],
    num_valid: Float[Array, ""],
    query_s: Float[Array, " query"],
    *,
    order: int = 3,
) -> tuple[Float[Array, " query"], Bool[Array, " query"]]:
    """Lagrange interpolation through the `order` + 1 samples around each query time.

    The first `num_valid` samples count; they are in order of time, and of those of one time the first counts. Returns values and whether the query lies within
    the samples; outside, the nearest sample is repeated.
    """
    count = num_valid.astype(jnp.int32)
    usable = jnp.arange(time_s.shape[0]) < count
    stamps = jnp.where(usable, time_s, jnp.inf)
    upper = jnp.searchsorted(stamps, query_s)
    start = jnp.clip(upper - (order + 1) // 2, 0, jnp.maximum(count - order - 1, 0))
    index = start[:, None] + jnp.arange(order + 1)[None, :]
    member = index < count
    index = jnp.minimum(index, time_s.shape[0] - 1)
    t, y = time_s[index], value[index]
    member = member.at[:, 1:].set(member[:, 1:] & (t[:, 1:] > t[:, :-1]))
    own = jnp.eye(order + 1, dtype=bool)[None]
    pair = ~own & member[:, None, :] & member[:, :, None]
    apart = t[:, :, None] - t[:, None, :]
    ratio = safe_divide(jnp.broadcast_to(query_s[:, None, None] - t[:, None, :], apart.shape), apart)
    basis = jnp.prod(jnp.where(pair, ratio, 1.0), axis=-1)
    out = jnp.sum(jnp.where(member, basis * y, 0.0), axis=-1)
    last = value[jnp.maximum(count - 1, 0)]
    before, after = query_s < time_s[0], query_s > time_s[jnp.maximum(count - 1, 0)]
    inside = ~before & ~after & (count > 0)
    return jnp.where(before, value[0], jnp.where(after, last, out)), inside
