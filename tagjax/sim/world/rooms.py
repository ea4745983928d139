"""Rooms for people and objects: meeting room, room with a door, hall, crowded office, ceiling view, shop.

World frame: x away from the camera's wall (0 to the length), y to the left (centred), z up. Every room is drawn at random.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .bodies import Body, Light
from .crowd import Door, Rectangle
from .furniture import (
    Panel,
    Plan,
    Table,
    cabinet,
    chair,
    distance_to_nearest,
    doorway,
    pictures,
    shelf,
    surface,
    table,
    walls,
)

Point = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Room:
    """A furnished room without people: its bodies, the walk area, and the positions of camera and antennas."""

    name: str
    bodies: tuple[Body, ...]
    size_m: Point  # length (x), width (y), height
    walk_area_m: Rectangle  # for walkers' centres
    obstacles_m: tuple[Rectangle, ...]  # furniture on the floor
    tables: tuple[Table, ...]  # surfaces for objects
    lights: tuple[Light, ...]
    camera_position_m: Point
    camera_look_at_m: Point
    antennas_m: tuple[Point, ...]
    panels: tuple[Panel, ...]  # walls, floor, ceiling and metal, for the radio
    door: Door | None = None
    ambient: float = 0.35
    antenna_axes: tuple[Point, ...] | None = None  # boresight of each, unit vectors; towards camera_look_at_m if None

    def free_place(self, rng: np.random.Generator, radius_m: float = 0.35) -> tuple[float, float]:
        """A random position in the walk area, `radius_m` from all furniture; `ValueError` if none is found."""
        x0, y0, x1, y1 = self.walk_area_m
        for _ in range(5000):
            place = np.array([rng.uniform(x0, x1), rng.uniform(y0, y1)])
            if distance_to_nearest(self.obstacles_m, place) >= radius_m:
                return float(place[0]), float(place[1])
        raise ValueError(f"No free position with {radius_m} m around it in the {self.name}; ask for a smaller radius.")


def make_room(name: str, rng: np.random.Generator) -> Room:
    """Draw a room of a kind of `ROOMS`. Raises `ValueError` for an unknown kind."""
    if name not in ROOMS:
        raise ValueError(f"room is {name!r}; expected one of {', '.join(ROOMS)}.")
    return ROOMS[name](rng)


def meeting_room(rng: np.random.Generator) -> Room:
    """About 6 x 5 m: a table and chairs at the far wall, a low cabinet, free floor, a partition that people can go behind."""
    size = _size(rng, (5.6, 6.4), (4.8, 5.6), (2.6, 3.0))
    length, width, _ = size
    plan = Plan()
    walls(plan, rng, size)
    pictures(plan, rng, size, int(rng.integers(2, 5)))
    side = -1 if rng.random() < 0.5 else 1
    door = _screen(plan, rng, size, side)
    deep, wide = rng.uniform(0.7, 0.9), rng.uniform(1.4, 1.9)
    y = -side * (width / 2 - wide / 2 - 0.3)
    top = (length - deep - 0.35, y - wide / 2, length - 0.35, y + wide / 2)
    table(plan, rng, top)
    cloth = surface(rng, 0.1, 0.6, scale=20.0)
    for fraction in (0.25, 0.75):
        chair(plan, rng, (top[0] - 0.32, top[1] + fraction * wide), rng.uniform(-0.3, 0.3), cloth)
    if rng.random() < 0.8:
        x = rng.uniform(1.6, 2.6)
        low, high = sorted((side * (width / 2 - 0.4), side * width / 2))
        cabinet(plan, rng, (x, low, x + rng.uniform(0.7, 1.1), high), rng.uniform(0.7, 1.1), (0.0, -float(side)))
    area = (1.4, -width / 2 + 0.45, length - 0.45, width / 2 - 0.45)
    return _room("meeting room", plan, rng, size, area, door)


def entrance(rng: np.random.Generator) -> Room:
    """A room of about 6 x 5 m whose far wall has an open door to a dark corridor; a table and chairs at one side."""
    deep = 1.5  # the corridor
    length, width, height = _size(rng, (5.4, 6.0), (4.8, 5.6), (2.6, 3.0))
    size = (length + deep, width, height)
    plan = Plan()
    walls(plan, rng, size)
    side = -1 if rng.random() < 0.5 else 1
    y = side * rng.uniform(0.3, 0.9)
    doorway(plan, rng, size, length, y)
    # The table stands on the other side, not in the way from the door.
    broad, wide = rng.uniform(0.7, 0.9), rng.uniform(1.2, 1.6)
    low, high = sorted((-side * (width / 2 - 0.1), -side * (width / 2 - 0.1 - broad)))
    x = rng.uniform(2.4, 2.9)
    table(plan, rng, (x, low, x + wide, high))
    cloth = surface(rng, 0.1, 0.6, scale=20.0)
    for fraction in (0.25, 0.75):
        place = (x + fraction * wide, -side * (width / 2 - 0.1 - broad - 0.3))
        chair(plan, rng, place, -side * np.pi / 2 + rng.uniform(-0.3, 0.3), cloth)
    if rng.random() < 0.6:
        x = rng.uniform(1.8, 2.8)
        low, high = sorted((side * (width / 2 - 0.4), side * width / 2))
        cabinet(plan, rng, (x, low, x + rng.uniform(0.7, 1.1), high), rng.uniform(0.7, 1.1), (0.0, -float(side)))
    area = (1.4, -width / 2 + 0.45, length - 0.45, width / 2 - 0.45)
    # Behind the wall on the side of the room's axis, where a camera on the axis cannot see.
    places = tuple((length + 0.1 + deep / 2, y - side * away) for away in (1.2, 1.95))
    room = _room("room with a door", plan, rng, size, area, Door((length + 0.05, y), places))
    lights = tuple(
        dataclasses.replace(light, position_m=(fraction * length, *light.position_m[1:]))
        for light, fraction in zip(room.lights, (0.3, 0.65), strict=True)
    )
    return dataclasses.replace(
        room, lights=lights, camera_look_at_m=(0.62 * length, 0.35 * y, room.camera_look_at_m[2])
    )


def hall(rng: np.random.Generator) -> Room:
    """About 7 x 6 m with furniture along the walls; the free floor between lies wholly in the camera's view."""
    size = _size(rng, (6.6, 7.2), (5.8, 6.4), (2.7, 3.0))
    length, width, _ = size
    plan = Plan()
    walls(plan, rng, size)
    pictures(plan, rng, size, int(rng.integers(3, 6)))
    cloth = surface(rng, 0.1, 0.6, scale=20.0)
    for side in (-1, 1):
        x = rng.uniform(1.8, 2.4)
        while x + 1.4 < length - 0.5:
            deep, wide = rng.uniform(0.4, 0.6), rng.uniform(0.9, 1.4)
            low, high = sorted((side * (width / 2 - 0.05), side * (width / 2 - 0.05 - deep)))
            if rng.random() < 0.5:
                table(plan, rng, (x, low, x + wide, high))
                place = (x + rng.uniform(0.3, 0.7) * wide, side * (width / 2 - deep - 0.36))
                chair(plan, rng, place, side * np.pi / 2 + rng.uniform(-0.3, 0.3), cloth)
            else:
                cabinet(plan, rng, (x, low, x + wide, high), rng.uniform(0.7, 1.8), (0.0, -float(side)))
            x += wide + rng.uniform(0.1, 0.8)
    y = rng.uniform(-1.6, 0.4)
    cabinet(plan, rng, (length - 0.45, y, length, y + rng.uniform(0.8, 1.3)), rng.uniform(0.8, 1.8), (-1.0, 0.0))
    room = _room("hall", plan, rng, size, (2.3, -1.3, 5.6, 1.3), None)
    return dataclasses.replace(
        room,
        camera_position_m=(-0.4, room.camera_position_m[1] / 3, float(rng.uniform(2.1, 2.4))),
        camera_look_at_m=(3.5, 0.0, float(rng.uniform(0.75, 0.95))),
    )


