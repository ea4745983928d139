"""Several walkers on one floor: way points, distances to each other and to furniture, in and out through a door."""

from __future__ import annotations

import dataclasses

import numpy as np

Rectangle = tuple[float, float, float, float]
"""x0, y0, x1, y1 on the floor, m."""


@dataclasses.dataclass(frozen=True)
class Door:
    """A door: its opening, and places behind it that the camera does not see, the one farthest from the door first."""

    opening_m: tuple[float, float]
    outside_m: tuple[tuple[float, float], ...]


BODY_RADIUS_M = 0.28
"""Kept free between a walker's centre and furniture."""

_BRAKE = 0.45  # fraction of the acceleration bound planned for braking; the remainder is for turning and evading
_MARGIN_M = 0.12  # planned in addition to the minimum distance


def distance_to(rectangle: Rectangle, place: np.ndarray) -> tuple[np.ndarray | np.floating, np.ndarray]:
    """Distance (...) of places (..., 2) to a rectangle, 0 inside, and the vectors (..., 2) to its nearest points."""
    low, high = np.array(rectangle[:2]), np.array(rectangle[2:])
    toward = np.clip(place, low, high) - place
    return np.linalg.norm(toward, axis=-1), toward


def _to_all(obstacles: tuple[Rectangle, ...], place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vectors (..., num, 2) to the nearest points of all rectangles and distances (..., num), from places (..., 2)."""
    box = np.asarray(obstacles)
    toward = np.clip(place[..., None, :], box[:, :2], box[:, 2:]) - place[..., None, :]
    return toward, np.hypot(toward[..., 0], toward[..., 1])


def is_free(place: np.ndarray, area: Rectangle, obstacles: tuple[Rectangle, ...], radius: float) -> bool:
    """Whether a place (2,) lies in the area, at least `radius` from every obstacle."""
    inside = bool(np.all(place >= area[:2]) and np.all(place <= area[2:]))
    return inside and (not obstacles or bool(_to_all(obstacles, place)[1].min() >= radius))


class _Walker:
    """State of one walker: position, velocity, goals, speed, waiting time, and whether it is behind the door."""

    def __init__(self, place: np.ndarray, speed: float):
        self.place, self.velocity = place, np.zeros(2)
        self.goals: list[np.ndarray] = []
        self.speed, self.wait, self.stuck = speed, 0.0, 0.0
        self.through_door = False  # then the area's limits do not apply
        self.enter_s = self.leave_s = np.inf
        self.home = place
        self.inner: _Walker | None = None  # the person farther inside, who has to be back first
        self.outer: _Walker | None = None  # the person nearer to the door, who has to go first

    def is_home(self) -> bool:
        """Whether the walker is back behind the door and stays there."""
        return self.through_door and not self.goals and bool(np.hypot(*(self.home - self.place)) < 0.3)


def simulate(
    num: int,
    steps: int,
    step_s: float,
    rng: np.random.Generator,
    area: Rectangle,
    obstacles: tuple[Rectangle, ...],
    speed_m_s: tuple[float, float],
    min_distance_m: float,
    door: Door | None,
    num_door: int,
    stop_probability: float,
    acceleration: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Places and velocities (steps, num, 2). See `tagjax.sim.motion.random_walks`."""
    walkers = _start(num, rng, area, obstacles, min_distance_m, door, num_door, steps * step_s, speed_m_s)
    place, velocity = np.zeros((steps, num, 2)), np.zeros((steps, num, 2))
    for step in range(steps):
        now = step * step_s
        for i, walker in enumerate(walkers):
            place[step, i], velocity[step, i] = walker.place, walker.velocity
        # All decide on the positions at the start of this step, so the order of walkers does not matter.
        for i, walker in enumerate(walkers):
            _choose_goal(walker, now, step_s, rng, area, obstacles, speed_m_s, door, stop_probability)
            wanted = _desired_velocity(walker, acceleration)
            wanted = _evade(wanted, i, place[step], min_distance_m)
            normals, limits = _limits(i, walker, place[step], area, obstacles, min_distance_m, acceleration)
            allowed = _project_to_limits(wanted, normals, limits)
            change = allowed - walker.velocity
            size = float(np.hypot(*change))
            walker.velocity = walker.velocity + change * min(1.0, acceleration * step_s / max(size, 1e-12))
            asked = float(np.hypot(*wanted))
            slow = asked > 0.2 and float(np.hypot(*walker.velocity)) < 0.25 * asked
            walker.stuck = walker.stuck + step_s if slow else 0.0
        for walker in walkers:
            walker.place = walker.place + walker.velocity * step_s
    return place, velocity


def _start(num, rng, area, obstacles, min_distance, door, num_door, duration, speeds) -> list[_Walker]:
    walkers: list[_Walker] = []
    apart = min_distance + 2 * _MARGIN_M
    for number in range(num):
        speed = rng.uniform(*speeds)
        if door is not None and number < num_door:
            walker = _Walker(np.array(door.outside_m[number], float), speed)
            walker.through_door = True
            walker.enter_s = (rng.uniform(0.02, 0.1) + 0.1 * (num_door - 1 - number)) * duration
            walker.leave_s = (rng.uniform(0.45, 0.55) + 0.1 * number) * duration
            if walkers:
                walker.inner, walkers[-1].outer = walkers[-1], walker
            walkers.append(walker)
            continue
        for _ in range(2000):
            place = np.array([rng.uniform(area[0], area[2]), rng.uniform(area[1], area[3])])
            free = is_free(place, area, obstacles, BODY_RADIUS_M + 0.05)
            if free and all(np.hypot(*(place - other.place)) > apart for other in walkers):
                walkers.append(_Walker(place, speed))
                break
        else:
            raise ValueError(
                f"No free place for walker {number + 1} of {num} at {min_distance} m from the others in {area}; ask for "
                "fewer walkers, less furniture or a larger area."
            )
    return walkers


def _choose_goal(walker, now, step_s, rng, area, obstacles, speeds, door, stop_probability) -> None:
    """Set the next way point when the last one is reached or given up, or when it is time for the door."""
    if door is not None and now >= walker.enter_s and (walker.outer is None or not walker.outer.through_door):
        walker.enter_s = np.inf
        walker.goals = [np.array(door.opening_m), _free_place(rng, np.array(door.opening_m), area, obstacles)]
    leaves = door is not None and now >= walker.leave_s and not walker.through_door
    if door is not None and leaves and (walker.inner is None or walker.inner.is_home()):
        # The opening may lie behind furniture: then walk first to a place with a straight way to it.
        opening = np.array(door.opening_m)
        if is_walkable(walker.place, opening, obstacles):
            walker.leave_s, walker.through_door, walker.wait = np.inf, True, 0.0
            walker.goals = [opening, walker.home]
            walker.speed = speeds[1]
        elif not walker.goals or not is_walkable(walker.goals[0], opening, obstacles):
            places = (_free_place(rng, walker.place, area, obstacles) for _ in range(6))
            seen = [place for place in places if is_walkable(place, opening, obstacles)]
            if seen:
                walker.goals, walker.wait, walker.speed = seen[:1], 0.0, speeds[1]
    if walker.goals:
        near = 0.12 if walker.through_door and len(walker.goals) == 1 else 0.35
        if np.hypot(*(walker.goals[0] - walker.place)) < near or (walker.stuck > 1.5 and not walker.through_door):
            walker.goals.pop(0)
            walker.stuck = 0.0
            if not walker.goals and rng.random() < stop_probability:
                walker.wait = rng.uniform(0.5, 2.0)
    at_home = walker.through_door and np.hypot(*(walker.home - walker.place)) < 0.3
    coming_in = np.isfinite(walker.leave_s) and not np.isfinite(walker.enter_s)
    if walker.through_door and coming_in and len(walker.goals) < 2:
        walker.through_door = not is_free(walker.place, area, obstacles, 0.0)
    if not walker.goals and walker.wait <= 0 and not at_home:
        walker.goals = [_free_place(rng, walker.place, area, obstacles)]
        walker.speed = rng.uniform(*speeds)
    walker.wait = max(0.0, walker.wait - step_s)


def is_walkable(start: np.ndarray, end: np.ndarray, obstacles: tuple[Rectangle, ...]) -> bool:
    """Whether a straight walk is free of obstacles, sampled every 0.1 m."""
    count = int(np.hypot(*(end - start)) / 0.1) + 2
    line = start + np.linspace(0, 1, count)[:, None] * (end - start)
    return not obstacles or bool(_to_all(obstacles, line)[1].min() >= BODY_RADIUS_M)


def _free_place(rng, start: np.ndarray, area: Rectangle, obstacles: tuple[Rectangle, ...]) -> np.ndarray:
    """A random free place with a straight way from `start`: the farther of two, so that walks are not all short."""
    best, best_length = start, -1.0
    found = 0
    for _ in range(40):
        place = np.array([rng.uniform(area[0], area[2]), rng.uniform(area[1], area[3])])
        if is_free(place, area, obstacles, BODY_RADIUS_M + 0.05) and is_walkable(start, place, obstacles):
            length = float(np.hypot(*(place - start)))
            if length > best_length:
                best, best_length = place, length
            found += 1
            if found == 2:
                break
    return best


def _desired_velocity(walker: _Walker, acceleration: float) -> np.ndarray:
    """Desired velocity towards the goal, with braking in time."""
    if walker.wait > 0 or not walker.goals:
        return np.zeros(2)
    toward = walker.goals[0] - walker.place
    distance = float(np.hypot(*toward))
    brake = np.sqrt(2 * 0.4 * acceleration * max(distance, 0.0))
    return toward / max(distance, 1e-6) * min(walker.speed, max(brake, 0.05))


def _evade(wanted: np.ndarray, i: int, places: np.ndarray, min_distance: float) -> np.ndarray:
    """Turn to the right of people ahead, more strongly the nearer they are."""
    pace = float(np.hypot(*wanted))
    if pace < 0.05:
        return wanted
    out = wanted
    for j, other in enumerate(places):
        toward = other - places[i]
        distance = float(np.hypot(*toward))
        ahead = float(toward @ wanted) / max(pace * distance, 1e-9)
        if j != i and ahead > 0.3 and distance < min_distance + 1.5:
            right = np.array([wanted[1], -wanted[0]])
            out = out + right * ahead * (1.0 - (distance - min_distance) / 1.5) * 1.2
    return out * (pace / max(float(np.hypot(*out)), 1e-9))


def _limits(i, walker, places, area, obstacles, min_distance, acceleration) -> tuple[np.ndarray, np.ndarray]:
    """Half planes normal . velocity <= limit within which braking in time is possible, whatever the others do."""
    brake = _BRAKE * acceleration
    normals, gaps = [], []
    for j, other in enumerate(places):
        if j != i:
            toward = other - places[i]
            distance = float(np.hypot(*toward))
            # Each of the two may use half of the gap.
            normals.append(toward / max(distance, 1e-9))
            gaps.append((distance - min_distance - _MARGIN_M) / 2)
    if obstacles:
        toward, distance = _to_all(obstacles, places[i])
        near = (distance > 1e-9) & (distance < 2.0)
        normals.extend(toward[near] / distance[near, None])
        gaps.extend(distance[near] - BODY_RADIUS_M)
    if not walker.through_door:
        for normal, gap in (
            ((1.0, 0.0), area[2] - places[i][0]),
            ((-1.0, 0.0), places[i][0] - area[0]),
            ((0.0, 1.0), area[3] - places[i][1]),
            ((0.0, -1.0), places[i][1] - area[1]),
        ):
            normals.append(np.array(normal))
            gaps.append(gap)
    if not normals:
        return np.zeros((0, 2)), np.zeros(0)
    # Closer than allowed: move away slowly.
    gap = np.array(gaps)
    return np.array(normals), np.where(gap > 0, np.sqrt(2 * brake * np.maximum(gap, 0)), 1.5 * np.maximum(gap, -0.2))


def _project_to_limits(wanted: np.ndarray, normals: np.ndarray, limits: np.ndarray) -> np.ndarray:
    """A velocity within all half planes near the desired one: projected onto each, then scaled down (zero is within all)."""
    velocity = wanted
    for _ in range(4):
        excess = normals @ velocity - limits
        worst = int(np.argmax(excess)) if len(excess) else -1
        if worst < 0 or excess[worst] <= 1e-9:
            return velocity
        velocity = velocity - excess[worst] * normals[worst]
    along = normals @ velocity
    over = (along > np.maximum(limits, 0)) & (along > 1e-9)
    return velocity * float(np.min(np.maximum(limits[over], 0) / along[over], initial=1.0))
