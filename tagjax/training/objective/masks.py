"""Terms of the masks alone: coverage of the pixels that move like the tag, and weak priors."""

from __future__ import annotations

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.numerics import safe_divide
from ...image.warp import gather
from ...tracing.tracer import Camera, Frame
from .inputs import ObjectiveInputs, ObjectiveSettings


def coverage(
    inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """1 - Dice of the mask, estimated from past frames, with the pixels whose motion in the next window is the tag's.

    It keeps the mask from shrinking to a few certain pixels. No gradient flows into the pixels' future motion.
    """
    del key
    agrees, valid, weight = future_agreement(inputs.camera, inputs.frames, settings)
    stride, num_compared = settings.future_stride, agrees.shape[0]
    mask = jnp.where(valid[:, None], inputs.trace.mask[:num_compared, :, ::stride, ::stride], 0.0)
    overlap = jnp.sum(mask * agrees, axis=(-2, -1))
    size = jnp.sum(mask * mask, axis=(-2, -1)) + jnp.sum(agrees * agrees, axis=(-2, -1))
    dice = 2.0 * overlap / (size + 1.0)  # the added pixel keeps the gradient of a vanishing mask finite
    started = jnp.arange(num_compared) >= min(settings.skip_frames, num_compared - 1)
    weight = jnp.where(started[:, None], weight, 0.0)
    loss = safe_divide(jnp.sum((1.0 - dice) * weight), jnp.sum(weight))
    return loss, {"mask_fraction": jnp.mean(inputs.trace.mask)}


def future_agreement(
    camera: Camera, frames: Frame, settings: ObjectiveSettings
) -> tuple[
    Float[Array, "compared tag rows columns"], Bool[Array, "compared rows columns"], Float[Array, "compared tag"]
]:
    """Agreement of each pixel's motion over the next k - 1 frames with the tag's, in excess of a stationary pixel's.

    Pixels are followed along the forward flow to the nearest pixel; those that leave the picture or jump in depth are not
    valid. The tag's motion is that of the radio window that ends k - 1 frames later. The weight is 0 for a stationary tag
    and close to 1 for one with clear motion.
    """
    num_window = frames.radio.relative_m.shape[-1]
    num_frames, height, width = frames.depth_m.shape
    if num_frames < num_window:
        raise ValueError(
            f"found a clip of {num_frames} frames; expected at least {num_window}, the length of a window."
        )
    stride, num_compared = settings.future_stride, num_frames - (num_window - 1)
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
    followed, valid = jax.vmap(over_time, in_axes=(0, None), out_axes=1)(ranges, jnp.arange(num_compared))
    valid = jnp.all(valid, axis=1)
    centred = followed - jnp.mean(followed, axis=-1, keepdims=True)
    radio = jax.tree.map(lambda leaf: leaf[num_window - 1 :], frames.radio)
    known = jnp.all(jnp.isfinite(radio.std_m), axis=-1)
    tag = jnp.where(known[..., None], radio.relative_m, 0.0)
    tag = tag - jnp.mean(tag, axis=-1, keepdims=True)
    variance = settings.future_alpha_m2 + jnp.where(known, jnp.mean(jnp.square(radio.std_m), axis=-1), 0.0)
    misfit = jnp.mean(jnp.square(centred[:, None] - tag[:, :, :, None, None]), axis=-1)
    # An antenna without reads of the tag has precision 0; the errors of different antennas are independent.
    precision = jnp.where(known, 1.0 / (2.0 * variance), 0.0)
    agrees = jnp.exp(-jnp.sum(misfit * precision[..., None, None], axis=2))
    stationary = jnp.exp(-jnp.sum(jnp.mean(jnp.square(tag), axis=-1) * precision, axis=-1))
    weight = jnp.where(jnp.any(known, axis=-1), 1.0 - stationary, 0.0)
    excess = safe_divide(
        jax.nn.relu(agrees - stationary[..., None, None]), jnp.broadcast_to(weight[..., None, None], agrees.shape)
    )
    return jax.lax.stop_gradient((jnp.where(valid[:, None], excess, 0.0), valid, weight))


def area(inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean fraction of the picture covered by the soft masks: among masks that explain the reads equally well, prefer small ones."""
    del key
    mask = _started(inputs.trace.mask, settings)
    return jnp.mean(mask), {}


def compactness(
    inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean square distance of the mask's points from their centre, m^2; 0 for an empty mask."""
    del key
    depth = _started(inputs.frames.depth_m, settings)
    points = inputs.camera.rays[None] * depth[..., None]
    mask = jnp.where((depth > 0)[:, None], _started(inputs.trace.mask, settings), 0.0)
    mass = jnp.sum(mask, axis=(-2, -1))
    centre = safe_divide(
        jnp.einsum("tkhw,thwc->tkc", mask, points), jnp.broadcast_to(mass[..., None], (*mass.shape, 3))
    )
    square_distance = jnp.sum(jnp.square(points[:, None] - centre[:, :, None, None]), axis=-1)
    return jnp.mean(safe_divide(jnp.sum(mask * square_distance, axis=(-2, -1)), mass)), {}


def steadiness(
    inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """1 - Dice of each mask with the previous frame's mask, warped by the flow: an object does not appear and disappear.

    Pixels whose previous position is outside the picture are left out.
    """
    del key
    mask, backward = _started(inputs.trace.mask, settings), _started(inputs.frames.backward_px, settings)
    if mask.shape[0] < 2:
        return jnp.zeros(()), {}
    warp = lambda before, flow: gather(jnp.moveaxis(before, 0, -1), flow)  # noqa: E731
    warped, known = jax.vmap(warp)(mask[:-1], backward[1:])
    before, now = jnp.moveaxis(warped, -1, 1), jnp.where(known[:, None], mask[1:], 0.0)
    overlap = jnp.sum(before * now, axis=(-2, -1))
    size = jnp.sum(jnp.square(before), axis=(-2, -1)) + jnp.sum(jnp.square(now), axis=(-2, -1))
    return jnp.mean(1.0 - (2.0 * overlap + 1.0) / (size + 1.0)), {}  # two empty masks agree


def _started(each: Float[Array, " time *shape"], settings: ObjectiveSettings) -> Float[Array, " started *shape"]:
    """Values of the frames after the first `skip_frames`, in which the tracer has too little evidence; at least one frame."""
    return each[min(settings.skip_frames, each.shape[0] - 1) :]
