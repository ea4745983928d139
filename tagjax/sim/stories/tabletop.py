"""Stories of objects that move over a table."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from ..world.bodies import STEP_S, Poses
from ..world.objects import make_object
from ..world.rooms import make_room
from ..world.rotation import turn_about
from ..world.trajectory import path_through
from .builder import UP, ScenarioBuilder, with_length
from .scenario import Scenario
from .tunnels import tunnels


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
) -> Scenario:
    """Toy trains on a table top of 1.5 x 3 m, seen from the ceiling.

    `tracks`: "loops" (rounded closed tracks, one each), "parallel" (straight lines `spacing_m` apart, the same motion),
    "ranges" (straight lines from below the antenna to either side, with ranges that differ by `spacing_m` at all times),
    "curves" (open curves over the table). Tunnels hide every train so that it is visible in `num_traces` separate
    intervals. `antenna`: "ceiling" is beside the camera, "side" at the table's edge and height.
    """
    if tracks not in ("loops", "parallel", "curves", "ranges"):
        raise ValueError(f"tracks is {tracks!r}; expected loops, parallel, curves or ranges.")
    if antenna not in ("ceiling", "side"):
        raise ValueError(f"antenna is {antenna!r}; expected ceiling or side.")
    builder = ScenarioBuilder(make_room("ceiling_view", rng), duration_s)
    table = builder.room.tables[0]
    time_s = np.arange(builder.steps) * STEP_S
    pace = (speed_m_s[0], speed_m_s[1])
    if tracks == "ranges":
        models = [make_object(kind, rng) for _ in range(num_objects)]
        for model, poses in zip(
            models, _trains_at_range_offset(models, builder, time_s, rng, pace, spacing_m), strict=True
        ):
            builder.object(model, poses)
    else:
        for line in _track_lines(tracks, num_objects, table.top_m, time_s, rng, pace, spacing_m):
            model = make_object(kind, rng)
            velocity = np.gradient(line, axis=0)
            yaw = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
            z = np.full(builder.steps, table.height_m + model.half_size_m[2])
            builder.object(model, Poses(np.column_stack([line, z]), turn_about(UP, yaw)))
    if num_traces != 1:
        trains = [builder.bodies[tag.body] for tag in builder.tags]
        builder.bodies += tunnels(trains, table, num_traces, builder.room.camera_position_m, builder.steps, rng)
    scenario = builder.scenario(f"{num_objects} trains on {tracks}")
    if antenna == "side":
        place = (table.top_m[2] + 0.4, float(rng.uniform(-0.4, 0.4)), table.height_m + 0.1)
        scenario = dataclasses.replace(scenario, antennas_m=(place,))
    return scenario


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
            # Ovals beside each other along the table, one for each train.
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


def _trains_at_range_offset(models, builder, time_s, rng, speed_m_s, spacing_m) -> list[Poses]:
    """Trains that move back and forth on straight lines to either side of the point below the antenna.

    The ranges of their tags differ by `spacing_m` at all times.
    """
    if len(models) > 2:
        raise ValueError(f"{len(models)} trains on tracks of different ranges; expected at most 2, one to either side.")
    table, (x, y, antenna_up_m) = builder.room.tables[0], builder.room.antennas_m[0]
    near, far = 0.15, 0.6
    swing = (far - near) / 2
    out = near + swing + swing * np.sin(rng.uniform(*speed_m_s) / swing * time_s + rng.uniform(0, 2 * np.pi))
    range_m, poses = None, []
    for model, side in zip(models, rng.permutation([-1.0, 1.0]), strict=False):
        up = table.height_m + model.half_size_m[2]
        below = antenna_up_m - up - model.tag_m[2]
        if range_m is not None:
            out = np.sqrt((range_m + spacing_m) ** 2 - below**2)
        range_m = np.hypot(below, out)
        # Heading outward, x ahead: position of the centre when the tag is at x, y + side * out.
        line = np.stack([x + side * model.tag_m[1] + 0 * out, y + side * (out - model.tag_m[0])], axis=-1)
        if np.any(line[:, 1] < table.top_m[1] + 0.12) or np.any(line[:, 1] > table.top_m[3] - 0.12):
            raise ValueError(
                f"Tracks that differ by {spacing_m} m in range leave the table; ask for a smaller spacing_m."
            )
        turned = turn_about(UP, np.full(len(time_s), side * np.pi / 2))
        poses.append(Poses(np.column_stack([line, np.full(len(time_s), up)]), turned))
    return poses


_TRIES = 100
_APART_M = 0.27  # between the centres of two objects: more than the largest ball's diameter


def _curve(low: np.ndarray, high: np.ndarray, steps: int, rng, speed_m_s) -> np.ndarray:
    """A path (steps, 2) through random points of a rectangle."""
    points = [np.array([*rng.uniform(low, high), 0.0])]
    while len(points) < 12:
        point = np.array([*rng.uniform(low, high), 0.0])
        if np.linalg.norm(point - points[-1]) > 0.5:
            points.append(point)
    path = path_through(points, speed_m_s=rng.uniform(*speed_m_s), max_acceleration_m_s2=1.0)[:, :2]
    return np.clip(with_length(path, steps), low - 0.1, high + 0.1)
