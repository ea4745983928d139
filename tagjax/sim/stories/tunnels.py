"""Tunnels over the tracks of trains on a table, placed so that each train is visible in a given number of intervals."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Sequence

import numpy as np

from ..rendering.visibility import intervals, visible_fraction
from ..world.bodies import STEP_S, Body, Material, Poses, Shape, World, rotation_matrix
from ..world.furniture import Table
from ..world.objects import bounds
from ..world.rotation import turn_about
from .builder import UP

SEEN_S = 0.5
HIDDEN_S = 0.4
"""Minimum length of visible and hidden intervals: several frames and several reads."""

_HEIGHT_M = 0.16  # inner height; the tallest train has 0.13 m
_WALL_M = 0.006
_GAP_M = 0.012  # between a train and a tunnel's wall
_MAX_WIDTH_M = 0.2
_TRIES = 400
_STEPS_APART = 5  # steps between visibility checks; a train moves by 25 mm at most
_ROOF = Material((0.35, 0.3, 0.28), "speckle", 30.0, 0.3, transmission_db=1.0)


@dataclasses.dataclass(frozen=True)
class _Plan:
    """A tunnel's centre on the table, direction, and inner half length and half width."""

    middle: np.ndarray  # (2,)
    yaw: float
    half_m: tuple[float, float]

    def local(self, places: np.ndarray) -> np.ndarray:
        """Positions (..., 2) in the tunnel's frame: along and across."""
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        away = places - self.middle
        return np.stack([c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]], axis=-1)

    def corners(self, gap: float = 0.0) -> np.ndarray:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        a, b = self.half_m[0] + gap, self.half_m[1] + gap
        return self.middle + np.array([(x * c - y * s, x * s + y * c) for x in (-a, a) for y in (-b, b)])

    def meets(self, other: _Plan) -> bool:
        """Whether two rectangles on the table overlap (separating axes)."""
        for one, two in ((self, other), (other, self)):
            reach = one.local(two.corners(_WALL_M + _GAP_M))
            if np.any(reach.min(axis=0) > one.half_m) or np.any(reach.max(axis=0) < -np.array(one.half_m)):
                return False
        return True

    def body(self, floor_m: float) -> Body:
        """Two walls and a roof, open at both ends."""
        long, wide = self.half_m
        shapes = [Shape("box", (long, wide + _WALL_M, _WALL_M / 2), _ROOF, (0.0, 0.0, _HEIGHT_M + _WALL_M / 2))]
        for side in (-1.0, 1.0):
            place = (0.0, side * (wide + _WALL_M / 2), _HEIGHT_M / 2)
            shapes.append(Shape("box", (long, _WALL_M / 2, _HEIGHT_M / 2), _ROOF, place))
        pose = Poses.fixed((*self.middle, floor_m), turn_about(UP, self.yaw))
        return Body("tunnel", tuple(shapes), pose, "furniture")


def tunnels(
    trains: Sequence[Body],
    table: Table,
    num_traces: int,
    camera_m: Sequence[float],
    steps: int,
    rng: np.random.Generator,
) -> list[Body]:
    """Tunnels that hide every train `num_traces` - 1 times; it is visible at the first and the last step.

    Visible intervals last at least `SEEN_S`, hidden ones at least `HIDDEN_S`. Raises `ValueError` where no draw meets
    that: the tracks are too short, or the traces too many.
    """
    if num_traces < 1:
        raise ValueError(f"num_traces is {num_traces}; expected at least 1.")
    found: list[_Plan] = []
    sampled = np.unique(np.append(np.arange(0, steps, _STEPS_APART), steps - 1))
    outlines = [_outline(train)[sampled] for train in trains]
    for number, train in enumerate(trains):
        for _ in range(_TRIES):
            mine = _draw(outlines, number, table, found, num_traces, rng)
            covers = [plan.body(table.height_m) for plan in (*found, *(mine or ()))]
            if mine is not None and _has_traces(train, covers, num_traces, camera_m, sampled):
                found += mine
                break
        else:
            raise ValueError(
                f"No positions for tunnels that leave train {number + 1} {num_traces} traces in "
                f"{(steps - 1) * STEP_S:.1f} s; give more time or speed, or ask for fewer traces."
            )
    bodies = [plan.body(table.height_m) for plan in found]
    for number, train in enumerate(trains):
        # The tunnels of a later train may hide an earlier one.
        if not _has_traces(train, bodies, num_traces, camera_m, sampled):
            raise ValueError(f"The tunnels of other trains hide train {number + 1}; try another seed.")
    return bodies


