"""Motion maps (TagAttention, Eq. 3): every pixel's distance over the last k frames, carried along by optical flow.

Beside the distances, which a tag's phases tell of, the places in 3D, which they do not, and which the camera sees as well.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ..image.warp import gather, gather_taps, splat


class MotionMap(eqx.Module):
    """Distances to the antenna over a window of frames, oldest first; the last is the current frame's."""

    distance_m: Float[Array, "*antenna height width window"]
    valid: Bool[Array, "*antenna height width window"]


class PlaceMap(eqx.Module):
    """Places in the camera frame over a window of frames, oldest first; the last is the current frame's."""

    place_m: Float[Array, "height width window 3"]
    valid: Bool[Array, "height width window"]

    def shift_m(self) -> tuple[Float[Array, "height width 3"], Bool[Array, "height width"]]:
        """How far each pixel's surface has come over the window, and where that is known (0 elsewhere)."""
        known = jnp.all(self.valid, axis=-1)
        return jnp.where(known[..., None], self.place_m[..., -1, :] - self.place_m[..., 0, :], 0.0), known


def empty_places(height: int, width: int, num_window: int) -> PlaceMap:
    """A map that knows no place yet."""
    return PlaceMap(jnp.zeros((height, width, num_window, 3)), jnp.zeros((height, width, num_window), dtype=bool))


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


def push_gather(
    motion: MotionMap,
    backward_px: Float[Array, "height width 2"],
    distance_m: Float[Array, "height width"],
    max_step_m: Float[Array, ""],
) -> MotionMap:
    """Slide the window by one frame, each pixel fetching its past from where it was.

    Of the four pixels around that place only those whose last distance lies within `max_step_m` of the pixel's own
    take part: a larger jump is another surface (an occlusion, or flow that crosses an edge), not a motion. Where none
    is left the pixel's past is unknown. This keeps front and back of a depth edge apart, which bilinear mixing blurs.
    """
    past, valid = motion.distance_m[..., 1:], motion.valid[..., 1:]
    past_m, carried = _fetch(past[..., None], valid, backward_px, distance_m, max_step_m)
    return _append(past_m[..., 0], carried, distance_m)


def push_places(
    places: PlaceMap,
    backward_px: Float[Array, "height width 2"],
    points_m: Float[Array, "height width 3"],
    max_step_m: Float[Array, ""],
) -> PlaceMap:
    """Slide the window of places by one frame as `push_gather` does; depth tells surfaces apart, and 0 is missing."""
    past, valid = places.place_m[..., 1:, :], places.valid[..., 1:]
    past_m, carried = _fetch(past, valid, backward_px, points_m[..., 2], max_step_m)
    return PlaceMap(
        jnp.concatenate([past_m, points_m[..., None, :]], axis=-2),
        jnp.concatenate([carried, (points_m[..., 2] > 0)[..., None]], axis=-1),
    )


def _fetch(
    past_m: Float[Array, "height width past part"],
    valid: Bool[Array, "height width past"],
    backward_px: Float[Array, "height width 2"],
    now_m: Float[Array, "height width"],
    max_step_m: Float[Array, ""],
) -> tuple[Float[Array, "height width past part"], Bool[Array, "height width past"]]:
    """What is known of each pixel's past, of those around its last place whose last part is within a step of `now_m`."""
    height, width, num_past, num_parts = past_m.shape
    flat = past_m.reshape(height, width, num_past * num_parts)
    taps = []
    for tap, weight in gather_taps(jnp.concatenate([flat, valid.astype(flat.dtype)], axis=-1), backward_px):
        values, known = tap[..., :-num_past].reshape(past_m.shape), tap[..., -num_past:]
        same_surface = (jnp.abs(values[..., -1, -1] - now_m) <= max_step_m) & (known[..., -1] > 0) & (now_m > 0)
        taps.append((values, jnp.where(same_surface, weight, 0.0)[..., None] * known))
    total = functools.reduce(jnp.add, [weight for _, weight in taps])
    mixed = functools.reduce(jnp.add, [values * weight[..., None] for values, weight in taps])
    carried = total > 1e-3
    return jnp.where(carried[..., None], mixed / jnp.where(carried, total, 1.0)[..., None], 0.0), carried


def carry(
    image: Float[Array, "height width channel"], backward_px: Float[Array, "height width 2"], fill: Float[Array, ""]
) -> Float[Array, "height width channel"]:
    """A map of the last frame moved to this one by gathering; `fill` where it comes from outside the picture."""
    moved, covered = gather(image, backward_px)
    return jnp.where(covered[..., None], moved, fill)
