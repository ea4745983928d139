"""Layers of a flow pair: random smooth outlines and motions that have an inverse in closed form.

Points are pixels from the centre of the picture, x right, y down. A layer's local frame is centred on the layer and
rotated; outline and texture are defined in it, as in the first picture. All motions are written as displacements, so
that static layers are displaced by exactly zero. Everything is elementwise: a parameter is a scalar (one layer, all
pixels) or an array of the points' shape (the values of each pixel's layer).
"""

from __future__ import annotations

import functools
from typing import TypeAlias

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Points: TypeAlias = tuple[Float[Array, "height width"], Float[Array, "height width"]]
"""x and y, or their displacements, in pixels."""

NUM_SIDES = 6
NUM_HARMONICS = 4
_TINY = 1e-6


class Camera(eqx.Module):
    """Motion of the whole picture: the homographies I + `ahead` and I + `back`, inverse to each other.

    Their coordinates are points divided by `half_px`; both are scaled to have a lower right element of 1.
    """

    ahead: Float[Array, "3 3"]
    back: Float[Array, "3 3"]
    half_px: float = eqx.field(static=True)


class Motion(eqx.Module):
    """A layer's own motion: two shears that bend it, then an affine map, in its local frame.

    x += amplitude sin(rate y + phase), then y likewise with the new x: for any amplitude each step has an exact inverse,
    and so has the whole motion.
    """

    centre_x: Float[Array, "*points"]
    centre_y: Float[Array, "*points"]
    cosine: Float[Array, "*points"]
    sine: Float[Array, "*points"]
    shift_x: Float[Array, "*points"]
    shift_y: Float[Array, "*points"]
    ahead: tuple[Float[Array, "*points"], ...]  # affine matrix less the identity: xx, xy, yx, yy
    back: tuple[Float[Array, "*points"], ...]  # its inverse less the identity
    bend_x: tuple[Float[Array, "*points"], ...]  # amplitude, rate, phase
    bend_y: tuple[Float[Array, "*points"], ...]


class Outline(eqx.Module):
    """The area that a layer covers in its local frame, as one of four families of shapes."""

    kind: Float[Array, "*layer"]  # 0 superellipse, 1 blob, 2 polygon, 3 limb of two bars
    exists: Float[Array, "*layer"]
    half_x: Float[Array, "*layer"]
    half_y: Float[Array, "*layer"]
    power: Float[Array, "*layer"]  # of the superellipse: 1, 2 or 3 for |x|^2, |x|^4, |x|^8
    rim: Float[Array, "*layer"]  # width of the ring of a hollow shape; 0 = filled
    thickness: Float[Array, "*layer"]  # radius of the limb's bars
    elbow: Float[Array, ...]  # (2,) cosine, sine of the angle between them
    harmonics: Float[Array, ...]  # (orders, 2) cosine and sine parts of orders 2, 3, ... of the blob's radius
    sides: Float[Array, ...]  # (sides, 3) normal x, y and distance of each side of the polygon


def make_camera(shift: Float[Array, 2], turn: Float[Array, ""], zoom: Float[Array, ""], tilt: Float[Array, 2],
                half_px: float) -> Camera:  # fmt: skip
    """A camera that shifts (px), turns (rad), zooms (relative) and tilts (perspective, per `half_px`)."""
    cosine, sine = jnp.cos(turn) * (1 + zoom) - 1, jnp.sin(turn) * (1 + zoom)
    zero = jnp.zeros(())
    e = jnp.stack([cosine, -sine, shift[0] / half_px, sine, cosine, shift[1] / half_px, tilt[0], tilt[1], zero])
    a, b, c, d, f, g, p, q = e[0] + 1, e[1], e[2], e[3], e[4] + 1, e[5], e[6], e[7]
    scale = 1 / (a * f - b * d)
    inverse = [f - g * q, c * q - b, b * g - c * f, g * p - d, a - c * p, c * d - a * g, d * q - f * p,
               b * p - a * q]  # fmt: skip
    inverse = jnp.stack([element * scale for element in inverse])
    back = jnp.concatenate([inverse - jnp.asarray([1.0, 0, 0, 0, 1, 0, 0, 0]), zero[None]])
    return Camera(e.reshape(3, 3), back.reshape(3, 3), half_px)


def camera_displacement(camera: Camera, points: Points, *, back: bool) -> Points:
    """Displacement of points by the camera's motion, or by its inverse."""
    matrix = camera.back if back else camera.ahead
    x, y = points
    u, v = x / camera.half_px, y / camera.half_px
    over = matrix[2, 0] * u + matrix[2, 1] * v
    dx = (matrix[0, 0] * u + matrix[0, 1] * v + matrix[0, 2] - over * u) / (1 + over)
    dy = (matrix[1, 0] * u + matrix[1, 1] * v + matrix[1, 2] - over * v) / (1 + over)
    return dx * camera.half_px, dy * camera.half_px


