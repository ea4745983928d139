"""Walls and pieces of furniture: each is a body with the rectangle of the floor that it occupies."""

from __future__ import annotations

import dataclasses

import numpy as np

from .bodies import METAL_REFLECTION, Body, Material, Poses, Role, Shape
from .crowd import Rectangle, distance_to
from .rotation import turn_about

WALL_REFLECTION = -0.5


@dataclasses.dataclass(frozen=True)
class Panel:
    """A flat reflector for the radio: centre, unit normal, unit direction along it, half sizes along and across."""

    centre_m: tuple[float, float, float]
    normal: tuple[float, float, float]
    along: tuple[float, float, float]
    half_size_m: tuple[float, float]
    reflection: float


@dataclasses.dataclass(frozen=True)
class Table:
    """A table's or shelf's top: rectangle on the floor plan, and height."""

    top_m: Rectangle
    height_m: float


@dataclasses.dataclass
class Plan:
    """The contents of a room while it is being furnished."""

    bodies: list[Body] = dataclasses.field(default_factory=list)
    obstacles: list[Rectangle] = dataclasses.field(default_factory=list)
    tables: list[Table] = dataclasses.field(default_factory=list)
    panels: list[Panel] = dataclasses.field(default_factory=list)

    def is_free(self, rectangle: Rectangle, gap: float = 0.05) -> bool:
        """Whether a rectangle is at least `gap` from everything that stands on the floor."""
        x0, y0, x1, y1 = rectangle
        return all(x0 - gap > b[2] or x1 + gap < b[0] or y0 - gap > b[3] or y1 + gap < b[1] for b in self.obstacles)

    def block(self, name: str, low, high, material: Material, role: Role = "room", *, solid: bool = True) -> None:
        """Add a box between two corners; `solid` ones are obstacles for walkers."""
        low, high = np.asarray(low, float), np.asarray(high, float)
        half = (high - low) / 2
        shape = Shape("box", (float(half[0]), float(half[1]), float(half[2])), material)
        self.bodies.append(Body(name, (shape,), Poses.fixed((low + high) / 2), role))
        if solid:
            self.obstacles.append((float(low[0]), float(low[1]), float(high[0]), float(high[1])))


def surface(rng: np.random.Generator, low: float, high: float, **settings) -> Material:
    """A muted colour of brightness between two limits, with a random texture unless one is given."""
    grey = rng.uniform(low, high)
    colour = np.clip(grey + rng.uniform(-0.12, 0.12, 3) * grey * 2, 0.02, 0.95)
    settings.setdefault("texture", str(rng.choice(["noise", "speckle", "plain", "stripes"], p=[0.5, 0.2, 0.2, 0.1])))
    settings.setdefault("scale", float(rng.uniform(2, 8)))
    settings.setdefault("contrast", 0.04 if settings["texture"] == "plain" else float(rng.uniform(0.1, 0.35)))
    return Material((float(colour[0]), float(colour[1]), float(colour[2])), seed=int(rng.integers(2**31)), **settings)


def metal(rng: np.random.Generator) -> Material:
    """Painted sheet steel: blocks and reflects radio waves."""
    return surface(
        rng, 0.15, 0.7, texture="noise", scale=3.0, contrast=0.08, shine=float(rng.uniform(0.3, 0.8)),
        transmission_db=30.0, reflection=METAL_REFLECTION,
    )  # fmt: skip


