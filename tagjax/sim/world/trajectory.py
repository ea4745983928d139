"""Smooth paths in space with bounded acceleration: through points, waving hands, pauses. Sampled every `STEP_S`.

Second differences of a sampled path are averages of its acceleration, so a bound on the motion bounds the samples too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline

from .bodies import STEP_S

Path = Float[np.ndarray, "_ 3"]
WaveKind = Literal["line", "circle", "eight", "random"]

_FINE = 200  # geometric samples between two way points


def max_speed(path_m: Float[np.ndarray, "steps dims"], step_s: float = STEP_S) -> float:
    """Largest speed between samples, m/s; 0 for fewer than two samples."""
    return float(np.linalg.norm(np.diff(path_m, axis=0), axis=-1).max(initial=0.0)) / step_s


def max_acceleration(path_m: Float[np.ndarray, "steps dims"], step_s: float = STEP_S) -> float:
    """Largest second difference of the samples, m/s^2; 0 for fewer than three samples."""
    return float(np.linalg.norm(np.diff(path_m, n=2, axis=0), axis=-1).max(initial=0.0)) / step_s**2


def num_steps(duration_s: float) -> int:
    """Number of samples of a motion of that duration, both ends included."""
    return round(duration_s / STEP_S) + 1


def smooth_step(fraction: np.ndarray) -> np.ndarray:
    """0 to 1 while `fraction` goes from 0 to 1, first and second derivative zero at both ends."""
    x = np.clip(np.asarray(fraction, float), 0.0, 1.0)
    return x * x * x * (10.0 + x * (6.0 * x - 15.0))


def stay_at(point_m: Sequence | np.ndarray, duration_s: float) -> Path:
    """A path that stays at a point."""
    return np.repeat(np.asarray(point_m, float)[None], num_steps(duration_s), axis=0)


def join(*paths_m: Path) -> Path:
    """Concatenate paths. Each must start where the previous one ends; that sample is kept once.

    Raises `ValueError` where the ends are more than 1 mm apart. The speed should be zero there, or the acceleration
    is unbounded: check it with `max_acceleration`.
    """
    parts = [paths_m[0]]
    for number, path in enumerate(paths_m[1:], 1):
        gap = float(np.linalg.norm(path[0] - parts[-1][-1]))
        if gap > 1e-3:
            raise ValueError(
                f"Path {number} starts {gap:.3f} m from the end of the previous one; expected at most 0.001 m."
            )
        parts.append(path[1:])
    return np.concatenate(parts)


def wait_then_move(path_m: Path, wait_s: float, duration_s: float | None = None) -> Path:
    """Stay at the start of `path_m` for `wait_s`, follow the path, and stay at its end until `duration_s`, if given.

    Raises `ValueError` if the path does not fit into `duration_s`.
    """
    moved = join(stay_at(path_m[0], wait_s), path_m)
    if duration_s is None:
        return moved
    left = num_steps(duration_s) - len(moved)
    if left < 0:
        raise ValueError(
            f"Wait and path take {(len(moved) - 1) * STEP_S:.2f} s; expected at most duration_s, {duration_s} s. "
            "Shorten the wait or the path, or move faster."
        )
    return np.concatenate([moved, np.repeat(moved[-1:], left, axis=0)])


def blend(first_m: Path, second_m: Path, start_s: float, duration_s: float = 0.5) -> Path:
    """Blend smoothly from one path into another of equal length, from `start_s` to `start_s + duration_s`."""
    time_s = np.arange(len(first_m)) * STEP_S
    fraction = smooth_step((time_s - start_s) / max(duration_s, STEP_S))[:, None]
    return first_m * (1 - fraction) + second_m * fraction


def path_through(
    points_m: Sequence | np.ndarray,
    *,
    speed_m_s: float | None = None,
    times_s: Sequence | np.ndarray | None = None,
    max_acceleration_m_s2: float = 3.0,
) -> Path:
    """A smooth curve through points (num_points, 3), with zero speed at both ends.

    With `speed_m_s`: as fast as the acceleration bound allows, never above that speed. Long straight parts reach it,
    bends are slower. With `times_s` (num_points,), from 0 on: passes each point at its time. Give one of the two.

    Raises `ValueError` for fewer than two points, repeated points, or times that need more acceleration.
    """
    points = np.asarray(points_m, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.all(np.isfinite(points)):
        raise ValueError(f"A path needs two or more finite points (num_points, 3); found shape {points.shape}.")
    if (speed_m_s is None) == (times_s is None):
        raise ValueError("Give either speed_m_s or times_s.")
    if times_s is not None:
        return _timed(points, np.asarray(times_s, float), max_acceleration_m_s2)
    assert speed_m_s is not None
    if speed_m_s <= 0 or max_acceleration_m_s2 <= 0:
        raise ValueError(f"Speed {speed_m_s} m/s and acceleration {max_acceleration_m_s2} m/s^2 must be positive.")
    chord = np.linalg.norm(np.diff(points, axis=0), axis=-1)
    if chord.min() < 1e-6:
        raise ValueError("Two consecutive way points are the same; use `stay_at` and `join` for stops.")
    knots = np.concatenate([[0.0], np.cumsum(chord)])
    curve = CubicSpline(knots, points, bc_type="natural")
    place = curve(np.interp(np.linspace(0, len(chord), _FINE * len(chord) + 1), np.arange(len(knots)), knots))
    # By arc length, so that its second derivative is the curvature and speed along it is speed.
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=-1))])
    curve = CubicSpline(length, place)
    push = 1.0
    while True:
        path = _run_along(curve, length, speed_m_s, push * max_acceleration_m_s2)
        # A bend narrower than the fine samples exceeds the bound a little: lower the bound.
        if max_acceleration(path) <= max_acceleration_m_s2 or push < 0.05:
            return path
        push *= 0.85


def _run_along(curve: CubicSpline, length: np.ndarray, speed: float, acceleration: float) -> np.ndarray:
    """Samples of the fastest motion along a curve (by arc length) within the bounds, with zero speed at both ends."""
    # 0.6 sideways and 0.75 along combine to 0.96: the margin covers the sampling of the curve.
    sideways, along = 0.6 * acceleration, 0.75 * acceleration
    ds = np.diff(length)
    square = np.minimum(speed**2, sideways / np.maximum(np.linalg.norm(curve(length, 2), axis=-1), 1e-9))
    square[0] = square[-1] = 0.0
    for i in range(len(ds)):
        square[i + 1] = min(square[i + 1], square[i] + 2 * along * ds[i])
    for i in reversed(range(len(ds))):
        square[i] = min(square[i], square[i + 1] + 2 * along * ds[i])
    pace = np.sqrt(square)
    time = np.concatenate([[0.0], np.cumsum(2 * ds / np.maximum(pace[1:] + pace[:-1], 1e-9))])
    sample = np.arange(int(np.ceil(time[-1] / STEP_S)) + 1) * STEP_S
    # Between two fine points the acceleration along the curve is constant: exact positions, not linear in time.
    leg = np.clip(np.searchsorted(time, sample, side="right") - 1, 0, len(ds) - 1)
    into = np.clip(sample - time[leg], 0.0, np.diff(time)[leg])
    push = (square[1:] - square[:-1])[leg] / (2 * ds[leg])
    return curve(length[leg] + np.clip(pace[leg] * into + 0.5 * push * into**2, 0.0, ds[leg]))


def _timed(points: np.ndarray, times: np.ndarray, acceleration: float) -> np.ndarray:
    if times.shape != (len(points),) or times[0] != 0 or np.any(np.diff(times) <= 0):
        raise ValueError(f"times_s must be {len(points)} increasing times from 0; found {times}.")
    # A quintic between two points; a cubic spline with zero end speeds through more.
    if len(points) == 2:
        fraction = smooth_step(np.arange(num_steps(times[-1])) * STEP_S / times[-1])[:, None]
        path = points[0] * (1 - fraction) + points[1] * fraction
    else:
        path = CubicSpline(times, points, bc_type="clamped")(np.arange(num_steps(times[-1])) * STEP_S)
    found = max_acceleration(path)
    if found > acceleration * (1 + 1e-6):
        longer = float(np.sqrt(found / acceleration))
        raise ValueError(
            f"These times need {found:.1f} m/s^2; expected at most {acceleration} m/s^2. Multiply them by {longer:.2f}."
        )
    return path


def wave(
    kind: WaveKind,
    centre_m: Sequence | np.ndarray,
    duration_s: float,
    *,
    peak_speed_m_s: float,
    amplitude_m: float | None = None,
    max_acceleration_m_s2: float = 12.0,
    direction: Sequence | np.ndarray = (0.0, 1.0, 0.0),
    across: Sequence | np.ndarray = (0.0, 0.0, 1.0),
    rng: np.random.Generator | None = None,
) -> Path:
    """A hand's motion about a centre, with exactly the given peak speed and zero speed at the centre at both ends.

    `line` swings along `direction`; `circle` and `eight` lie in the plane of `direction` and `across`; `random` is a
    sum of slow sinusoids in all three axes (needs `rng`). Amplitude is the largest distance from the centre; None takes
    the smallest one within the acceleration bound, at least 0.15 m. Raises `ValueError` if speed, amplitude, duration
    and acceleration are incompatible.
    """
    if peak_speed_m_s <= 0 or duration_s < 0.5:
        raise ValueError(
            f"A wave of {peak_speed_m_s} m/s for {duration_s} s; expected a positive speed and at least 0.5 s."
        )
    if kind == "random" and rng is None:
        raise ValueError("A random wave needs a random generator; give rng.")
    steps = num_steps(duration_s)
    shape = _wave_shape(kind, np.asarray(direction, float), np.asarray(across, float), rng)
    reach = amplitude_m or max(0.15, 0.8 * peak_speed_m_s**2 / max_acceleration_m_s2)
    found = np.inf
    for _ in range(60):
        path = _wave_of_reach(shape, steps, peak_speed_m_s, reach)
        found = max_acceleration(path)
        if found <= max_acceleration_m_s2:
            return np.asarray(centre_m, float) + path
        if amplitude_m is not None:
            break
        reach *= 1.08
    raise ValueError(
        f"A {kind} at {peak_speed_m_s} m/s within {reach:.2f} m needs {found:.1f} m/s^2; expected at most "
        f"{max_acceleration_m_s2} m/s^2. Lower the speed, or allow more amplitude or time."
    )


def _wave_shape(
    kind: WaveKind, direction: np.ndarray, across: np.ndarray, rng: np.random.Generator | None
) -> Callable[[np.ndarray], np.ndarray]:
    """Curve of unit amplitude as a function of phase (rad): phases (steps,) to offsets (steps, 3)."""
    along = direction / np.linalg.norm(direction)
    side = across - (across @ along) * along
    side = side / np.linalg.norm(side)
    if kind == "line":
        return lambda phase: np.sin(phase)[:, None] * along
    if kind == "circle":
        return lambda phase: np.cos(phase)[:, None] * along + np.sin(phase)[:, None] * side
    if kind == "eight":
        return lambda phase: np.sin(phase)[:, None] * along + 0.5 * np.sin(2 * phase)[:, None] * side
    assert rng is not None
    pace = rng.uniform(0.35, 1.3, (4, 3))
    start = rng.uniform(0, 2 * np.pi, (4, 3))
    size = rng.uniform(0.5, 1.0, (4, 3))
    return lambda phase: np.sum(size * np.sin(phase[:, None, None] * pace + start), axis=1) / 2.5


def _wave_of_reach(shape, steps: int, speed: float, reach: float) -> np.ndarray:
    """The wave with approximately that amplitude and exactly that peak speed."""
    time = np.arange(steps) * STEP_S
    duration = time[-1]
    ramp = min(0.4 * duration, 2.0)
    envelope = smooth_step(time / ramp) * smooth_step((duration - time) / ramp)
    rate = speed / reach
    path = np.zeros((steps, 3))
    for _ in range(8):
        path = envelope[:, None] * shape(rate * time)
        path = path * (speed / max(max_speed(path), 1e-9))
        size = float(np.linalg.norm(path, axis=-1).max())
        if abs(size / reach - 1) < 0.03:
            break
        rate *= size / reach  # too wide: swing at a higher rate
    return path
