"""TagAttention as published in plain NumPy, loop by loop: what the JAX functions are compared with."""

from __future__ import annotations

import numpy as np


def nearest_source(forward_px: np.ndarray, range_m: np.ndarray) -> np.ndarray:
    """The flat index of the pixel that moves to each pixel; -1 for none."""
    height, width = range_m.shape
    source, nearest = np.full((height, width), -1), np.full((height, width), np.inf)
    for y in range(height):
        for x in range(width):
            if not range_m[y, x] > 0:
                continue
            column, row = int(np.round(x + forward_px[y, x, 0])), int(np.round(y + forward_px[y, x, 1]))
            if 0 <= column < width and 0 <= row < height and range_m[y, x] < nearest[row, column]:
                nearest[row, column], source[row, column] = range_m[y, x], y * width + x
    return source


def filled(source: np.ndarray, last_m: np.ndarray, range_m: np.ndarray, max_step_m: float) -> np.ndarray:
    """Holes filled from the pixel within 3 px that carries the range most like their own."""
    height, width = source.shape
    out = source.copy()
    order = sorted(
        ((dy, dx) for dy in range(-3, 4) for dx in range(-3, 4)), key=lambda at: (at[0] ** 2 + at[1] ** 2, at)
    )
    for y in range(height):
        for x in range(width):
            if source[y, x] >= 0 or not range_m[y, x] > 0:
                continue
            best = np.inf
            for dy, dx in order:
                if not (0 <= y + dy < height and 0 <= x + dx < width) or source[y + dy, x + dx] < 0:
                    continue
                gap = abs(last_m.reshape(-1)[source[y + dy, x + dx]] - range_m[y, x])
                if gap <= max_step_m and gap < best:
                    best, out[y, x] = gap, source[y + dy, x + dx]
    return out


def k_means(points: np.ndarray, valid: np.ndarray, centres: np.ndarray, num_iterations: int) -> np.ndarray:
    """Lloyd's algorithm; empty clusters stay."""
    centres = centres.astype(np.float64).copy()
    for _ in range(num_iterations):
        cluster = assign(points, centres)
        for number in range(len(centres)):
            own = points[(cluster == number) & valid]
            if len(own):
                centres[number] = own.mean(axis=0)
    return centres


def assign(points: np.ndarray, centres: np.ndarray) -> np.ndarray:
    """The nearest centre of each point."""
    return np.argmin(np.linalg.norm(points[:, None] - centres[None], axis=-1), axis=1)


def refined(mask: np.ndarray, cluster: np.ndarray, valid: np.ndarray, whole: float, part: float) -> np.ndarray:
    """The mask refined by clusters."""
    out = np.zeros_like(mask)
    for number in np.unique(cluster):
        own = (cluster == number) & valid
        if not own.any():
            continue
        fraction = np.mean(mask[own])
        if fraction >= whole:
            out |= own
        elif fraction >= part:
            out |= own & mask
    return out


def masked(
    log_likelihood: np.ndarray,
    valid: np.ndarray,
    cluster: np.ndarray,
    *,
    cut: float,
    lowest: float,
    whole: float,
    part: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The likelihood that is propagated, and the mask."""
    odds = np.exp(log_likelihood - log_likelihood[valid].max())
    least = odds[valid].min()
    if least == 1.0:
        return np.full(log_likelihood.shape, np.log(lowest)), np.zeros(valid.shape, bool)
    normal = np.where(valid, (odds - least) / (1 - least), 0.0)
    mask = refined((valid & (normal >= cut)).reshape(-1), cluster, valid.reshape(-1), whole, part).reshape(valid.shape)
    if mask.any():
        raised = normal.copy()
        for number in np.unique(cluster):
            own = mask & (cluster == number).reshape(mask.shape)
            if own.any():
                raised[own] = np.maximum(normal[own], normal[own].mean())
        normal = raised
    return np.log(np.maximum(normal, lowest)), mask


def unwrap_slots(
    time_s: np.ndarray, phase_rad: np.ndarray, carrier_hz: np.ndarray, channel: np.ndarray, *, slots: bool = True
) -> np.ndarray:
    """Relative distance at every read."""
    distance, out = 0.0, [0.0]
    velocities: list[float] = []
    begin, raw, accepted = (time_s[0], 0.0), None, 0.0
    for i in range(1, len(time_s)):
        gap = time_s[i] - time_s[i - 1]
        if channel[i] == channel[i - 1]:
            step = phase_rad[i] - phase_rad[i - 1]
            step = (step - np.pi * np.round(step / np.pi)) * 299_792_458.0 / (4 * np.pi * carrier_hz[i])
            distance += step
            if gap > 0:
                velocities.append(step / gap)
        elif velocities:
            distance += float(np.median(velocities[-5:])) * gap
        if time_s[i] - begin[0] >= 0.1:
            length = time_s[i] - begin[0]
            mean = (distance - begin[1]) / length
            if slots and raw is not None and abs(mean - raw) / length > 9.8:
                distance = begin[1] + accepted * length
            else:
                accepted = mean
            raw, begin = mean, (time_s[i], distance)
        out.append(distance)
    return np.array(out)


def published_distance(
    time_s: np.ndarray, distance_m: np.ndarray, query_s: np.ndarray, *, causal: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Quadratic fits around the queries, and whether the distance is known there."""
    values, known = np.zeros(len(query_s)), np.zeros(len(query_s), bool)
    for number, query in enumerate(query_s):
        for half in (0.07, 0.2):
            begin, end = (query - 2 * half, query) if causal else (query - half, query + half)
            inside = (time_s >= begin) & (time_s <= end)
            own = time_s[inside]
            near = len(own) and (own[-1] >= query - half if causal else own[0] <= query <= own[-1])
            if near and len(own) >= 4:
                values[number] = np.polyfit(own - query, distance_m[inside], 2)[-1]
                known[number] = True
                break
    return values, known