def to_local(motion: Motion, points: Points) -> Points:
    """Points of the picture in the layer's local frame."""
    x, y = points[0] - motion.centre_x, points[1] - motion.centre_y
    return motion.cosine * x + motion.sine * y, motion.cosine * y - motion.sine * x


def wave(x: Float[Array, ...]) -> Float[Array, ...]:
    """The sine to within 0.001 by two parabolas: smooth, and several times faster on a CPU than the exact sine."""
    turns = x * (1 / (2 * np.pi))
    t = 2 * (turns - jnp.floor(turns)) - 1
    bow = -4 * t * (1 - jnp.abs(t))
    return bow + 0.225 * (bow * jnp.abs(bow) - bow)


def _local_ahead(m: Motion, x: Array, y: Array) -> Points:
    """Displacement of local points by the layer's own motion."""
    bend_x = m.bend_x[0] * wave(m.bend_x[1] * y + m.bend_x[2])
    bend_y = m.bend_y[0] * wave(m.bend_y[1] * (x + bend_x) + m.bend_y[2])
    x, y = x + bend_x, y + bend_y
    dx = bend_x + (m.ahead[0] * x + m.ahead[1] * y + m.shift_x)
    dy = bend_y + (m.ahead[2] * x + m.ahead[3] * y + m.shift_y)
    return dx, dy


def _local_back(m: Motion, x: Array, y: Array) -> Points:
    """Displacement of local points by the inverse of `_local_ahead`."""
    x, y = x - m.shift_x, y - m.shift_y
    dx, dy = m.back[0] * x + m.back[1] * y, m.back[2] * x + m.back[3] * y
    x, y = x + dx, y + dy
    bend_y = m.bend_y[0] * wave(m.bend_y[1] * x + m.bend_y[2])
    bend_x = m.bend_x[0] * wave(m.bend_x[1] * (y - bend_y) + m.bend_x[2])
    return dx - m.shift_x - bend_x, dy - m.shift_y - bend_y


def displacement(camera: Camera, motion: Motion, points: Points, *, back: bool) -> Points:
    """Displacement of points of the first picture to the second, or with `back` of points of the second to the first.

    The layer moves first, then the camera moves all layers.
    """
    x, y = points
    cx, cy = camera_displacement(camera, points, back=True) if back else (jnp.zeros_like(x), jnp.zeros_like(y))
    local = to_local(motion, (x + cx, y + cy))
    dx, dy = _local_back(motion, *local) if back else _local_ahead(motion, *local)
    dx, dy = motion.cosine * dx - motion.sine * dy, motion.sine * dx + motion.cosine * dy
    if not back:
        cx, cy = camera_displacement(camera, (x + dx, y + dy), back=False)
    return dx + cx, dy + cy


def outline_value(outline: Outline, local: Points) -> Float[Array, "height width"]:
    """Negative inside the outline, positive outside, near its edge roughly in pixels."""
    x, y = local
    size = jnp.minimum(outline.half_x, outline.half_y)
    u, v = x / outline.half_x, y / outline.half_y
    second = u * u + v * v
    fourth = jnp.where(outline.power > 2.5, jnp.sqrt(u**8 + v**8), u**4 + v**4)
    root = jnp.sqrt(jnp.where(outline.power > 1.5, fourth, second))
    value = jnp.where(outline.power > 1.5, jnp.sqrt(root), root) - 1
    radius = jnp.sqrt(second)
    cosine, sine = u / jnp.maximum(radius, _TINY), v / jnp.maximum(radius, _TINY)
    c, s, reach = cosine, sine, 1.0
    for order in range(NUM_HARMONICS):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        reach = reach + outline.harmonics[order, 0] * c + outline.harmonics[order, 1] * s
    value = jnp.where(outline.kind == 1, radius - reach, value)
    polygon = functools.reduce(jnp.maximum, [side[0] * u + side[1] * v - side[2] for side in outline.sides])
    value = size * jnp.where(outline.kind == 2, polygon, value)
    length = outline.half_x
    turned = (outline.elbow[0] * x + outline.elbow[1] * y, outline.elbow[0] * y - outline.elbow[1] * x)
    upper = jnp.square(x - jnp.clip(x, -length, 0.0)) + jnp.square(y)
    lower = jnp.square(turned[0] - jnp.clip(turned[0], 0.0, length)) + jnp.square(turned[1])
    value = jnp.where(outline.kind == 3, jnp.sqrt(jnp.minimum(upper, lower)) - outline.thickness, value)
    value = jnp.where(outline.rim > 0, jnp.abs(value) - outline.rim, value)
    return jnp.where(outline.exists > 0, value, 1e3)
