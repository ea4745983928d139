"""Objects that people carry, of the kinds in the papers: boxes, bottles, toys, notebooks, bags. Each has a tag position.

Frame: origin at the centre of the bounding box, z up as the object stands, x its front.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .bodies import Material, Shape, ShapeKind, rotation_matrix

TAG_GAP_M = 0.002
"""Distance of a tag's centre from the surface it sticks to: a label with foam, outside the shape for ray casts."""


@dataclasses.dataclass(frozen=True)
class ObjectModel:
    """An object: shapes, extent, grip and tag position, all in its own frame."""

    name: str
    shapes: tuple[Shape, ...]
    half_size_m: tuple[float, float, float]
    grip_m: tuple[float, float, float]
    tag_m: tuple[float, float, float]
    dipole: tuple[float, float, float]


@dataclasses.dataclass
class _Draft:
    """The result of a maker function, in any frame."""

    shapes: list[Shape]
    grip: tuple[float, float, float]
    tag: tuple[float, float, float]
    dipole: tuple[float, float, float] = (0.0, 0.0, 1.0)


def make_object(kind: str, rng: np.random.Generator, *, look: int | None = None, scale: float = 1.0) -> ObjectModel:
    """Draw an object of a kind of `OBJECT_KINDS`.

    `look` alone determines size and appearance: two objects of one kind, look and scale are identical. Without it a
    look is drawn from `rng`; one number is drawn from `rng` in either case. `scale` multiplies every length. Raises `ValueError`
    for an unknown kind or a scale that is not positive.
    """
    if kind not in _MAKERS:
        raise ValueError(f"kind is {kind!r}; expected one of {', '.join(OBJECT_KINDS)}.")
    if not scale > 0:
        raise ValueError(f"scale is {scale}; expected a positive number.")
    drawn = int(rng.integers(0, 2**31))
    source = np.random.default_rng([OBJECT_KINDS.index(kind), drawn if look is None else look])
    draft = _MAKERS[kind](source)
    low, high = bounds(draft.shapes)
    middle = (low + high) / 2

    def moved(point) -> tuple[float, float, float]:
        return _triple((np.asarray(point, float) - middle) * scale)

    shapes = tuple(
        dataclasses.replace(shape, size_m=_triple(np.array(shape.size_m) * scale), position_m=moved(shape.position_m))
        for shape in draft.shapes
    )
    return ObjectModel(
        kind, shapes, _triple((high - low) / 2 * scale), moved(draft.grip), moved(draft.tag), _triple(draft.dipole)
    )


