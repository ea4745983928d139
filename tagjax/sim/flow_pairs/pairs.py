"""Pairs of pictures with exact optical flow, drawn on the device: textured layers that move over a background.

For pre-training a flow network (after FlyingChairs, Dosovitskiy et al., ICCV 2015, and AutoFlow, Sun et al., CVPR
2021), adapted to static indoor cameras: large static areas, many small motions, limbs, walls with little texture.
"""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt8

from ...image.warp import pixel_grid
from . import appearance as look
from . import layers as geometry
from .random_scenes import FlowPairSettings, Scene, draw_scene

__all__ = ["FlowPair", "FlowPairSettings", "flow_pair", "flow_pairs"]


class FlowPair(eqx.Module):
    """Two pictures and the exact motion between them, both ways. Leading axes where several are stacked.

    A pixel is occluded if its target in the other picture is hidden by a nearer layer or lies outside.
    """

    first: Float[Array, "*batch height width 3"]  # 0 to 1
    second: Float[Array, "*batch height width 3"]
    forward_px: Float[Array, "*batch height width 2"]  # on the first picture's pixels
    backward_px: Float[Array, "*batch height width 2"]  # on the second's
    occluded_first: Bool[Array, "*batch height width"]
    occluded_second: Bool[Array, "*batch height width"]


def _nearest(holds: Bool[Array, "layers height width"]) -> Int[Array, "height width"]:
    """Number of the nearest layer where `holds` is true, from 1; 0 for the background."""
    numbers = jnp.arange(1, holds.shape[0] + 1, dtype=jnp.int32).reshape(-1, 1, 1)
    return jnp.max(jnp.where(holds, numbers, 0), axis=0)


def _rows(leaves, number: Int[Array, "height width"]):
    """The parameters of each pixel's layer: leaves (layers, ...) become planes (..., height, width).

    A product with one-hot columns: several times faster than a gather on CPUs, and exact in full precision.
    """
    flat, structure = jax.tree.flatten(leaves)
    table = jnp.concatenate([leaf.reshape(len(leaf), -1) for leaf in flat], axis=1)
    one_hot = (jnp.arange(len(table)).reshape(-1, 1, 1) == number[None]).astype(jnp.float32)
    planes = jnp.einsum("lk,lyx->kyx", table, one_hot, precision=jax.lax.Precision.HIGHEST)
    cuts = np.cumsum([leaf[0].size for leaf in flat])[:-1].tolist()
    parts = jnp.split(planes, cuts)
    return structure.unflatten([p.reshape(*leaf.shape[1:], *number.shape) for p, leaf in zip(parts, flat, strict=True)])


def _foreground(scene: Scene) -> tuple[Int[Array, " layers"], geometry.Outline, geometry.Motion]:
    """Numbers, outlines and motions of all layers but the background."""
    numbers = jnp.arange(1, len(scene.motion.sine), dtype=jnp.int32)
    return numbers, scene.outline, jax.tree.map(lambda leaf: leaf[1:], scene.motion)


def _came_from(scene: Scene, motion: geometry.Motion, points: geometry.Points) -> geometry.Points:
    """The points of the first picture that a layer moves to `points` of the second."""
    dx, dy = geometry.displacement(scene.camera, motion, points, back=True)
    return points[0] + dx, points[1] + dy


def _outlines(scene: Scene, points: geometry.Points) -> tuple[Float[Array, "layers height width"], ...]:
    """Every foreground layer's outline value on the pixels of the first and of the second picture."""

    def one(layer):
        _, outline, motion = layer
        places = (points, _came_from(scene, motion, points))
        return tuple(geometry.outline_value(outline, geometry.to_local(motion, place)) for place in places)

    # A loop over layers, here and below: XLA would fuse an unrolled one into each of its uses and compile longer.
    return jax.lax.map(one, _foreground(scene))


def _occluded(
    scene: Scene, labels: tuple[Int[Array, "height width"], ...], targets: tuple[geometry.Points, ...]
) -> tuple[Bool[Array, "height width"], ...]:
    """Whether a nearer layer covers a pixel's target, or the target lies outside the other picture."""
    height, width = labels[0].shape
    outside = tuple((jnp.abs(x) > width / 2) | (jnp.abs(y) > height / 2) for x, y in targets)

    def add(hidden, layer):
        number, outline, motion = layer
        places = (_came_from(scene, motion, targets[0]), targets[1])
        covers = [geometry.outline_value(outline, geometry.to_local(motion, place)) <= 0 for place in places]
        return tuple(h | (c & (number > la)) for h, c, la in zip(hidden, covers, labels, strict=True)), None

    return jax.lax.scan(add, outside, _foreground(scene))[0]


