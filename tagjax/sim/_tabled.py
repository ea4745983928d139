"""Stories of things that move over a table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ._rotation import turn_about
from ._stage_set import (
    UP,
    StageSet,
    fitted,
)
from ._tunnels import tunnels
from .motion import path_through
from .objects import make_object
from .record import Filmed
from .rooms import make_room
from .world import STEP_S, Poses


def tabletop(
    rng: np.random.Generator,
    duration_s: float,
    *,
    num_objects: int = 4,
    kind: str = "train",
    speed_m_s: Sequence[float] = (0.25, 0.5),
    tracks: str = "loops",
    num_traces: int = 1,
    spacing_m: float = 0.164,
    antenna: str = "ceiling",
) -> Filmed:
    """Toy trains on a table top of 1.5 x 3 m, seen from the ceiling.

    `tracks`: "loops" (rounded closed tracks, one each), "parallel" (straight lines `spacing_m` apart, the same motion),
    "ranges" (straight lines away from below the antenna, to either side, with distances to it that differ by `spacing_m`
    at all times), "curves" (open curves over the table). Tunnels hide every train so that the camera sees it
    `num_traces` times, each a stretch of its own. `antenna`: "ceiling" beside the camera, or "side", at the table's edge
    and height.
    """
    if tracks not in ("loops", "parallel", "curves", "ranges"):
        raise ValueError(f"tracks is {tracks!r}; expected loops, parallel, curves or ranges.")
    if antenna not in ("ceiling", "side"):
        raise ValueError(f"antenna is {antenna!r}; expected ceiling or side.")
    stage = StageSet(make_room("ceiling_view", rng), duration_s)
    table = stage.room.tables[0]
    time_s = np.arange(stage.steps) * STEP_S
    pace = (speed_m_s[0], speed_m_s[1])
    if tracks == "ranges":
        foot = np.array(stage.room.antennas_m[0]) - [0.0, 0.0, table.height_m + _TAG_UP_M]
        lines = _range_lines(num_objects, table.top_m, foot, time_s, rng, pace, spacing_m)
    else:
        lines = _track_lines(tracks, num_objects, table.top_m, time_s, rng, pace, spacing_m)
    for line in lines:
        model = make_object(kind, rng)
        velocity = np.gradient(line, axis=0)
        yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
        z = np.full(stage.steps, table.height_m + model.half_size_m[2])
        stage.object(model, Poses(np.column_stack([line, z]), turn_about(UP, yaw)))
    if num_traces != 1:
        trains = [stage.bodies[tag.body] for tag in stage.tags]
        stage.bodies += tunnels(trains, table, num_traces, stage.room.camera_position_m, stage.steps, rng)
    filmed = stage.filmed(f"{num_objects} trains on {tracks}")
    if antenna == "side":
        place = (table.top_m[2] + 0.4, float(rng.uniform(-0.4, 0.4)), table.height_m + 0.1)
        filmed = dataclasses.replace(filmed, antennas_m=(place,))
    return filmed


def _track_lines(kind, count, top_m, time_s, rng, speed_m_s, spacing_m) -> list[np.ndarray]:
    """Paths (steps, 2) on the table top."""
    x0, y0, x1, y1 = top_m
    middle = np.array([(x0 + x1) / 2, (y0 + y1) / 2])
    lines = []
    if kind == "parallel":
        pace = rng.uniform(*speed_m_s)
        swing = 0.5 * (y1 - y0) - 0.25
        along = swing * np.sin(pace / swing * time_s + rng.uniform(-0.5, 0.5))
        for number in range(count):
            across = (number - (count - 1) / 2) * spacing_m
            lines.append(np.stack([np.full_like(along, middle[0] + across), middle[1] + along], axis=-1))
        return lines
    for number in range(count):
        if kind == "loops":
            # Tracks beside each other along the table, each with its own oval.
            span = (y1 - y0) / count
            centre = np.array([middle[0], y0 + span * (number + 0.5)])
            radius = np.array([rng.uniform(0.3, 0.55), span / 2 - 0.13])
            if min(radius) < 0.08:
                raise ValueError(f"{count} loops do not fit a table of {y1 - y0:.1f} m; ask for fewer.")
            turn = rng.choice([-1, 1]) * rng.uniform(*speed_m_s) / np.mean(radius)
            angle = rng.uniform(0, 2 * np.pi) + turn * time_s
            lines.append(centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=-1))
        else:
            low, high = np.array([x0 + 0.15, y0 + 0.15]), np.array([x1 - 0.15, y1 - 0.15])
            for _ in range(_TRIES):
                path = _curve(low, high, len(time_s), rng, speed_m_s)
                if all(np.linalg.norm(path - other, axis=1).min() >= _APART_M for other in lines):
                    lines.append(path)
                    break
            else:
                raise ValueError(f"{count} curves do not keep {_APART_M} m apart on the table; ask for fewer.")
    return lines


def _range_lines(count, top_m, antenna_m, time_s, rng, speed_m_s, spacing_m) -> list[np.ndarray]:
    """Paths (steps, 2) along the table from the antenna's foot; `antenna_m` is x, y and the height above the tags."""
    if count > 2:
        raise ValueError(f"{count} trains on tracks of different ranges; there is room for 2, one to either side.")
    x, y, height = antenna_m
    near, far = 0.15, 0.6
    pace = rng.uniform(*speed_m_s)
    swing = (far - near) / 2
    first = near + swing + swing * np.sin(pace / swing * time_s + rng.uniform(0, 2 * np.pi))
    longer = np.hypot(height, first) + spacing_m
    paths = [first, np.sqrt(longer**2 - height**2)][:count]
    sides = rng.permutation([-1.0, 1.0])
    lines = [
        np.stack([np.full_like(path, x), y + side * path], axis=-1) for path, side in zip(paths, sides, strict=False)
    ]
    if any(np.any(line[:, 1] < top_m[1] + 0.12) or np.any(line[:, 1] > top_m[3] - 0.12) for line in lines):
        raise ValueError(f"Tracks that differ by {spacing_m} m in range leave the table; ask for less.")
    return lines


_TAG_UP_M = 0.15  # of a tag on a train, above the table
_TRIES = 100
_APART_M = 0.27  # between the middles of two things: no ball is wider


def _curve(low: np.ndarray, high: np.ndarray, steps: int, rng, speed_m_s) -> np.ndarray:
    """A path (steps, 2) through random points of a rectangle."""
    points = [np.array([*rng.uniform(low, high), 0.0])]
    while len(points) < 12:
        point = np.array([*rng.uniform(low, high), 0.0])
        if np.linalg.norm(point - points[-1]) > 0.5:
            points.append(point)
    path = path_through(points, speed_m_s=rng.uniform(*speed_m_s), max_acceleration_m_s2=1.0)[:, :2]
    return np.clip(fitted(path, steps), low - 0.1, high + 0.1)