def bounds(shapes: list[Shape] | tuple[Shape, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner (3,) of the axis-aligned bounding box of shapes, in their body's frame."""
    lows, highs = [], []
    for shape in shapes:
        turn = rotation_matrix(np.array(shape.quaternion))
        a, b, c = shape.size_m
        if shape.kind == "box":
            half = np.abs(turn) @ np.array([a, b, c])
        elif shape.kind == "sphere":
            half = np.full(3, a)
        elif shape.kind == "ellipsoid":
            half = np.sqrt((turn**2) @ np.array([a * a, b * b, c * c]))
        else:
            axis = turn[:, 2]
            cap = a if shape.kind == "capsule" else a * np.sqrt(np.maximum(1 - axis**2, 0))
            half = np.abs(axis) * b + cap
        lows.append(np.array(shape.position_m) - half)
        highs.append(np.array(shape.position_m) + half)
    return np.min(lows, axis=0), np.max(highs, axis=0)


def _triple(values) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _colour(rng: np.random.Generator, low: float = 0.05, high: float = 0.9) -> tuple[float, float, float]:
    """A saturated colour: one or two channels high."""
    values = rng.permutation([rng.uniform(0.55, 1.0), rng.uniform(0.1, 1.0), rng.uniform(0.05, 0.35)])
    return _triple(low + (high - low) * values)


def _surface(
    rng: np.random.Generator, *, loss_db: float = 1.0, reflection: float = -0.05, fine: float = 1.0
) -> Material:
    """A surface for a dry object: mostly strong textures, some plain, some dark or shiny."""
    texture = str(rng.choice(["checker", "stripes", "speckle", "noise", "plain"], p=[0.2, 0.2, 0.2, 0.25, 0.15]))
    dark = rng.random() < 0.12
    return Material(
        _colour(rng, 0.02, 0.1) if dark else _colour(rng),
        texture,  # pyright: ignore[reportArgumentType]
        scale=float(rng.uniform(20, 60)) * fine,
        contrast=0.05 if texture == "plain" else float(rng.uniform(0.35, 0.85)),
        seed=int(rng.integers(0, 2**31)),
        shine=float(rng.uniform(0.4, 0.8)) if rng.random() < 0.2 else 0.1,
        transmission_db=loss_db,
        reflection=reflection,
    )


def _plain(colour: tuple[float, float, float], *, loss_db: float = 1.0, shine: float = 0.2) -> Material:
    return Material(colour, "plain", contrast=0.03, shine=shine, transmission_db=loss_db, reflection=-0.05)


def _part(kind: ShapeKind, size: tuple, at: tuple, material: Material, quaternion=(1.0, 0.0, 0.0, 0.0)) -> Shape:
    return Shape(kind, _triple((*size, 0.0, 0.0)[:3]), material, _triple(at), quaternion)


_ALONG_X = (0.7071067811865476, 0.0, 0.7071067811865476, 0.0)  # z to x
_ALONG_Y = (0.7071067811865476, 0.7071067811865476, 0.0, 0.0)  # z to -y


def _box(rng: np.random.Generator) -> _Draft:
    x, y, z = rng.uniform(0.05, 0.12), rng.uniform(0.08, 0.18), rng.uniform(0.06, 0.16)
    skin = _surface(rng, loss_db=2.0)
    tape = _plain((0.75, 0.62, 0.4))
    shapes = [_part("box", (x, y, z), (0, 0, 0), skin), _part("box", (0.025, y + 0.001, z + 0.001), (0, 0, 0), tape)]
    return _Draft(shapes, (0.0, 0.0, -z), (x + TAG_GAP_M, 0.0, 0.3 * z), (0.0, 1.0, 0.0))


def _bottle(rng: np.random.Generator) -> _Draft:
    r, half = rng.uniform(0.032, 0.045), rng.uniform(0.075, 0.11)
    # Water reflects well; its loss is assumed.
    liquid = dataclasses.replace(_surface(rng, fine=1.5), transmission_db=float(rng.uniform(6, 10)), reflection=-0.5)
    label, cap = _surface(rng, loss_db=0.5, fine=2.0), _plain(_colour(rng))
    shoulder = _part("ellipsoid", (r, r, 0.8 * r), (0, 0, half), liquid)
    shapes = [
        _part("cylinder", (r, half), (0, 0, 0), liquid),
        shoulder,
        _part("cylinder", (r + 0.001, 0.4 * half), (0, 0, -0.1 * half), label),
        _part("cylinder", (0.36 * r, 0.4 * r), (0, 0, half + 0.95 * r), liquid),
        _part("cylinder", (0.42 * r, 0.3 * r), (0, 0, half + 1.5 * r), cap),
    ]
    # Foam keeps the tag away from the water; without it the tag could not be read.
    return _Draft(shapes, (0.0, 0.0, 0.55 * half), (r + 0.001 + 3 * TAG_GAP_M, 0.0, -0.1 * half))


def _toy(rng: np.random.Generator) -> _Draft:
    return _bear(rng) if rng.random() < 0.6 else _car(rng)


def _bear(rng: np.random.Generator) -> _Draft:
    s = rng.uniform(0.85, 1.25)
    fur = dataclasses.replace(_surface(rng, fine=1.3), shine=0.0)
    light = dataclasses.replace(fur, colour=_triple(np.clip(np.array(fur.colour) * 1.5 + 0.15, 0, 0.95)))
    dark = _plain((0.03, 0.03, 0.03), shine=0.6)
    shapes = [
        _part("ellipsoid", (0.055 * s, 0.065 * s, 0.08 * s), (0, 0, 0), fur),
        _part("ellipsoid", (0.022 * s, 0.042 * s, 0.052 * s), (0.038 * s, 0, -0.005 * s), light),
        _part("sphere", (0.055 * s,), (0.005 * s, 0, 0.115 * s), fur),
        _part("ellipsoid", (0.025 * s, 0.028 * s, 0.022 * s), (0.052 * s, 0, 0.102 * s), light),
        _part("sphere", (0.009 * s,), (0.075 * s, 0, 0.108 * s), dark),
    ]
    for side in (-1.0, 1.0):
        shapes += [
            _part("sphere", (0.021 * s,), (0, side * 0.045 * s, 0.158 * s), fur),
            _part("sphere", (0.007 * s,), (0.053 * s, side * 0.021 * s, 0.132 * s), dark),
            _part("ellipsoid", (0.024 * s, 0.026 * s, 0.055 * s), (0.02 * s, side * 0.07 * s, 0.015 * s), fur),
            _part("ellipsoid", (0.055 * s, 0.03 * s, 0.03 * s), (0.055 * s, side * 0.042 * s, -0.065 * s), fur),
            _part("sphere", (0.022 * s,), (0.1 * s, side * 0.042 * s, -0.065 * s), light),
        ]
    return _Draft(shapes, (-0.03 * s, 0.0, 0.03 * s), (-0.055 * s - TAG_GAP_M, 0.0, 0.0))


def _car(rng: np.random.Generator) -> _Draft:
    s = rng.uniform(0.9, 1.3)
    paint, glass, rubber = _surface(rng, fine=1.3), _plain((0.1, 0.14, 0.2), shine=0.9), _plain((0.04, 0.04, 0.04))
    shapes = [
        _part("box", (0.12 * s, 0.05 * s, 0.025 * s), (0, 0, 0), paint),
        _part("box", (0.06 * s, 0.044 * s, 0.024 * s), (-0.015 * s, 0, 0.049 * s), glass),
        _part("box", (0.055 * s, 0.045 * s, 0.004 * s), (-0.015 * s, 0, 0.077 * s), paint),
        *_wheels(rubber, 0.075 * s, 0.05 * s, -0.022 * s, 0.026 * s, 0.012 * s),
    ]
    return _Draft(shapes, (-0.015 * s, 0.0, 0.06 * s), (-0.015 * s, 0.0, 0.081 * s + TAG_GAP_M), (1.0, 0.0, 0.0))


def _wheels(material: Material, x: float, y: float, z: float, radius: float, half: float) -> list[Shape]:
    return [_part("cylinder", (radius, half), (a * x, b * y, z), material, _ALONG_Y) for a in (-1, 1) for b in (-1, 1)]


def _train(rng: np.random.Generator) -> _Draft:
    s = rng.uniform(0.9, 1.15)
    paint, cab, rubber = _surface(rng), _surface(rng), _plain((0.05, 0.05, 0.05))
    shapes = [
        _part("box", (0.1 * s, 0.033 * s, 0.012 * s), (0, 0, 0), paint),
        _part("cylinder", (0.027 * s, 0.06 * s), (0.03 * s, 0, 0.036 * s), paint, _ALONG_X),
        _part("box", (0.032 * s, 0.034 * s, 0.036 * s), (-0.062 * s, 0, 0.045 * s), cab),
        _part("box", (0.038 * s, 0.039 * s, 0.004 * s), (-0.062 * s, 0, 0.085 * s), paint),
        _part("cylinder", (0.01 * s, 0.016 * s), (0.07 * s, 0, 0.074 * s), rubber),
        _part("sphere", (0.011 * s,), (0.025 * s, 0, 0.063 * s), cab),
        *_wheels(rubber, 0.06 * s, 0.031 * s, -0.014 * s, 0.018 * s, 0.007 * s),
    ]
    return _Draft(shapes, (0.0, 0.0, 0.05 * s), (-0.062 * s, 0.0, 0.089 * s + TAG_GAP_M), (1.0, 0.0, 0.0))


def _sheets(rng: np.random.Generator, x: float, y: float, z: float) -> _Draft:
    """A cover around a block of pages; stands upright with the front cover ahead."""
    cover, page = _surface(rng, loss_db=1.0), _plain((0.85, 0.84, 0.78), shine=0.0)
    shapes = [_part("box", (x - 0.0015, y, z - 0.004), (0, 0.003, 0), page)]
    shapes += [_part("box", (0.0015, y, z), (side * x, 0, 0), cover) for side in (-1, 1)]
    shapes.append(_part("box", (x, 0.0015, z), (0, -y, 0), cover))
    if rng.random() < 0.7:
        plate = _plain(_colour(rng))
        shapes.append(_part("box", (0.0005, 0.6 * y, 0.18 * z), (x + 0.0017, 0, 0.45 * z), plate))
    return _Draft(shapes, (0.0, 0.0, -0.8 * z), (x + 0.0015 + TAG_GAP_M, 0.0, -0.1 * z))


def _notebook(rng: np.random.Generator) -> _Draft:
    return _sheets(rng, rng.uniform(0.005, 0.01), rng.uniform(0.085, 0.12), rng.uniform(0.12, 0.16))


def _book(rng: np.random.Generator) -> _Draft:
    return _sheets(rng, rng.uniform(0.014, 0.03), rng.uniform(0.065, 0.1), rng.uniform(0.09, 0.14))


def _bag(rng: np.random.Generator) -> _Draft:
    x, y, z = rng.uniform(0.05, 0.09), rng.uniform(0.13, 0.2), rng.uniform(0.13, 0.2)
    cloth, strap = _surface(rng, loss_db=3.0), _plain(_colour(rng, 0.02, 0.4))
    rise = rng.uniform(0.1, 0.16)
    shapes = [
        _part("box", (x, y, z), (0, 0, 0), cloth),
        _part("box", (x + 0.003, y + 0.003, 0.012), (0, 0, 0.8 * z), strap),
    ]
    shapes += [_part("capsule", (0.009, rise / 2), (0, side * 0.45 * y, z + rise / 2), strap) for side in (-1, 1)]
    shapes.append(_part("capsule", (0.009, 0.45 * y), (0, 0, z + rise), strap, _ALONG_Y))
    return _Draft(shapes, (0.0, 0.0, z + rise), (x + 0.001 + TAG_GAP_M, 0.0, 0.0))


def _suitcase(rng: np.random.Generator) -> _Draft:
    x, y, z = rng.uniform(0.1, 0.13), rng.uniform(0.18, 0.24), rng.uniform(0.26, 0.34)
    shell, dark = _surface(rng, loss_db=5.0, fine=0.5), _plain((0.05, 0.05, 0.06))
    rise = rng.uniform(0.3, 0.4)
    shapes = [_part("box", (x, y, z), (0, 0, 0), shell)]
    shapes += [_part("box", (x + 0.005, 0.012, z + 0.004), (0, side * 0.5 * y, 0), dark) for side in (-1, 1)]
    shapes += [_part("capsule", (0.008, rise / 2), (-0.5 * x, side * 0.09, z + rise / 2), dark) for side in (-1, 1)]
    shapes.append(_part("capsule", (0.012, 0.09), (-0.5 * x, 0, z + rise), dark, _ALONG_Y))
    shapes += _wheels(dark, 0.7 * x, 0.75 * y, -z - 0.015, 0.025, 0.01)
    return _Draft(shapes, (-0.5 * x, 0.0, z + rise), (x + 0.001 + TAG_GAP_M, 0.0, 0.3 * z))


def _mug(rng: np.random.Generator) -> _Draft:
    r, half = rng.uniform(0.037, 0.046), rng.uniform(0.042, 0.058)
    glaze = dataclasses.replace(_surface(rng, loss_db=2.0, fine=1.3), shine=0.6)
    inside = _plain((0.12, 0.07, 0.04))
    shapes = [
        _part("cylinder", (r, half), (0, 0, 0), glaze),
        _part("cylinder", (0.88 * r, 0.002), (0, 0, half), inside),
    ]
    shapes += [_part("capsule", (0.006, 0.014), (0, r + 0.012, side * 0.024), glaze, _ALONG_Y) for side in (-1, 1)]
    shapes.append(_part("capsule", (0.006, 0.024), (0, r + 0.026, 0), glaze))
    return _Draft(shapes, (0.0, r + 0.02, 0.0), (r + TAG_GAP_M, 0.0, 0.0), (0.0, 0.0, 1.0))


def _ball(rng: np.random.Generator) -> _Draft:
    r = rng.uniform(0.06, 0.12)
    skin = _surface(rng, loss_db=0.5)
    return _Draft([_part("sphere", (r,), (0, 0, 0), skin)], (0.0, 0.0, -r), (r + TAG_GAP_M, 0.0, 0.0))


_MAKERS: dict[str, Callable[[np.random.Generator], _Draft]] = {
    "box": _box,
    "bottle": _bottle,
    "toy": _toy,
    "notebook": _notebook,
    "bag": _bag,
    "book": _book,
    "mug": _mug,
    "ball": _ball,
    "train": _train,
    "suitcase": _suitcase,
}

OBJECT_KINDS = tuple(_MAKERS)

CARRIED_KINDS = ("bottle", "box", "toy", "notebook", "bag")
"""The five objects of the single-object experiments, which people carry in their hands."""