def office(rng: np.random.Generator) -> Room:
    """About 8 x 6 m and crowded: desks with chairs, cubicle walls, metal cabinets, aisles around and between them."""
    size = _size(rng, (7.4, 8.4), (5.8, 6.6), (2.6, 3.0))
    length, width, _ = size
    plan = Plan()
    walls(plan, rng, size)
    pictures(plan, rng, size, int(rng.integers(2, 5)))
    side = -1 if rng.random() < 0.5 else 1
    door = _screen(plan, rng, size, side)
    cloth = surface(rng, 0.1, 0.6, scale=20.0)
    partition = surface(rng, 0.2, 0.7, scale=12.0, contrast=0.3, transmission_db=3.0)
    # Desks along both sides, separated by cubicle walls, with chairs towards the aisle.
    for row in (-1, 1):
        x = rng.uniform(1.7, 2.1)
        end = length - (1.6 if row == side else 0.4)
        while x + 1.3 < end:
            deep, wide = rng.uniform(0.65, 0.8), rng.uniform(1.1, 1.4)
            low, high = sorted((row * (width / 2 - 0.05), row * (width / 2 - 0.05 - deep)))
            table(plan, rng, (x, low, x + wide, high))
            table_top = plan.tables[-1]
            _screens_and_things(plan, rng, table_top, row)
            chair(plan, rng, (x + wide / 2, row * (width / 2 - deep - 0.36)), -row * np.pi / 2 + np.pi, cloth)
            wall_end = row * (width / 2 - 0.05 - rng.uniform(0.9, 1.3))
            low, high = sorted((row * (width / 2 - 0.02), wall_end))
            tall = rng.uniform(1.1, 1.5)
            plan.block("cubicle wall", (x + wide + 0.05, low, 0), (x + wide + 0.09, high, tall), partition, "furniture")
            x += wide + 0.14
    # A table in the aisle leaves more than a walker's width on either side.
    x = rng.uniform(3.6, 4.4)
    if rng.random() < 0.7:
        table(plan, rng, (x, -0.35, x + rng.uniform(0.8, 1.2), 0.35))
        chair(plan, rng, (x - 0.3, rng.uniform(-0.1, 0.1)), 0.0, cloth)
    for _ in range(int(rng.integers(1, 4))):
        y = rng.uniform(-width / 2 + 1.7, width / 2 - 2.2)
        taken = (length - 0.45, y, length, y + rng.uniform(0.45, 0.9))
        if plan.is_free(taken) and not taken[1] - 0.5 < door.opening_m[1] < taken[3] + 0.5:
            cabinet(plan, rng, taken, rng.uniform(1.0, 1.9), (-1.0, 0.0))
    area = (1.3, -width / 2 + 0.45, length - 0.5, width / 2 - 0.45)
    return _room("office", plan, rng, size, area, door)


