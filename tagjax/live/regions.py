"""Regions of the floor or of the picture, as polygons, and whether a traced tag is in one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

Point = tuple[float, float]
Vector = tuple[float, float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Region:
    """A polygon, and when a tag counts as being in it.

    `floor_m` are corners on the floor as `floor_place` gives places; `picture_px` are corners in pixels of the whole
    picture, of which a tag has the centre of its box. One of the two is given. As in Goller et al. (IV), only a tag that
    is detected on a body can be in a region: one that stays in place never raises an alarm. A detection below
    `min_confidence` changes nothing. Raises `ValueError` for fewer than three corners, for corners on a line, and for times below 0.
    """

    name: str
    floor_m: tuple[Point, ...] | None = None
    picture_px: tuple[Point, ...] | None = None
    min_confidence: float = 0.5
    inside_s: float = 0.3  # in the region for so long: an alarm
    outside_s: float = 1.0  # and out of it for so long, before another one

    def __post_init__(self) -> None:
        if not self.name:
            raise ValueError("name is empty; expected a name for the region, which its events hold.")
        if (self.floor_m is None) == (self.picture_px is None):
            raise ValueError(
                f"region {self.name!r} has {'neither' if self.floor_m is None else 'both'} of floor_m and picture_px; "
                "expected one of them: at least three corners [x, y]."
            )
        if abs(polygon_area(self.corners)) < 1e-9:
            raise ValueError(
                f"region {self.name!r} has the corners {list(self.corners)}; expected at least three that are not on a line."
            )
        if not 0 <= self.min_confidence <= 1:
            raise ValueError(f"min_confidence is {self.min_confidence}; expected a value from 0 to 1.")
        for name in ("inside_s", "outside_s"):
            if not 0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 0 s.")

    @property
    def corners(self) -> tuple[Point, ...]:
        """The corners, in metres or in pixels."""
        return (self.floor_m if self.floor_m is not None else self.picture_px) or ()

    def holds(self, box_px: Sequence[float] | None, centre_m: Sequence[float] | None, up: Vector) -> bool:
        """Whether a detected tag is in the polygon: its box x0 y0 x1 y1 and its place in the camera frame, where known."""
        if self.floor_m is None:
            return box_px is not None and in_polygon(_middle(box_px), self.corners)
        return centre_m is not None and in_polygon(floor_place(centre_m, up), self.corners)


def _middle(box_px: Sequence[float]) -> Point:
    x0, y0, x1, y1 = box_px
    return 0.5 * (x0 + x1), 0.5 * (y0 + y1)


def polygon_area(corners: Sequence[Point]) -> float:
    """The signed area of a polygon (the shoelace formula); 0 for fewer than three corners. NaN counts as 0."""
    pairs = zip(corners, [*corners[1:], *corners[:1]], strict=True)
    area = 0.5 * sum(x0 * y1 - x1 * y0 for (x0, y0), (x1, y1) in pairs)
    return area if math.isfinite(area) else 0.0


def in_polygon(point: Point, corners: Sequence[Point]) -> bool:
    """Whether a point is inside of a polygon, by the number of edges that a ray to the right crosses (even-odd rule).

    Of polygons that share an edge a point on it is in exactly one. A point that is not finite is in none.
    """
    x, y = point
    if not (math.isfinite(x) and math.isfinite(y)):
        return False
    inside = False
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], *corners[:1]], strict=True):
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) / (y1 - y0) * (x1 - x0):
            inside = not inside
    return inside


def floor_axes(up: Vector) -> tuple[Vector, Vector]:
    """The directions right and forward along the floor, camera frame; `up` is the floor's normal there.

    Right is the camera's x made level. Forward is normal to both: where a level camera looks, and the upper edge of the
    picture of a camera that looks down. Raises `ValueError` where up has no length or is the direction of the picture's rows.
    """
    length = math.sqrt(sum(one * one for one in up))
    if not (math.isfinite(length) and length > 1e-6):
        raise ValueError(f"up is {list(up)}; expected a direction in the camera frame, [0, -1, 0] for a level camera.")
    a, b, c = (one / length for one in up)
    level = 1.0 - a * a
    if level < 1e-3:
        raise ValueError(f"up is {list(up)}, along the picture's rows; expected another direction. Turn the camera.")
    norm = math.sqrt(level)
    right = (level / norm, -a * b / norm, -a * c / norm)
    forward = (b * right[2] - c * right[1], c * right[0] - a * right[2], a * right[1] - b * right[0])
    return right, forward


def floor_place(point_m: Sequence[float], up: Vector) -> Point:
    """How far to the right of the camera and how far before it a point of the camera frame is, along the floor, metres."""
    right, forward = floor_axes(up)
    return sum(p * r for p, r in zip(point_m, right, strict=True)), sum(
        p * f for p, f in zip(point_m, forward, strict=True)
    )
