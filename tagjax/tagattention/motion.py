"""Motion maps (TagAttention, Eq. 3): every pixel's distance over the last k frames, carried along by optical flow."""

from __future__ import annotations

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..image.warp import splat


class MotionMap(eqx.Module):
    """Distances to the antenna over a window of frames, oldest first; the last is the current frame's."""

    distance_m: Float[Array, "height width window"]
    valid: Bool[Array, "height width window"]


def empty_motion(height: int, width: int, num_window: int) -> MotionMap:
    """A motion map that knows nothing yet."""
    return MotionMap(jnp.zeros((height, width, num_window)), jnp.zeros((height, width, num_window), dtype=bool))


def _append(
    past_m: Float[Array, "height width past"],
    past_valid: Bool[Array, "height width past"],
    distance_m: Float[Array, "height width"],
) -> MotionMap:
    return MotionMap(
        jnp.concatenate([past_m, distance_m[..., None]], axis=-1),
        jnp.concatenate([past_valid, (distance_m > 0)[..., None]], axis=-1),
    )


def push_splat(
    motion: MotionMap, forward_px: Float[Array, "height width 2"], distance_m: Float[Array, "height width"]
) -> MotionMap:
    """Slide the window by one frame, carrying the past forward along the flow (Eq. 3 as the paper has it).

    One splat of k - 1 channels does what Eq. 3 writes as k nested warps. Each channel carries its own validity:
    missing distances neither spread nor dilute their neighbours.
    """
    past, valid = motion.distance_m[..., 1:], motion.valid[..., 1:]
    known = valid.astype(past.dtype)
    num_past = past.shape[-1]
    moved, filled = splat(jnp.concatenate([past * known, known], axis=-1), forward_px)
    share = moved[..., num_past:]
    carried = filled[..., None] & (share >= 0.5)
    return _append(jnp.where(carried, moved[..., :num_past] / jnp.maximum(share, 0.5), 0.0), carried, distance_m)