def ceiling_view(rng: np.random.Generator) -> Room:
    """A table top of 1.5 x 3 m seen from the ceiling, 2.4 to 2.8 m up, the antenna beside the camera."""
    size = _size(rng, (3.4, 3.9), (4.4, 5.0), (2.9, 3.2))
    length, width, height = size
    plan = Plan()
    walls(plan, rng, size)
    middle, top_z = length / 2, rng.uniform(0.35, 0.6)
    table(plan, rng, (middle - 0.75, -1.5, middle + 0.75, 1.5), top_z)
    lights = (Light((middle + rng.uniform(-0.8, 0.8), rng.uniform(-0.8, 0.8), height - 0.15), rng.uniform(0.9, 1.3)),)
    up = (middle, 0.0, min(height - 0.12, top_z + 2.6))
    return Room(
        name="ceiling view",
        bodies=tuple(plan.bodies),
        size_m=size,
        walk_area_m=(0.3, -width / 2 + 0.3, middle - 1.1, width / 2 - 0.3),
        obstacles_m=tuple(plan.obstacles),
        tables=tuple(plan.tables),
        lights=lights,
        camera_position_m=up,
        # One millimetre off straight down, so that the picture's up direction is the room's x.
        camera_look_at_m=(middle + 0.001, 0.0, top_z),
        antennas_m=((middle, 0.12, up[2]),),
        panels=tuple(plan.panels),
        ambient=float(rng.uniform(0.3, 0.45)),
    )


def shop_floor(rng: np.random.Generator) -> Room:
    """The exit area of a shop, 7 x 3 m: shelves along both sides, the camera over the exit, three ceiling antennas."""
    size = (7.0, 3.0, float(rng.uniform(2.7, 3.1)))
    length, width, height = size
    plan = Plan()
    walls(plan, rng, size)
    pictures(plan, rng, size, 2)
    for row in (-1, 1):
        x = rng.uniform(2.4, 3.0)
        while x + 0.9 < length - 0.1:
            long = rng.uniform(0.9, 1.4)
            deep = rng.uniform(0.28, 0.36)
            low, high = sorted((row * width / 2, row * (width / 2 - deep)))
            if x + long < length - 0.1 and rng.random() < 0.85:
                shelf(plan, rng, (x, low, x + long, high), rng.uniform(1.2, 1.8), int(rng.integers(3, 5)))
            x += long + rng.uniform(0.02, 0.2)
    antennas = tuple((x, 0.0, height - 0.1) for x in (1.4, 3.5, 5.6))
    room = _room("shop floor", plan, rng, size, (1.0, -width / 2 + 0.35, length - 0.4, width / 2 - 0.35), None)
    return dataclasses.replace(
        room,
        antennas_m=antennas,
        camera_position_m=(-0.4, 0.0, height - 0.3),
        antenna_axes=((0.0, 0.0, -1.0),) * 3,
    )


