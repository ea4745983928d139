"""The `Trace` of one frame from soft masks."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..tracing.tracer import Trace
from .segmentation import bounding_box


def describe(
    mask: Float[Array, "tag height width"],
    centre_m: Float[Array, "tag 3"],
    step_m: Float[Array, "antenna height width"],
    recent: Bool[Array, "height width"],
) -> Trace:
    """The `Trace` of one frame from soft masks: box, centroid, and the mask-weighted change of distances.

    The published method has no confidence: it is 1 where the mask is not empty.
    """
    hard = jnp.where(mask > 0.5, mask, 0.0)
    total = jnp.sum(hard, axis=(1, 2))
    height, width = mask.shape[1:]
    divisor = jnp.maximum(total, 1e-6)
    x = jnp.sum(hard * jnp.arange(width, dtype=mask.dtype)[None, None], axis=(1, 2)) / divisor
    y = jnp.sum(hard * jnp.arange(height, dtype=mask.dtype)[None, :, None], axis=(1, 2)) / divisor
    moving = mask * recent.astype(mask.dtype)[None]
    change = jnp.einsum("thw,ahw->ta", moving, step_m) / jnp.maximum(jnp.sum(moving, axis=(1, 2)), 1e-6)[:, None]
    return Trace(
        mask=mask,
        box_px=jax.vmap(bounding_box)(hard),
        centre_px=jnp.stack([x, y], axis=-1),
        centre_m=centre_m,
        step_m=change,
        confidence=jnp.where(jnp.sum(mask, axis=(1, 2)) > 0, 1.0, 0.0),
        detected=total > 0,
    )