def _pictures(
    scene: Scene,
    values: tuple[Float[Array, "layers height width"], ...],
    points: geometry.Points,
    atlas: Array,
    photographs: Array | None,
) -> Float[Array, "2 height width 3"]:
    """Colours of both pictures. At an edge, two layers are blended by their fractions of the pixel."""
    numbers = jnp.arange(1, len(values[0]) + 1, dtype=jnp.int32).reshape(-1, 1, 1)
    tops, unders, fractions = [], [], []
    for value in values:
        slope_y, slope_x = jnp.gradient(value, axis=(1, 2))
        slope = jnp.maximum(jnp.sqrt(slope_x**2 + slope_y**2), 0.1)
        fraction = jnp.clip(0.5 - value / slope, 0.0, 1.0)
        tops.append(_nearest(fraction > 0))
        # Where three layers meet in a pixel, the third one's fraction goes to the second.
        unders.append(_nearest((fraction > 0) & (numbers < tops[-1][None])))
        fractions.append(jnp.sum(jnp.where(numbers == tops[-1][None], fraction, 0.0), axis=0)[..., None])

    def colour(job):
        moved, number = job
        motion = _rows(scene.motion, number)
        x, y = _came_from(scene, motion, points)
        at = (jnp.where(moved, x, points[0]), jnp.where(moved, y, points[1]))
        return look.paint(_rows(scene.surface, number), geometry.to_local(motion, at), atlas, photographs)

    colours = jax.lax.map(colour, (jnp.asarray([False, True, False, True]), jnp.stack(tops + unders)))
    alpha = jnp.stack(fractions)
    return alpha * colours[:2] + (1 - alpha) * colours[2:]


def _develop(
    first: Array, second: Array, points: geometry.Points, settings: FlowPairSettings, key: PRNGKeyArray
) -> tuple[Array, Array]:
    """Light, lens and sensor: the light may change between the pictures; blur and noise are those of one camera."""
    draw_key, *noise_keys = jax.random.split(key, 3)
    u = jax.random.uniform(draw_key, (16,))
    varies = (u[0] < settings.lighting_change_probability).astype(jnp.float32)
    signed = varies * (2 * u - 1)
    gain = 1 + settings.gain * (0.8 * signed[1] + 0.2 * signed[2:5])
    second = look.relight(second, gain, settings.offset * signed[5], 1 + settings.gamma * signed[6])
    angle, width = 2 * np.pi * u[7], 4 + 36 * u[8]
    normal_x, normal_y = jnp.cos(angle), jnp.sin(angle)
    place, depth = 0.5 * settings.height * (2 * u[9] - 1), settings.shadow * varies * u[10] ** 2
    shift = 0.1 * settings.width * signed[11] ** 3
    images = []
    for image, along, noise_key in zip((first, second), (place, place + shift), noise_keys, strict=True):
        edge = jnp.stack([normal_x, normal_y, along, width, depth])
        image = look.lens_blur(image * look.soft_shadow(points, edge), settings.blur_px * u[12])
        images.append(look.sensor_noise(image, settings.noise * u[13] ** 2, key=noise_key))
    return images[0], images[1]


def flow_pair(
    settings: FlowPairSettings,
    photographs: Float[Array, "count rows columns 3"] | UInt8[Array, "count rows columns 3"] | None = None,
    *,
    key: PRNGKeyArray,
) -> FlowPair:
    """One random pair with exact flow and occlusion, both ways; the same for the same key. `vmap` over keys.

    `photographs` (0 to 1, or uint8) are drawn on a fraction of the layers, at about their own resolution. Flow is the
    layers' motion in closed form in both directions: exact up to float32 (about 1e-4 px).
    """
    scene_key, atlas_key, camera_key = jax.random.split(key, 3)
    scene, atlas = draw_scene(settings, key=scene_key), look.make_atlas(key=atlas_key)
    x, y = pixel_grid(settings.height, settings.width)
    points = (x - (settings.width - 1) / 2, y - (settings.height - 1) / 2)
    values = _outlines(scene, points)
    labels = tuple(_nearest(value <= 0) for value in values)
    moves = [
        geometry.displacement(scene.camera, _rows(scene.motion, label), points, back=back)
        for label, back in zip(labels, (False, True), strict=True)
    ]
    targets = tuple((points[0] + dx, points[1] + dy) for dx, dy in moves)
    occluded = _occluded(scene, labels, targets)
    pictures = _pictures(scene, values, points, atlas, photographs)
    first, second = _develop(pictures[0], pictures[1], points, settings, camera_key)
    forward, backward = (jnp.stack(move, axis=-1) for move in moves)
    return FlowPair(first, second, forward, backward, occluded[0], occluded[1])


@functools.partial(jax.jit, static_argnames=("settings", "batch"))
def flow_pairs(
    settings: FlowPairSettings,
    batch: int,
    photographs: Float[Array, "count rows columns 3"] | UInt8[Array, "count rows columns 3"] | None = None,
    *,
    key: PRNGKeyArray,
) -> FlowPair:
    """`batch` pairs, stacked: `flow_pair` for each of the keys split from `key`, compiled."""
    return jax.vmap(lambda one: flow_pair(settings, photographs, key=one))(jax.random.split(key, batch))