def _outline(train: Body) -> np.ndarray:
    """Corners (steps, 4, 2) of a train's outline on the table."""
    low, high = bounds(train.shapes)
    corners = np.array([(x, y, 0.0) for x in (low[0], high[0]) for y in (low[1], high[1])])
    turn = rotation_matrix(train.poses.quaternion)
    return (train.poses.position_m[:, None] + np.einsum("tij,pj->tpi", turn, corners))[..., :2]


def _draw(outlines, number, table, taken, num_traces, rng) -> list[_Plan] | None:
    """Up to `num_traces` - 1 tunnels that the train passes at well separated times; None if one does not fit."""
    line = outlines[number].mean(axis=1)
    train_m = float(np.linalg.norm(outlines[number][0, 2] - outlines[number][0, 0]))
    between_s = _STEPS_APART * STEP_S
    margin = round((SEEN_S + HIDDEN_S) / between_s)
    count = int(rng.integers(1, num_traces)) if num_traces > 1 else 0
    edges = np.linspace(margin, len(line) - margin, count + 1)
    if edges[-1] <= edges[0]:
        return None
    plans: list[_Plan] = []
    for first, last in itertools.pairwise(edges):
        at = int(rng.uniform(first, last))
        if not 0 < at < len(line) - 1:
            return None
        ahead = line[at + 1] - line[at - 1]
        pace = float(np.linalg.norm(ahead)) / (2 * between_s)
        long = 0.5 * (train_m + rng.uniform(1.4, 2.2) * HIDDEN_S * max(pace, 0.2)) + 0.02
        plan = _narrowest(line[at], float(np.arctan2(ahead[1], ahead[0])), long, outlines[number])
        if plan is None or not _fits(plan, outlines, number, table):
            return None
        if any(plan.meets(other) for other in (*taken, *plans)):
            return None
        plans.append(plan)
    # A fast check before lines of sight are computed: how often is the whole train inside?
    under = np.zeros(len(outlines[number]), bool)
    for plan in plans:
        under |= np.all(np.abs(plan.local(outlines[number])) < plan.half_m, axis=(1, 2))
    return plans if len(intervals(under)) == num_traces - 1 else None


def _narrowest(place: np.ndarray, yaw: float, long: float, outline: np.ndarray) -> _Plan | None:
    """The narrowest tunnel of a half length at a position of the track that the train passes without touching it."""
    plan = _Plan(place, yaw, (long, _MAX_WIDTH_M))
    corners = plan.local(outline)
    within = np.any(np.abs(corners[..., 0]) < long + 0.01, axis=1) & np.all(np.abs(corners[..., 1]) < 0.3, axis=1)
    if not within.any():
        return None
    low, high = corners[within][..., 1].min(), corners[within][..., 1].max()
    wide = (high - low) / 2 + _GAP_M
    middle = place + 0.5 * (low + high) * np.array([-np.sin(yaw), np.cos(yaw)])
    return _Plan(middle, yaw, (long, float(wide))) if wide <= _MAX_WIDTH_M else None


def _fits(plan: _Plan, outlines: Sequence[np.ndarray], number: int, table: Table) -> bool:
    """Whether a tunnel is on the table, no train touches its walls, and only its own train goes through."""
    x0, y0, x1, y1 = table.top_m
    corners = plan.corners(_WALL_M)
    if np.any(corners < [x0, y0]) or np.any(corners > [x1, y1]):
        return False
    long, wide = plan.half_m
    for other, outline in enumerate(outlines):
        along, across = np.moveaxis(plan.local(outline), -1, 0)
        beside = (np.abs(along).min(axis=1) > long + _GAP_M) & (np.ptp(np.sign(along), axis=1) == 0)
        outside = (np.abs(across).min(axis=1) > wide + _WALL_M + _GAP_M) & (np.ptp(np.sign(across), axis=1) == 0)
        through = np.abs(across).max(axis=1) < wide - _GAP_M / 2
        if not np.all(beside | outside | (through & (other == number))):
            return False
    return True


def _has_traces(train: Body, covers: Sequence[Body], num_traces: int, camera_m, sampled: np.ndarray) -> bool:
    """Whether a train is visible in exactly `num_traces` intervals, all long enough, and at the start and the end."""
    scene = World((train, *covers), (), int(sampled[-1]) + 1, (1.0, 1.0, 1.0))
    seen = visible_fraction(scene, (0,), camera_m, sampled) > 0
    if not (seen[0] and seen[-1]):
        return False
    shown, hidden = (np.diff(intervals(flag), axis=1) * _STEPS_APART * STEP_S for flag in (seen, ~seen))
    return len(shown) == num_traces and bool(shown.min() >= SEEN_S and hidden.min(initial=np.inf) >= HIDDEN_S)