def _size(rng: np.random.Generator, *limits: tuple[float, float]) -> Point:
    length, width, height = (float(rng.uniform(*limit)) for limit in limits)
    return length, width, height


def _screen(plan: Plan, rng: np.random.Generator, size: Point, side: int) -> Door:
    """A partition in a far corner: people behind it are invisible to the camera but still inside the room."""
    length, width, height = size
    x, end = length - 1.15, side * (width / 2 - 1.75)
    low, high = sorted((side * width / 2, end))
    board = surface(rng, 0.35, 0.8, reflection=-0.4, transmission_db=6.0)
    plan.block("screen", (x - 0.05, low, 0), (x + 0.05, high, height), board)
    places = tuple((length - 0.5, side * (width / 2 - back)) for back in (0.4, 1.15))
    return Door(opening_m=(length - 0.55, end - side * 0.45), outside_m=places)


def _screens_and_things(plan: Plan, rng: np.random.Generator, desk: Table, row: int) -> None:
    """A monitor and a stack of paper on a desk."""
    x0, y0, x1, y1 = desk.top_m
    x, z = (x0 + x1) / 2 + rng.uniform(-0.2, 0.2), desk.height_m
    back = (y1 if row > 0 else y0) - row * 0.15
    dark = surface(rng, 0.03, 0.12, texture="plain", shine=0.7, transmission_db=8.0)
    plan.block(
        "monitor", (x - 0.26, back - 0.02, z + 0.12), (x + 0.26, back + 0.02, z + 0.44), dark, "furniture", solid=False
    )
    plan.block("stand", (x - 0.1, back - 0.05, z), (x + 0.1, back + 0.05, z + 0.12), dark, "furniture", solid=False)
    if rng.random() < 0.7:
        paper = surface(rng, 0.5, 0.9, transmission_db=2.0)
        px, py = rng.uniform(x0 + 0.1, x1 - 0.35), (y0 + y1) / 2 - row * 0.12
        plan.block(
            "paper",
            (px, py - 0.1, z),
            (px + 0.22, py + 0.1, z + rng.uniform(0.02, 0.12)),
            paper,
            "furniture",
            solid=False,
        )


def _room(name: str, plan: Plan, rng: np.random.Generator, size: Point, area: Rectangle, door: Door | None) -> Room:
    """A room seen from its near wall, lights at the ceiling; the antennas below the camera, left, right and above."""
    length, width, height = size
    lights = tuple(
        Light((fraction * length, float(rng.uniform(-0.25, 0.25)) * width, height - 0.15), float(rng.uniform(0.6, 1.0)))
        for fraction in (0.35, 0.75)
    )
    y = float(rng.uniform(-0.3, 0.3))
    camera = (-0.4, y, float(rng.uniform(1.9, 2.35)))
    return Room(
        name=name,
        bodies=tuple(plan.bodies),
        size_m=size,
        walk_area_m=area,
        obstacles_m=tuple(plan.obstacles),
        tables=tuple(plan.tables),
        lights=lights,
        camera_position_m=camera,
        camera_look_at_m=(0.55 * length, float(rng.uniform(-0.2, 0.2)), float(rng.uniform(0.75, 1.0))),
        antennas_m=((-0.3, y, 1.2), (-0.3, y + 0.8, 1.4), (-0.3, y - 0.8, 1.4), (-0.3, y, 2.4)),
        panels=tuple(plan.panels),
        door=door,
        ambient=float(rng.uniform(0.25, 0.45)),
    )


ROOMS: dict[str, Callable[[np.random.Generator], Room]] = {
    "meeting_room": meeting_room,
    "entrance": entrance,
    "hall": hall,
    "office": office,
    "ceiling_view": ceiling_view,
    "shop_floor": shop_floor,
}
