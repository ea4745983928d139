"""Random scenes for flow pairs: settings, and random camera, motions, outlines and surfaces from one key."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, PRNGKeyArray

from . import appearance as look
from . import layers as geometry

_NUM_ROWS = 96  # uniform numbers for each layer, and for the scene; more than are used
_PROBABILITIES = ("static_scene_probability", "static_camera_probability", "static_layer_probability", "bend_probability", "low_texture_probability", "photo_probability",
           "lighting_change_probability")  # fmt: skip
_RANGES = ("radius_px", "motion_px", "camera_motion_px")
_SIZES = ("turn_rad", "zoom", "bend_px", "camera_turn_rad", "camera_zoom", "camera_tilt", "gain", "offset", "gamma",
          "shadow", "blur_px", "noise")  # fmt: skip


@dataclasses.dataclass(frozen=True)
class FlowPairSettings:
    """Distribution of the pairs. Two numbers are a range; a single size is the largest magnitude.

    Lengths of motion and radii are log-uniform in their range; rotations, zooms, tilts and bends are cubes of uniform
    numbers, so mostly small. Raises `ValueError` for impossible values.
    """

    height: int = 128
    width: int = 160
    num_layers: tuple[int, int] = (2, 8)
    radius_px: tuple[float, float] = (6.0, 55.0)
    motion_px: tuple[float, float] = (0.1, 20.0)  # of a layer over the background
    turn_rad: float = 0.35
    zoom: float = 0.15
    bend_px: float = 4.0
    bend_probability: float = 0.4
    static_layer_probability: float = 0.3  # fixed to the background
    camera_motion_px: tuple[float, float] = (0.1, 8.0)
    camera_turn_rad: float = 0.08
    camera_zoom: float = 0.06
    camera_tilt: float = 0.04  # perspective: relative change of scale at the picture's left or right edge
    static_camera_probability: float = 0.5
    static_scene_probability: float = 0.05  # nothing moves
    low_texture_probability: float = 0.25  # of a layer with almost no texture
    photo_probability: float = 0.5  # of a layer with a photograph, where photographs are given
    lighting_change_probability: float = 0.5  # of a change of light between the pictures
    gain: float = 0.2
    offset: float = 0.05
    gamma: float = 0.2
    shadow: float = 0.4  # depth of a soft shadow that moves
    blur_px: float = 0.8  # standard deviation of the lens blur
    noise: float = 0.03  # standard deviation at white of the noisiest pictures

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 16:
            raise ValueError(f"height and width are {self.height} and {self.width}; expected at least 16 pixels each.")
        low, high = self.num_layers
        if not 1 <= low <= high:
            raise ValueError(f"num_layers is {self.num_layers}; expected 1 <= smallest <= largest.")
        for name in _PROBABILITIES:
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a probability from 0 to 1.")
        for name in _RANGES:
            low, high = getattr(self, name)
            if not 0 < low <= high < float("inf"):
                raise ValueError(f"{name} is {(low, high)}; expected 0 < lowest <= highest (it is log-uniform).")
        for name in _SIZES:
            if not 0 <= getattr(self, name) < float("inf"):
                raise ValueError(f"{name} is {getattr(self, name)}; expected a finite number of at least 0.")
        for name, limit in {"zoom": 0.6, "camera_zoom": 0.6, "camera_tilt": 0.25, "gamma": 0.9, "gain": 0.9}.items():
            if getattr(self, name) > limit:
                raise ValueError(
                    f"{name} is {getattr(self, name)}; expected at most {limit}, beyond which pictures degenerate."
                )


class Scene(eqx.Module):
    """All random parameters of a pair. Rows are layers, the background first, then from far to near."""

    camera: geometry.Camera
    motion: geometry.Motion
    outline: geometry.Outline  # one row fewer: the background covers everything
    surface: look.Surface


class _Draws:
    """Returns the rows of a table of uniform numbers, each once."""

    def __init__(self, table: Array):
        self._table, self._used = table, 0

    def __call__(self, *shape: int) -> Array:
        """The next row, or as many rows as fill `shape`, whose axes precede those of a row."""
        count = int(np.prod(shape))
        if self._used + count > len(self._table):
            raise ValueError(f"More than {len(self._table)} uniform numbers are needed; increase _NUM_ROWS.")
        rows = self._table[self._used : self._used + count]
        self._used += count
        return rows.reshape(*shape, *self._table.shape[1:])


def _log_uniform(draw: Array, limits: tuple[float, float]) -> Array:
    return limits[0] * (limits[1] / limits[0]) ** draw


def _mostly_small(draw: Array, largest: float) -> Array:
    return largest * (2 * draw - 1) ** 3


def _draw_camera(settings: FlowPairSettings, draws: _Draws, still: Array) -> tuple[geometry.Camera, Array]:
    moves = 1.0 - (still | (draws() < settings.static_camera_probability)).astype(jnp.float32)
    angle, length = 2 * np.pi * draws(), _log_uniform(draws(), settings.camera_motion_px)
    shift = moves * length * jnp.stack([jnp.cos(angle), jnp.sin(angle)])
    turn = moves * _mostly_small(draws(), settings.camera_turn_rad)
    zoom = moves * _mostly_small(draws(), settings.camera_zoom)
    tilt = moves * _mostly_small(draws(2), settings.camera_tilt)
    return geometry.make_camera(shift, turn, zoom, tilt, settings.width / 2), shift


def _draw_motion(settings: FlowPairSettings, draws: _Draws, fixed: Array, radius: Array,
                 camera_shift: Array) -> geometry.Motion:  # fmt: skip
    """Motion of all layers. `fixed` layers do not move relative to the background."""
    moves = jnp.where(fixed, 0.0, 1.0)
    heading = 2 * np.pi * draws()
    cosine, sine = jnp.cos(heading), jnp.sin(heading)
    length, angle = moves * _log_uniform(draws(), settings.motion_px), 2 * np.pi * draws()
    # Layers nearer than the background move farther when the camera shifts.
    parallax = moves * draws()
    shift_x = length * jnp.cos(angle) + parallax * (cosine * camera_shift[0] + sine * camera_shift[1])
    shift_y = length * jnp.sin(angle) + parallax * (cosine * camera_shift[1] - sine * camera_shift[0])
    turn, zoom = _mostly_small(draws(), settings.turn_rad), _mostly_small(draws(), settings.zoom)
    squeeze, skew = _mostly_small(draws(), 0.5 * settings.zoom), _mostly_small(draws(), 0.5 * settings.zoom)
    c, s = jnp.cos(turn), jnp.sin(turn)
    xx, yy = (1 + zoom) * (1 + squeeze), (1 + zoom) * (1 - squeeze)
    a, b, d, e = c * xx, c * skew - s * yy, s * xx, s * skew + c * yy
    scale = 1 / (a * e - b * d)
    ahead = (a - 1, b, d, e - 1)
    back = (e * scale - 1, -b * scale, -d * scale, a * scale - 1)
    bends = jnp.where(draws() < settings.bend_probability, moves, 0.0)

    def bend() -> tuple[Array, Array, Array]:
        rate = 2 * np.pi / ((1.5 + 3 * draws()) * radius)
        # A slope of at most 0.6: a stronger bend looks like tearing.
        amplitude = jnp.clip(_mostly_small(draws(), settings.bend_px), -0.6 / rate, 0.6 / rate)
        return bends * amplitude, rate, 2 * np.pi * draws()

    return geometry.Motion(
        settings.width * 0.55 * (2 * draws() - 1), settings.height * 0.55 * (2 * draws() - 1), cosine, sine,
        shift_x, shift_y, tuple(moves * x for x in ahead), tuple(moves * x for x in back), bend(), bend(),
    )  # fmt: skip


def _draw_outline(settings: FlowPairSettings, draws: _Draws, exists: Array, radius: Array) -> geometry.Outline:
    kind = jnp.floor(4 * draws())
    aspect = 0.4 + 0.6 * draws()
    limb = kind == 3
    power = jnp.where(limb, 0.0, 1 + jnp.floor(3 * draws()))
    hollow = (draws() < 0.12) & ~limb
    rim = jnp.where(hollow, (0.1 + 0.15 * draws()) * radius * aspect, 0.0)
    elbow = np.pi * (2 * draws() - 1)
    orders = jnp.arange(2, 2 + geometry.NUM_HARMONICS, dtype=jnp.float32).reshape(-1, 1, 1)
    harmonics = 0.5 * (2 * draws(geometry.NUM_HARMONICS, 2) - 1) / orders
    corner = jnp.arange(geometry.NUM_SIDES, dtype=jnp.float32).reshape(-1, 1)
    angles = 2 * np.pi / geometry.NUM_SIDES * (corner + 0.7 * draws(geometry.NUM_SIDES))
    sides = jnp.stack([jnp.cos(angles), jnp.sin(angles), 0.5 + 0.5 * draws(geometry.NUM_SIDES)], axis=1)
    half_x = jnp.where(limb, 1.2 * radius, radius)
    thickness = jnp.maximum((0.15 + 0.3 * draws()) * radius, 1.5)
    return geometry.Outline(kind, exists.astype(jnp.float32), half_x, radius * aspect, power, rim, thickness,
                            jnp.stack([jnp.cos(elbow), jnp.sin(elbow)]), harmonics, sides)  # fmt: skip


def _draw_surface(settings: FlowPairSettings, draws: _Draws, radius: Array) -> look.Surface:
    def colour(saturation: float) -> Array:
        return (1 - saturation) * draws(1) + saturation * draws(3)

    base = 0.08 + 0.84 * colour(0.35)
    # Most layers show one or two of the fields clearly, some almost nothing.
    largest = jnp.asarray([0.35, 0.2, 0.25, 0.3]).reshape(-1, 1)
    strength = draws(look.NUM_FIELDS) ** 3 * largest
    strength = jnp.where(draws(1) < settings.low_texture_probability, 0.06 * strength, 0.03 + strength)
    sign = 2 * colour(0.3) - 1
    tints = strength[:, None] * jnp.stack([sign, 2 * colour(0.2) - 1, 2 * colour(0.6) - 1, 0.3 - sign])
    angle, scale = 2 * np.pi * draws(), 0.35 + 0.65 * draws()
    texel = jnp.concatenate([jnp.stack([scale * jnp.cos(angle), scale * jnp.sin(angle)]), look.ATLAS_SIZE * draws(2)])
    kind = jnp.maximum(jnp.floor(7 * draws()) - 3, 0)
    wavelength = _log_uniform(draws(), (5.0, 40.0))
    pattern = jnp.stack([kind, 2 * np.pi / wavelength, 3 * draws() ** 2, 2 * np.pi * draws()])
    shade = 0.3 * (2 * draws(2) - 1) / radius[None]
    is_photo = (draws() < settings.photo_probability).astype(jnp.float32)
    photo = jnp.stack([is_photo, draws(), 0.6 + 0.6 * draws(), draws(), draws()])
    leaves = (base, 0.5 * (colour(0.4) - base), tints, shade, texel, pattern, photo)
    return look.Surface(*(jnp.moveaxis(leaf, -1, 0) for leaf in leaves))


def draw_scene(settings: FlowPairSettings, *, key: PRNGKeyArray) -> Scene:
    """A random scene, with room for the largest number of layers."""
    most = settings.num_layers[1]
    table = jax.random.uniform(key, (_NUM_ROWS, most + 2))
    alone, draws = _Draws(table[:, -1]), _Draws(table[:, :-1])
    still = alone() < settings.static_scene_probability
    camera, shift = _draw_camera(settings, alone, still)
    span = settings.num_layers[1] - settings.num_layers[0] + 1
    number = settings.num_layers[0] + jnp.floor(span * alone())
    rows = jnp.arange(most + 1)
    radius = _log_uniform(draws(), settings.radius_px)
    radius = jnp.where(rows == 0, 0.5 * settings.width, radius)
    fixed = still | (rows == 0) | (draws() < settings.static_layer_probability)
    motion = _draw_motion(settings, draws, fixed, radius, shift)
    outline = _draw_outline(settings, draws, rows.astype(jnp.float32) <= number, radius)
    outline = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, -1, 0)[1:], outline)
    surface = _draw_surface(settings, draws, radius)
    return Scene(camera, motion, outline, surface)
