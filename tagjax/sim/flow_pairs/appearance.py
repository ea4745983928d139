"""Appearance of the layers of a flow pair: procedural textures or photographs, light, lens and sensor."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, PRNGKeyArray, UInt8, UInt32

from .layers import wave

ATLAS_SIZE = 256
NUM_FIELDS = 4
_GRIDS = (4, 8, 16, 32, 64, 128)
# Amplitude of each octave: about 1/f (walls, cloth, skin), nearly white (gravel, print), and coarse cells.
_OCTAVES = np.array(
    [[1.0, 0.8, 0.6, 0.45, 0.35, 0.3], [0.1, 0.2, 0.4, 0.7, 1.0, 1.0], [0.2, 0.5, 1.0, 0.9, 0.3, 0.0]],
    np.float32,
)


class Surface(eqx.Module):
    """Colours of layers as functions of their local frames in pixels. Colours are 0 to 1.

    Leaves are (layers, ...) in a scene, and planes (..., height, width) where each pixel has its own layer's values.
    """

    base: Float[Array, ...]  # 3 colours
    contrast: Float[Array, ...]  # 3 colours that the pattern adds
    tints: Float[Array, ...]  # 4 x 3 colours that each field of the atlas adds
    shade: Float[Array, ...]  # relative brightening per pixel, x and y
    texel: Float[Array, ...]  # cosine and sine times texels a pixel, offset x and y
    pattern: Float[Array, ...]  # kind (0 none, 1 stripes, 2 checker, 3 lines), rate rad/px, wobble px, phase
    photo: Float[Array, ...]  # 1 = a photograph instead, its number, its pixels a pixel, offset x and y


def white_noise(shape: tuple[int, ...], *, key: PRNGKeyArray) -> UInt32[Array, ...]:
    """Random words by hashing their numbers (Wellons' lowbias32, twice, seeded by the key).

    `jax.random` takes about 40 ns per word on a CPU core, a third of the time of a pair; picture noise needs less quality.
    """
    seeds = jax.random.bits(key, (2,), jnp.uint32)
    words = jax.lax.iota(jnp.uint32, int(np.prod(shape))) * jnp.uint32(0x9E3779B9) + seeds[0]
    for seed in (seeds[1], jnp.uint32(0)):
        words = (words ^ (words >> 16)) * jnp.uint32(0x7FEB352D)
        words = (words ^ (words >> 15)) * jnp.uint32(0x846CA68B)
        words = (words ^ (words >> 16)) + seed
    return words.reshape(shape)


def _finer(field: Array) -> Array:
    """Twice the rows and columns of a periodic field (row, column, channel): quadratic B-spline subdivision."""
    for axis in (0, 1):
        before, after = jnp.roll(field, 1, axis), jnp.roll(field, -1, axis)
        pair = jnp.stack([0.75 * field + 0.25 * before, 0.75 * field + 0.25 * after], axis=axis + 1)
        field = pair.reshape(*(size * (2 if a == axis else 1) for a, size in enumerate(field.shape)))
    return field


def make_atlas(*, key: PRNGKeyArray) -> Float[Array, "texel fields"]:
    """Four periodic random fields of about unit size, (ATLAS_SIZE squared, 4): 1/f, fine grain, sharp cells, specks."""
    draws = white_noise((sum(n * n for n in _GRIDS), 3), key=key).astype(jnp.float32) / 2.0**31 - 1.0
    field, start = jnp.zeros((_GRIDS[0], _GRIDS[0], 3)), 0
    for number, grid in enumerate(_GRIDS):
        octave = draws[start : start + grid * grid].reshape(grid, grid, 3)
        field = _finer(field + octave * _OCTAVES[:, number].reshape(1, 1, 3))
        start += grid * grid
    field = field / jnp.std(field, axis=(0, 1), keepdims=True)
    smooth, fine, cells = field[..., 0], field[..., 1], jnp.tanh(6 * field[..., 2])
    specks = 2 * jnp.maximum(fine - 1.2, 0.0)
    return jnp.stack([smooth, fine, cells, specks], axis=-1).reshape(-1, NUM_FIELDS)


def _bilinear(rows: Array, x: Array, y: Array, wrap: tuple[int, int], start: Array | int = 0) -> Array:
    """Interpolate a picture stored as rows (texel, channel) from `start`, repeated periodically."""
    height, width = wrap
    x0, y0 = jnp.floor(x), jnp.floor(y)
    fx, fy = x - x0, y - y0
    left, top = x0.astype(jnp.int32) % width, y0.astype(jnp.int32) % height
    right, bottom = (left + 1) % width, (top + 1) % height
    index = start + jnp.stack([top * width + left, top * width + right, bottom * width + left, bottom * width + right])
    weight = jnp.stack([(1 - fy) * (1 - fx), (1 - fy) * fx, fy * (1 - fx), fy * fx])
    taps = jnp.take(rows, index, axis=0, mode="clip").astype(jnp.float32)
    return jnp.sum(taps * weight[..., None], axis=0)


def _pattern(surface: Surface, x: Array, y: Array) -> Array:
    """Stripes, checker or lines, 0 to 1, with edges about one pixel wide."""
    kind, rate = surface.pattern[0], surface.pattern[1]
    sx, sy = wave(rate * x + surface.pattern[3]), wave(rate * y)
    height = jnp.where(kind == 2, sx * sy, jnp.where(kind == 3, jnp.maximum(sx, sy) - 0.85, sx))
    return jnp.where(kind == 0, 0.0, jnp.clip(0.5 + height / rate, 0.0, 1.0))


def paint(
    surface: Surface,
    local: tuple[Float[Array, "height width"], Float[Array, "height width"]],
    atlas: Float[Array, "texel fields"],
    photographs: Float[Array, "count rows columns 3"] | UInt8[Array, "count rows columns 3"] | None = None,
) -> Float[Array, "height width 3"]:
    """Colours, 0 to 1, at local points; `surface` holds planes."""
    x, y = local
    cosine, sine = surface.texel[0], surface.texel[1]
    u = cosine * x + sine * y + surface.texel[2]
    v = cosine * y - sine * x + surface.texel[3]
    fields = _bilinear(atlas, u, v, (ATLAS_SIZE, ATLAS_SIZE))
    wobble = surface.pattern[2] * fields[..., 0]
    colour = surface.base + surface.contrast * _pattern(surface, x + wobble, y + wobble)[None]
    for number in range(NUM_FIELDS):
        colour = colour + surface.tints[number] * fields[None, ..., number]
    if photographs is not None:
        count, height, width, _ = photographs.shape
        scale = surface.photo[2]
        # A photograph mirrored at its edges repeats without seams.
        u = jnp.abs((x * scale + surface.photo[3] * width) % (2 * width - 2) - (width - 1))
        v = jnp.abs((y * scale + surface.photo[4] * height) % (2 * height - 2) - (height - 1))
        start = jnp.clip(surface.photo[1] * count, 0, count - 1).astype(jnp.int32)[None] * (height * width)
        picture = _bilinear(photographs.reshape(-1, 3), u, v, (height, width), start)
        if photographs.dtype == jnp.uint8:
            picture = picture / 255.0
        colour = jnp.where(surface.photo[:1] > 0, jnp.moveaxis(picture, -1, 0), colour)
    shade = surface.shade[0] * x + surface.shade[1] * y
    colour = jnp.clip(colour * jnp.clip(1 + shade, 0.5, 1.5)[None], 0.0, 1.0)
    return jnp.moveaxis(colour, 0, -1)


def soft_shadow(
    points: tuple[Float[Array, "height width"], Float[Array, "height width"]], edge: Float[Array, 5]
) -> Float[Array, "height width 1"]:
    """Factor by which a shadow with a straight soft edge darkens: normal x, y, its distance and width (px), depth."""
    along = (edge[0] * points[0] + edge[1] * points[1] - edge[2]) / edge[3]
    return (1 - edge[4] * jax.nn.sigmoid(along))[..., None]


def relight(
    image: Float[Array, "height width 3"], gain: Float[Array, 3], offset: Float[Array, ""], gamma: Float[Array, ""]
) -> Float[Array, "height width 3"]:
    """gain image^gamma + offset."""
    return image**gamma * gain.reshape(1, 1, 3) + offset


def lens_blur(image: Float[Array, "height width 3"], sigma_px: Float[Array, ""]) -> Float[Array, "height width 3"]:
    """Gaussian blur by a kernel of 5 pixels each way, good up to about 1.2 px; the edge pixel is repeated outside."""
    weights = jnp.exp(-0.5 * jnp.square(jnp.arange(3.0) / jnp.maximum(sigma_px, 1e-2)))
    weights = weights / (weights[0] + 2 * weights[1] + 2 * weights[2])
    for axis in (0, 1):
        size = image.shape[axis]
        padded = jnp.pad(image, [(2, 2) if a == axis else (0, 0) for a in range(3)], mode="edge")
        taps = [jax.lax.slice_in_dim(padded, k, k + size, axis=axis) for k in range(5)]
        image = weights[0] * taps[2] + weights[1] * (taps[1] + taps[3]) + weights[2] * (taps[0] + taps[4])
    return image


def sensor_noise(
    image: Float[Array, "height width 3"], level: Float[Array, ""], *, key: PRNGKeyArray
) -> Float[Array, "height width 3"]:
    """Add shot noise: standard deviation `level` at white, less in the dark; clipped to 0 to 1."""
    bits = white_noise(image.shape, key=key)
    # The sum of a word's four bytes is close to a Gaussian, at a quarter of its cost.
    total = sum(((bits >> shift) & 255).astype(jnp.float32) for shift in (0, 8, 16, 24))
    gauss = (total - 510.0) / 147.8
    return jnp.clip(image + level * jnp.sqrt(0.1 + 0.9 * jnp.clip(image, 0.0, 1.0)) * gauss, 0.0, 1.0)
