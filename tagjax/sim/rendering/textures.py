"""Textures of surfaces: patterns and photographs fixed in the frame of each geom, so that they move with it.

Every pattern is faded or averaged where its cells approach the size of a pixel, so that nothing flickers at a distance.
"""

from __future__ import annotations

import functools
import importlib.util
import warnings
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from ..world.bodies import Shape

PHOTOGRAPHS = {
    "hopper": ("matplotlib", "mpl-data/sample_data/grace_hopper.jpg"),
    "china": ("sklearn", "datasets/images/china.jpg"),
    "flower": ("sklearn", "datasets/images/flower.jpg"),
    "astronaut": ("skimage", "data/astronaut.png"),
    "coffee": ("skimage", "data/coffee.png"),
    "chelsea": ("skimage", "data/chelsea.png"),
    "rocket": ("skimage", "data/rocket.jpg"),
    "brick": ("skimage", "data/brick.png"),
    "grass": ("skimage", "data/grass.png"),
    "gravel": ("skimage", "data/gravel.png"),
}
"""Photographs by name: the package that contains each, and the path within it. Nothing is downloaded."""

_PICTURE_GAMMA = 2.2
_OCTAVES = ((1.0, 0.5), (2.7, 0.3), (7.1, 0.2))  # of the noise: frequency, weight
_CAP = 0.75  # cosine to a round shape's axis above which the texture is projected along the axis


class Paint:
    """The textures of all geoms: `albedo` of points on them."""

    def __init__(self, shapes: Sequence[Shape]):
        materials = [shape.material for shape in shapes]
        self._colour = np.array([m.colour for m in materials], np.float32).reshape(-1, 3)
        self._scale = np.array([m.scale for m in materials], np.float32)
        self._contrast = np.array([m.contrast for m in materials], np.float32)
        self._seed = np.array([m.seed & 0x7FFFFFFF for m in materials], np.uint32)
        self._round_m = np.array([0.0 if s.kind == "box" else _girth(s) for s in shapes], np.float32)
        # A photograph that is not installed is replaced by noise, with one warning.
        pictures = [m.photo if m.texture == "photo" else "" for m in materials]
        missing = {name for name in pictures if name and photograph(name) is None}
        if missing:
            warnings.warn(
                f"Photographs {sorted(missing)} are not installed (pip install {' '.join(_packages(missing))}); "
                "their surfaces get noise instead.",
                stacklevel=2,
            )
        self._kind = np.array(
            [f"photo {m.photo}" if m.texture == "photo" and m.photo not in missing else m.texture for m in materials]
        )
        self._kind[self._kind == "photo"] = "noise"
        self._scale[[m.texture == "photo" and m.photo in missing for m in materials]] = 8.0

    def albedo(self, geom: np.ndarray, local_m: np.ndarray, normal: np.ndarray, footprint_m: np.ndarray) -> np.ndarray:
        """Linear colour (points, 3) of points (points, 3) with normals, in their geoms' frames; a pixel's size there."""
        out = self._colour[geom]
        for kind in np.unique(self._kind[geom]):
            some = np.flatnonzero((self._kind == kind)[geom])
            if kind == "plain":
                continue
            which = geom[some]
            point, pixel = local_m[some].astype(np.float32), footprint_m[some].astype(np.float32)
            scale, seed, contrast = self._scale[which], self._seed[which], self._contrast[which, None]
            if kind in ("noise", "speckle"):
                shade = (_cloud if kind == "noise" else _speckle)(point * scale[:, None], pixel * scale, seed)
                out[some] *= 1 + contrast * shade[:, None]
                continue
            place = _unrolled(point, normal[some].astype(np.float32), self._round_m[which])
            if kind.startswith("photo"):
                picture = _sampled(kind.removeprefix("photo "), place, 1 / scale, pixel, seed)
                out[some] = (1 - contrast) * out[some] + contrast * picture
                continue
            cells, width = place * scale[:, None], np.maximum(pixel * scale, 1e-4)
            across = seed % 2 == 1
            stripe = _square(np.where(across, cells[:, 1], cells[:, 0]), width)
            shade = stripe if kind == "stripes" else _square(cells[:, 0], width) * _square(cells[:, 1], width)
            out[some] *= 1 + contrast * shade[:, None]
        return np.clip(out, 0.0, 0.95)