def walls(plan: Plan, rng: np.random.Generator, size) -> None:
    """Floor, ceiling, far wall and both sides of a room (x 0 to length, y centred), 0.1 m thick, outside it.

    There is no near wall: the camera is there.
    """
    length, width, height = size
    wall = surface(rng, 0.45, 0.85, scale=float(rng.uniform(1, 3)), reflection=WALL_REFLECTION, transmission_db=12.0)
    floor = surface(
        rng, 0.2, 0.6, texture=str(rng.choice(["noise", "checker", "speckle", "stripes"])),
        scale=float(rng.uniform(2, 6)), contrast=float(rng.uniform(0.1, 0.35)), reflection=WALL_REFLECTION,
    )  # fmt: skip
    w = width / 2
    plan.block("floor", (-0.8, -w - 0.1, -0.1), (length + 0.1, w + 0.1, 0.0), floor, solid=False)
    plan.block("far wall", (length, -w - 0.1, 0), (length + 0.1, w + 0.1, height), wall, solid=False)
    for side, name in ((-1, "right wall"), (1, "left wall")):
        low, high = sorted((side * w, side * (w + 0.1)))
        plan.block(name, (-0.8, low, 0), (length, high, height), wall, solid=False)
    white = surface(rng, 0.7, 0.9, texture="speckle", scale=5.0, contrast=0.06, transmission_db=12.0)
    plan.block("ceiling", (-0.8, -w, height), (length, w, height + 0.1), white, solid=False)
    far, mid = length, (length - 0.8) / 2
    plan.panels += [
        Panel((far, 0.0, height / 2), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (w, height / 2), WALL_REFLECTION),
        Panel((mid, w, height / 2), (0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (far / 2 + 0.4, height / 2), WALL_REFLECTION),
        Panel((mid, -w, height / 2), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (far / 2 + 0.4, height / 2), WALL_REFLECTION),
        Panel((mid, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (far / 2 + 0.4, w), WALL_REFLECTION),
        Panel((mid, 0.0, height), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0), (far / 2 + 0.4, w), WALL_REFLECTION),
    ]


def doorway(
    plan: Plan, rng: np.random.Generator, size, x: float, y: float, *, wide: float = 1.1, tall: float = 2.05
) -> None:
    """A wall across a room at `x` with a door opening at `y`, frame and open door leaf; a dark corridor lies behind it.

    The corridor extends from the wall to the far end of the room, over the whole width.
    """
    length, width, height = size
    w, thick, hinge = width / 2, 0.1, 1.0 if y < 0 else -1.0
    wall = surface(rng, 0.45, 0.85, scale=float(rng.uniform(1, 3)), reflection=WALL_REFLECTION, transmission_db=6.0)
    wood = surface(rng, 0.15, 0.45, texture="stripes", scale=25.0, contrast=0.2, transmission_db=3.0)
    gloom = surface(rng, 0.04, 0.1, texture="noise", transmission_db=12.0, reflection=WALL_REFLECTION)
    for low, high in ((-w, y - wide / 2), (y + wide / 2, w)):
        plan.block("partition", (x, low, 0), (x + thick, high, height), wall)
        middle, half = (low + high) / 2, (high - low) / 2
        panel = Panel((x, middle, height / 2), (-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (half, height / 2), WALL_REFLECTION)
        plan.panels.append(panel)
    plan.block("lintel", (x, y - wide / 2, tall), (x + thick, y + wide / 2, height), wall, solid=False)
    trim = 0.05
    for side in (-1, 1):
        low, high = sorted((y + side * wide / 2, y + side * (wide / 2 + trim)))
        plan.block("door frame", (x - 0.015, low, 0), (x, high, tall + trim), wood, solid=False)
    low, high = y - wide / 2, y + wide / 2
    plan.block("door frame", (x - 0.015, low, tall), (x, high, tall + trim), wood, solid=False)
    # The door leaf is open, flat against the wall.
    low, high = sorted((y + hinge * (wide / 2 + trim), y + hinge * (1.5 * wide + trim)))
    plan.block("door leaf", (x - 0.055, low, 0.01), (x - 0.015, high, tall), wood, "furniture")
    end = y + hinge * (1.5 * wide + trim - 0.08)
    steel = Material((0.5, 0.5, 0.52), "plain", contrast=0.05, shine=0.6, transmission_db=2.0)
    plan.block("handle", (x - 0.11, end - 0.06, 1.0), (x - 0.055, end + 0.06, 1.03), steel, "furniture", solid=False)
    for name, lowest, highest in (
        ("corridor wall", (length - 0.02, -w, 0), (length, w, height)),
        ("corridor floor", (x + thick, -w, 0), (length, w, 0.004)),
        ("corridor ceiling", (x + thick, -w, height - 0.02), (length, w, height)),
    ):
        plan.block(name, lowest, highest, gloom, solid=False)


def pictures(plan: Plan, rng: np.random.Generator, size, num: int) -> None:
    """Flat pictures on the far and side walls, for texture above the furniture; a third of them are photographs."""
    length, width, _ = size
    for _ in range(num):
        a, b, z = rng.uniform(0.2, 0.6), rng.uniform(0.15, 0.4), rng.uniform(1.4, 1.8)
        skin = surface(
            rng,
            0.2,
            0.7,
            texture=str(rng.choice(["noise", "checker", "stripes"])),
            scale=float(rng.uniform(4, 14)),
            contrast=float(rng.uniform(0.4, 0.8)),
        )
        if skin.seed % 3 == 0:
            skin = dataclasses.replace(skin, texture="photo", photo="hopper", scale=2 * a, contrast=0.95, seed=0)
        if rng.random() < 0.5:
            y = rng.uniform(-width / 2 + 0.7, width / 2 - 0.7)
            plan.block("picture", (length - 0.02, y - a, z - b), (length, y + a, z + b), skin, solid=False)
        else:
            x, side = rng.uniform(1.5, length - 0.7), rng.choice([-1, 1])
            y0, y1 = sorted((side * (width / 2 - 0.02), side * width / 2))
            plan.block("picture", (x - a, y0, z - b), (x + a, y1, z + b), skin, solid=False)


def table(plan: Plan, rng: np.random.Generator, top: Rectangle, height: float = 0.74) -> None:
    """A table with four legs."""
    x0, y0, x1, y1 = top
    wood = surface(
        rng,
        0.25,
        0.7,
        texture=str(rng.choice(["stripes", "noise", "plain"])),
        scale=float(rng.uniform(6, 20)),
        contrast=0.2,
        shine=float(rng.uniform(0, 0.4)),
        transmission_db=3.0,
    )
    leg = surface(rng, 0.1, 0.5, texture="plain", transmission_db=3.0)
    cx, cy, hx, hy = (x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2
    shapes = [Shape("box", (hx, hy, 0.015), wood, (0.0, 0.0, height - 0.015))]
    for a in (-1, 1):
        for b in (-1, 1):
            foot = (a * (hx - 0.05), b * (hy - 0.05), (height - 0.03) / 2)
            shapes.append(Shape("box", (0.025, 0.025, (height - 0.03) / 2), leg, foot))
    plan.bodies.append(Body("table", tuple(shapes), Poses.fixed((cx, cy, 0.0)), "furniture"))
    plan.obstacles.append(top)
    plan.tables.append(Table(top, height))


def chair(plan: Plan, rng: np.random.Generator, place: tuple[float, float], turn_rad: float, cloth: Material) -> bool:
    """Add a chair if there is room for it; returns whether there was."""
    taken = (place[0] - 0.27, place[1] - 0.27, place[0] + 0.27, place[1] + 0.27)
    if not plan.is_free(taken, 0.0):
        return False
    steel = Material((0.15, 0.15, 0.16), "plain", contrast=0.05, shine=0.4, transmission_db=2.0, reflection=-0.2)
    shapes = [
        Shape("box", (0.22, 0.22, 0.03), cloth, (0.0, 0.0, 0.45)),
        Shape("box", (0.02, 0.21, 0.19), cloth, (-0.22, 0.0, 0.74)),
        Shape("box", (0.012, 0.03, 0.1), steel, (-0.23, 0.0, 0.52)),
    ]
    if rng.random() < 0.5:
        shapes.append(Shape("cylinder", (0.025, 0.19, 0.0), steel, (0.0, 0.0, 0.23)))
        shapes.append(Shape("cylinder", (0.2, 0.02, 0.0), steel, (0.0, 0.0, 0.03)))
    else:
        shapes += [
            Shape("box", (0.014, 0.014, 0.21), steel, (a * 0.19, b * 0.19, 0.21)) for a in (-1, 1) for b in (-1, 1)
        ]
    pose = Poses.fixed((*place, 0.0), turn_about((0.0, 0.0, 1.0), turn_rad))
    plan.bodies.append(Body("chair", tuple(shapes), pose, "furniture"))
    plan.obstacles.append(taken)
    return True


def cabinet(plan: Plan, rng: np.random.Generator, taken: Rectangle, height: float, front: tuple[float, float]) -> None:
    """A metal cabinet with drawers on the side given by `front` (an axis direction), which also reflects radio waves."""
    x0, y0, x1, y1 = taken
    skin = metal(rng)
    half = ((x1 - x0) / 2, (y1 - y0) / 2)
    middle = ((x0 + x1) / 2, (y0 + y1) / 2)
    across = abs(front[0]) > 0.5  # the front faces along x
    shapes = [Shape("box", (*half, height / 2), skin, (0.0, 0.0, height / 2))]
    num = max(2, round(height / 0.4))
    face = dataclasses.replace(skin, colour=(skin.colour[0] * 0.85, skin.colour[1] * 0.85, skin.colour[2] * 0.85))
    for drawer in range(num):
        z, tall = (drawer + 0.5) * height / num, 0.46 * height / num
        size = (0.006, half[1] * 0.94, tall) if across else (half[0] * 0.94, 0.006, tall)
        shapes.append(Shape("box", size, face, (front[0] * half[0], front[1] * half[1], z)))
    plan.bodies.append(Body("cabinet", tuple(shapes), Poses.fixed((*middle, 0.0)), "furniture"))
    plan.obstacles.append(taken)
    at = (middle[0] + front[0] * half[0], middle[1] + front[1] * half[1], height / 2)
    along, wide = ((0.0, 1.0, 0.0), half[1]) if across else ((1.0, 0.0, 0.0), half[0])
    plan.panels.append(Panel(at, (*front, 0.0), along, (wide, height / 2), METAL_REFLECTION))


def shelf(plan: Plan, rng: np.random.Generator, taken: Rectangle, height: float, levels: int) -> None:
    """A metal shelf with goods on its levels; objects can be placed on the boards."""
    x0, y0, x1, y1 = taken
    cx, cy, hx, hy = (x0 + x1) / 2, (y0 + y1) / 2, (x1 - x0) / 2, (y1 - y0) / 2
    board = metal(rng)
    shapes = [
        Shape("box", (0.015, 0.015, height / 2), board, (a * (hx - 0.015), b * (hy - 0.015), height / 2))
        for a in (-1, 1)
        for b in (-1, 1)
    ]
    for level in range(levels):
        z = 0.1 + level * (height - 0.15) / max(levels - 1, 1)
        shapes.append(Shape("box", (hx, hy, 0.012), board, (0.0, 0.0, z)))
        plan.tables.append(Table(taken, z + 0.012))
        at = -hx + 0.05
        while level < levels - 1 and at < hx - 0.2:
            wide, tall = rng.uniform(0.05, 0.14), rng.uniform(0.06, 0.15)
            if rng.random() < 0.75 and at + 2 * wide < hx - 0.03:
                goods = surface(rng, 0.1, 0.8, scale=float(rng.uniform(8, 30)), contrast=0.5, transmission_db=2.0)
                shapes.append(Shape("box", (wide, 0.7 * hy, tall), goods, (at + wide, 0.0, z + 0.012 + tall)))
            at += 2 * wide + rng.uniform(0.01, 0.12)
    plan.bodies.append(Body("shelf", tuple(shapes), Poses.fixed((cx, cy, 0.0)), "furniture"))
    plan.obstacles.append(taken)
    front = -1.0 if cy > 0 else 1.0
    at_front = (cx, cy + front * hy, height / 2)
    # A shelf is half open: it reflects half the field of a sheet.
    plan.panels.append(Panel(at_front, (0.0, front, 0.0), (1.0, 0.0, 0.0), (hx, height / 2), METAL_REFLECTION / 2))


def distance_to_nearest(obstacles: tuple[Rectangle, ...], place: np.ndarray) -> float:
    """Distance from a position (2,) to the nearest obstacle, 0 inside one; infinite without obstacles."""
    return min((float(distance_to(box, place)[0]) for box in obstacles), default=np.inf)
