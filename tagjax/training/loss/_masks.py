"""Terms of the masks by themselves: coverage of what moves like the tag, and weak priors."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_divide
from ...image.warp import gather
from ...tracing.tracer import Camera, Frame
from ._seen import ObjectiveSettings, Seen


def coverage(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """1 - Dice of the mask, made from the past, with the pixels whose motion in the coming window is the tag's.

    Keeps the mask from shrinking to a few sure pixels. Nothing flows back into the pixels' future.
    """
    del key
    agrees, valid, weight = future_agreement(seen.camera, seen.frames, settings)
    stride, num_asked = settings.future_stride, agrees.shape[0]
    mask = jnp.where(valid[:, None], seen.said.mask[:num_asked, :, ::stride, ::stride], 0.0)
    overlap = jnp.sum(mask * agrees, axis=(-2, -1))
    size = jnp.sum(mask * mask, axis=(-2, -1)) + jnp.sum(agrees * agrees, axis=(-2, -1))
    dice = 2.0 * overlap / (size + 1.0)  # one pixel more keeps the gradient of a vanishing mask finite
    started = jnp.arange(num_asked) >= min(settings.skip_frames, num_asked - 1)
    weight = jnp.where(started[:, None], weight, 0.0)
    loss = safe_divide(jnp.sum((1.0 - dice) * weight), jnp.sum(weight))
    return loss, {"mask_share": jnp.mean(seen.said.mask)}


def future_agreement(
    camera: Camera, frames: Frame, settings: ObjectiveSettings
) -> tuple[Float[Array, "asked tag rows columns"], Bool[Array, "asked rows columns"], Float[Array, "asked tag"]]:
    """How well each pixel's motion over the next k - 1 frames agrees with the tag's, beyond what a resting pixel does.

    Pixels are followed along the forward flow to the nearest pixel; those lost on the way, or that jump, are not
    valid. The radio's window that ends k - 1 frames later tells the tag's motion. The weight says how far from rest
    the tag was.
    """
    num_window = frames.radio.relative_m.shape[-1]
    num_frames, height, width = frames.depth_m.shape
    num_asked = max(num_frames - (num_window - 1), 1)
    if num_frames < num_window:
        raise ValueError(f"A clip of {num_frames} frames is too short for the window of {num_window}; lengthen it.")
    stride = settings.future_stride
    ranges = camera.ranges_m(camera.rays[None] * frames.depth_m[..., None])
    ranges = jnp.where(frames.depth_m[None] > 0, ranges, 0.0)
    rows, columns = jnp.meshgrid(jnp.arange(0, height, stride), jnp.arange(0, width, stride), indexing="ij")

    def follow(distance: Float[Array, "time height width"], start: Int[Array, ""]) -> tuple[Array, Array]:
        x, y = columns.astype(distance.dtype), rows.astype(distance.dtype)
        at = distance[start][rows, columns]
        valid, values = at > 0, [at]
        for ahead in range(1, num_window):
            column, row = jnp.round(x).astype(jnp.int32), jnp.round(y).astype(jnp.int32)
            flow = frames.forward_px[start + ahead][jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
            x, y = x + flow[..., 0], y + flow[..., 1]
            column, row = jnp.round(x).astype(jnp.int32), jnp.round(y).astype(jnp.int32)
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            at = distance[start + ahead][jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
            valid = valid & inside & (at > 0) & (jnp.abs(at - values[-1]) < 0.5)
            values.append(at)
        return jnp.stack(values, axis=-1), valid

    over_time = jax.vmap(follow, in_axes=(None, 0))
    followed, valid = jax.vmap(over_time, in_axes=(0, None), out_axes=1)(ranges, jnp.arange(num_asked))
    valid = jnp.all(valid, axis=1)
    centred = followed - jnp.mean(followed, axis=-1, keepdims=True)
    radio = jax.tree.map(lambda leaf: leaf[num_window - 1 :], frames.radio)
    known = jnp.all(jnp.isfinite(radio.std_m), axis=-1)
    tag = jnp.where(known[..., None], radio.relative_m, 0.0)
    tag = tag - jnp.mean(tag, axis=-1, keepdims=True)
    spread = settings.future_alpha_m2 + jnp.where(known, jnp.mean(jnp.square(radio.std_m), axis=-1), 0.0)
    misfit = jnp.mean(jnp.square(centred[:, None] - tag[:, :, :, None, None]), axis=-1)
    # An antenna that has not heard the tag says nothing; the others' errors are independent.
    told = jnp.where(known, 1.0 / (2.0 * spread), 0.0)
    agrees = jnp.exp(-jnp.sum(misfit * told[..., None, None], axis=2))
    resting = jnp.exp(-jnp.sum(jnp.mean(jnp.square(tag), axis=-1) * told, axis=-1))
    weight = jnp.where(jnp.any(known, axis=-1), 1.0 - resting, 0.0)
    beyond = safe_divide(
        jax.nn.relu(agrees - resting[..., None, None]), jnp.broadcast_to(weight[..., None, None], agrees.shape)
    )
    return jax.lax.stop_gradient((jnp.where(valid[:, None], beyond, 0.0), valid, weight))


def area(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean share of the picture that the soft masks cover: of masks that explain the reads alike the smaller one."""
    del key
    mask = _started(seen.said.mask, settings)
    return jnp.mean(mask), {}


def compactness(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean square distance of the mask's points from their centre, m^2; masks of nothing have none."""
    del key
    depth = _started(seen.frames.depth_m, settings)
    points = seen.camera.rays[None] * depth[..., None]
    mask = jnp.where((depth > 0)[:, None], _started(seen.said.mask, settings), 0.0)
    mass = jnp.sum(mask, axis=(-2, -1))
    centre = safe_divide(
        jnp.einsum("tkhw,thwc->tkc", mask, points), jnp.broadcast_to(mass[..., None], (*mass.shape, 3))
    )
    away = jnp.sum(jnp.square(points[:, None] - centre[:, :, None, None]), axis=-1)
    return jnp.mean(safe_divide(jnp.sum(mask * away, axis=(-2, -1)), mass)), {}


def steadiness(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """1 - Dice of each mask with that of the frame before, carried along the flow: an object does not come and go.

    Pixels whose past lies outside the picture are left out.
    """
    del key
    mask, backward = _started(seen.said.mask, settings), _started(seen.frames.backward_px, settings)
    if mask.shape[0] < 2:
        return jnp.zeros(()), {}
    carry = lambda before, flow: gather(jnp.moveaxis(before, 0, -1), flow)  # noqa: E731
    carried, known = jax.vmap(carry)(mask[:-1], backward[1:])
    before, now = jnp.moveaxis(carried, -1, 1), jnp.where(known[:, None], mask[1:], 0.0)
    overlap = jnp.sum(before * now, axis=(-2, -1))
    size = jnp.sum(jnp.square(before), axis=(-2, -1)) + jnp.sum(jnp.square(now), axis=(-2, -1))
    return jnp.mean(1.0 - (2.0 * overlap + 1.0) / (size + 1.0)), {}  # two masks of nothing agree


def _started(each: Float[Array, " time *shape"], settings: ObjectiveSettings) -> Float[Array, " started *shape"]:
    """What is said of the frames after the first ones, in which the tracer has not seen enough; of one at the least."""
    return each[min(settings.skip_frames, each.shape[0] - 1) :]