@functools.lru_cache(maxsize=32)
def photograph(name: str) -> tuple[np.ndarray, ...] | None:
    """A photograph of an installed package as a pyramid of linear pictures, float32; None where it is not installed."""
    if name not in PHOTOGRAPHS:
        raise ValueError(f"photo is {name!r}; expected one of {', '.join(PHOTOGRAPHS)}.")
    package, path = PHOTOGRAPHS[name]
    found = importlib.util.find_spec(package)
    if found is None or found.origin is None:
        return None
    picture = cv2.imread(str(Path(found.origin).parent / path), cv2.IMREAD_COLOR)
    if picture is None:
        return None
    level = (picture[..., ::-1] / np.float32(255)).astype(np.float32) ** np.float32(_PICTURE_GAMMA)
    levels: list[np.ndarray] = [level]
    while min(level.shape[:2]) > 4:
        half = (level.shape[1] // 2, level.shape[0] // 2)
        level = np.asarray(cv2.resize(level, half, interpolation=cv2.INTER_AREA))
        levels.append(level)
    return tuple(levels)


def _packages(names: set[str]) -> list[str]:
    pip = {"sklearn": "scikit-learn", "skimage": "scikit-image"}
    return sorted({pip.get(PHOTOGRAPHS[name][0], PHOTOGRAPHS[name][0]) for name in names})


def _girth(shape: Shape) -> float:
    """Radius around the axis of a round shape."""
    return float((shape.size_m[0] + shape.size_m[1]) / 2 if shape.kind == "ellipsoid" else shape.size_m[0])


def _unrolled(point: np.ndarray, normal: np.ndarray, round_m: np.ndarray) -> np.ndarray:
    """Points as texture coordinates in metres, (points, 2): right and down.

    Boxes use the axes of each face; round shapes are unrolled around their z axis, and their ends projected along it.
    """
    x, y, z = point.T
    facing = np.abs(normal)
    is_round = round_m > 0
    end = np.where(is_round, facing[:, 2] > _CAP, (facing[:, 2] >= facing[:, 0]) & (facing[:, 2] >= facing[:, 1]))
    side = facing[:, 0] >= facing[:, 1]
    around = np.arctan2(y, x) * np.where(is_round, round_m, 1)
    # Seen from outside, right is right on every face, so that letters are not mirrored.
    flat = np.where(side, y * np.sign(normal[:, 0]), -x * np.sign(normal[:, 1]))
    right = np.where(end, -y, np.where(is_round, around, flat))
    return np.stack([right, np.where(end, -x, -z)], axis=-1)


def _square(cells: np.ndarray, width: np.ndarray) -> np.ndarray:
    """A square wave of period 2, averaged over `width` cells; -1 to 1."""
    saw = 4 * np.abs(cells / 2 - np.floor(cells / 2) - 0.5) - 1
    return np.clip(saw / np.minimum(width, 1), -1, 1) * _kept(width, 1.0)


def _kept(width: np.ndarray, limit: float) -> np.ndarray:
    """Remaining contrast of a pattern of cells 1 wide at pixels `width` wide: from 1 down to 0 at `limit` cells."""
    part = np.clip((limit - width) / (0.5 * limit), 0, 1)
    return part * part * (3 - 2 * part)


def _cloud(cells: np.ndarray, width: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Solid noise of three octaves, about -1 to 1."""
    out = np.zeros(len(cells), np.float32)
    for octave, (frequency, weight) in enumerate(_OCTAVES):
        kept = _kept(width * frequency, 1.0)
        some = np.flatnonzero(kept > 0)
        value = _value_noise(
            cells[some] * np.float32(frequency) + np.float32(7.3 * octave), seed[some] + np.uint32(octave)
        )
        out[some] += np.float32(weight) * kept[some] * (value - 0.5)
    # Sums of uniform values concentrate in the middle of their range.
    return np.clip(out * 3, -1, 1)


def _speckle(cells: np.ndarray, width: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Hard-edged spots of about a cell, as random dots or pebbles; -1 to 1."""
    value = _value_noise(cells, seed) - 0.5
    soft = np.maximum(0.06, width)
    return np.clip(value / soft, -1, 1) * _kept(width, 1.0)


def _value_noise(cells: np.ndarray, seed: np.ndarray) -> np.ndarray:
    """Value noise: random values at integer positions, interpolated smoothly; 0 to 1, (points,) of (points, 3)."""
    floor = np.floor(cells)
    part = cells - floor
    part = part * part * (3 - 2 * part)
    whole = floor.astype(np.int32).astype(np.uint32)
    primes = (np.uint32(73856093), np.uint32(19349663), np.uint32(83492791))
    low = [whole[:, axis] * prime for axis, prime in enumerate(primes)]
    ends = [(first, first + prime) for first, prime in zip(low, primes, strict=True)]
    planes = []
    for x in ends[0]:
        rows = []
        for y in ends[1]:
            mixed = x ^ y ^ seed
            near, far = (_scrambled(mixed ^ z) for z in ends[2])
            rows.append(near + (far - near) * part[:, 2])
        planes.append(rows[0] + (rows[1] - rows[0]) * part[:, 1])
    return planes[0] + (planes[1] - planes[0]) * part[:, 0]


def _scrambled(key: np.ndarray) -> np.ndarray:
    """A hash value from 0 to 1 of each key, float32 (the finaliser of MurmurHash3 without its last multiplication)."""
    key = (key ^ (key >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    key = (key ^ (key >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    return (key >> np.uint32(8)).astype(np.float32) * np.float32(1 / 2**24)


def _sampled(
    name: str, place_m: np.ndarray, per_metre: np.ndarray, footprint_m: np.ndarray, seed: np.ndarray
) -> np.ndarray:
    """Colours (points, 3) of a photograph at texture coordinates (points, 2), mirrored at its borders, from its pyramid.

    `per_metre` is the number of pictures per metre of width. A seed other than 0 selects another part of the picture.
    """
    levels = photograph(name)
    assert levels is not None
    height, width = levels[0].shape[:2]
    shift = np.stack([_scrambled(seed), _scrambled(seed ^ np.uint32(0x5BD1E995))], axis=-1) * (seed > 0)[:, None]
    turns = place_m * per_metre[:, None] * np.array([1, width / height], np.float32) + np.float32(0.5) + 2 * shift
    turns = 1 - np.abs(turns - 2 * np.floor(turns / 2) - 1)
    wanted = np.log2(np.maximum(footprint_m * per_metre * width, 1e-6))
    level = np.clip(np.rint(wanted + 0.25), 0, len(levels) - 1).astype(int)
    out = np.zeros((len(place_m), 3), np.float32)
    for number in np.unique(level):
        some = np.flatnonzero(level == number)
        picture = levels[number]
        size = np.array(picture.shape[1::-1], np.float32)
        # OpenCV takes no maps longer than 32,767: fold the points into rows.
        rows = -(-len(some) // 1024)
        spots = np.zeros((rows * 1024, 2), np.float32)
        spots[: len(some)] = turns[some] * size - np.float32(0.5)
        spots = spots.reshape(rows, 1024, 2)
        colours = cv2.remap(picture, spots, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # pyright: ignore
        out[some] = colours.reshape(-1, 3)[: len(some)]
    return out
