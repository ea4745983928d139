"""The three steps on segments in plain NumPy and float64, pixel by pixel: what the JAX functions are compared with."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from tagjax.tagattention.segments.carry import next_dither

BACKGROUND = {
    "confirm_s": 1.5,
    "early_s": 0.3,
    "still_m_s": 0.03,
    "constant_m": 0.004,
    "quadratic": 0.004,
    "reveal_s": 0.08,
}


def surface(depth: np.ndarray) -> np.ndarray:
    """Pixels with at least two of four neighbours within 2 %."""
    height, width = depth.shape
    near = np.zeros(depth.shape, int)
    for y in range(height):
        for x in range(width):
            for v, u in ((y - 1, x), (y + 1, x), (y, x - 1), (y, x + 1)):
                if 0 <= v < height and 0 <= u < width and abs(depth[v, u] - depth[y, x]) < 0.02 * depth[y, x]:
                    near[y, x] += 1
    return (depth > 0) & (near >= 2)


class Memory:
    """The background model: one list of facts a pixel."""

    def __init__(self, height: int, width: int) -> None:
        self.pixels = [
            {"c": 0.0, "n": 0, "age": 0.0, "b": 0.0, "rested": 0.0, "deeper": 0.0} for _ in range(height * width)
        ]
        self.shape, self.started = (height, width), False

    def step(self, depth: np.ndarray, valid: np.ndarray, flow: np.ndarray, dt: float, focal: float) -> dict:
        s = BACKGROUND
        out = {name: np.zeros(self.shape, bool) for name in ("confirmed", "matched", "still", "front", "early", "ripe")}
        age = np.zeros(self.shape)
        for i, p in enumerate(self.pixels):
            at = np.unravel_index(i, self.shape)
            z, ok = float(depth[at]), bool(valid[at])
            tolerance = s["constant_m"] + s["quadratic"] * z * z
            still = float(np.hypot(*flow[at].astype(float))) * z < s["still_m_s"] * focal * dt
            matched = ok and abs(z - p["c"]) < tolerance
            if ok and p["rested"] > 0 and p["rested"] + tolerance < z < 2 * p["rested"] + 1:
                p["rested"] = 0.0
            if matched and still:
                p["n"] = min(p["n"] + 1, 100)
                p["c"] += (z - p["c"]) / p["n"]
                p["age"] += dt
                wait = s["confirm_s"] * (10 if p["b"] > 0 and p["c"] < p["b"] - tolerance else 1)
                if p["age"] >= wait:
                    p["b"] = p["c"]
                if p["age"] > s["early_s"]:
                    p["rested"] = max(p["rested"], p["c"])
            elif ok and not matched:
                p.update(n=1, c=z, age=0.0 if self.started else s["early_s"])
            if ok:
                behind = p["b"] > 0 and p["b"] + tolerance < z < 2 * p["b"] + 1
                p["deeper"] = p["deeper"] + dt if behind else 0.0
            if p["deeper"] > max(s["reveal_s"], 1.5 * dt):
                p["b"] = 0.0
            out["confirmed"][at] = ok and p["b"] > 0 and abs(z - p["b"]) < tolerance
            out["front"][at] = ok and (p["rested"] == 0 or z < p["rested"] - 2 * tolerance)
            out["matched"][at], out["still"][at], age[at] = matched, still, p["age"]
            out["early"][at], out["ripe"][at] = p["age"] >= s["early_s"], p["age"] >= s["confirm_s"]
        self.started |= bool(valid.any())
        return {**out, "age_s": age}


def carried(labels, last, depth, valid, flow, max_change, dither):
    """The label at the rounded end of each pixel's flow and dither, where the depth is nearly the same."""
    most = np.array([depth.shape[0] - 1, depth.shape[1] - 1])
    out = np.full(depth.shape, -1)
    for y, x in np.argwhere(valid):
        end = np.array([y, x], np.float32) + flow[y, x, ::-1]
        if (end < 0).any() or (end > most).any():
            continue
        at = tuple(np.clip(np.rint(end + dither[::-1]), 0, most).astype(int))
        if last[at] > 0 and abs(depth[y, x] - last[at]) < max_change:
            out[y, x] = labels[at]
    return out


def reassigned(labels, feature, side, foreground, reach):
    """Each pixel's nearest centre among the nine labels around it."""
    height, width = labels.shape
    centre = {k: feature[labels == k].mean(axis=0) for k in np.unique(labels[labels > 0])}
    out = np.full(labels.shape, -1)
    for y, x in np.argwhere(foreground):
        step, best = int(np.rint(side[y, x])), reach
        for dy in (0, -step, step):
            for dx in (0, -step, step):
                if not (0 <= y + dy < height and 0 <= x + dx < width) or labels[y + dy, x + dx] <= 0:
                    continue
                other = labels[y + dy, x + dx]
                away = np.sum((feature[y, x] - centre[other]) ** 2) / side[y, x] ** 2
                away -= 0.05 if other == labels[y, x] else 0.0
                if away < best:
                    best, out[y, x] = away, other
    return out


def _winner(labels, weights):
    votes: dict[int, int] = {}
    for label, weight in zip(labels, weights, strict=True):
        votes[int(label)] = votes.get(int(label), 0) + int(weight)
    most = max(votes.values())
    return min(label for label, number in votes.items() if number == most), most


def born(hole, side, carried_labels, free, min_side_px, min_pixels):
    """Slots of the holes' cells, each slot's source, and how many cells found none."""
    height, width = hole.shape
    big, found = 2 * min_side_px, []
    for pass_coarse in (True, False):
        for y in range(0, height, big if pass_coarse else min_side_px):
            for x in range(0, width, big if pass_coarse else min_side_px):
                top, left = y // big * big, x // big * big
                block = np.zeros(hole.shape, bool)
                block[top : top + big, left : left + big] = True
                block &= hole
                coarse = bool(block.any()) and side[block].mean() >= 1.5 * min_side_px
                if coarse != pass_coarse:
                    continue
                quarters = []
                for v in (top, top + min_side_px) if coarse else (y,):
                    for u in (left, left + min_side_px) if coarse else (x,):
                        part = np.zeros(hole.shape, bool)
                        part[v : v + min_side_px, u : u + min_side_px] = True
                        if (part & hole).any():
                            quarters.append(part & hole)
                if sum(part.sum() for part in quarters) <= min_pixels:
                    continue
                each = [_winner(carried_labels[part], np.ones(part.sum())) for part in quarters]
                found.append((np.any(quarters, axis=0), _winner(*zip(*each, strict=True))[0]))
    out, source = np.full(hole.shape, -1), np.full(len(free), -2)
    slots = np.flatnonzero(free)
    for slot, (cell, cause) in zip(slots, found, strict=False):
        out[cell], source[slot] = slot, cause
    return out, source, max(len(found) - len(slots), 0)


class Labels:
    """Persistent segments; `settings` are a `Segmenter`'s."""

    def __init__(self, settings, height: int, width: int) -> None:
        self.s, num = settings, settings.num_segments
        self.labels, self.depth = np.full((height, width), -1), np.zeros((height, width))
        self.dither = np.zeros(2, np.float32)
        self.life, self.moved, self.displacement = np.zeros(num), np.zeros(num, bool), np.zeros((num, 3))

    def step(self, rays, depth, valid, flow, view, dt, focal):
        s, (height, width) = self.s, depth.shape
        source_label = carried(self.labels, self.depth, depth, valid, flow, 0.02 + s.max_speed_m_s * dt, self.dither)
        self.dither = np.asarray(next_dither(jnp.asarray(self.dither)))
        static = np.zeros(depth.shape, bool)
        for at in map(tuple, np.argwhere(valid)):
            label = source_label[at]
            moved, older = label > 0 and self.moved[label], view["age_s"][at] > (self.life[label] if label > 0 else 0)
            seen = view["matched"][at] and view["still"][at]
            static[at] = (
                (view["confirmed"][at] and (label <= 0 or not view["matched"][at] or older or not moved))
                or (seen and view["early"][at] and label <= 0)
                or (seen and view["ripe"][at] and not moved)
            )
        foreground, first = valid & ~static, not (self.labels >= 0).any()
        safe = np.where(depth > 0, depth, 1.0)
        side = np.clip(s.side_m * focal / safe, s.min_side_px, s.max_side_px)
        y, x = np.mgrid[:height, :width]
        feature = np.stack([x, y, s.depth_weight * focal * np.log(safe)], axis=-1).astype(float)
        kept = np.where(static | (source_label == 0), -1, source_label)
        if first:
            start = s.start_side(height, width)
            labels = np.where(foreground, y // start * -(-width // start) + x // start + 1, -1)
            for _ in range(3):
                labels = reassigned(labels, feature, np.full(depth.shape, float(start)), foreground, s.reach)
        else:
            labels = reassigned(kept, feature, side, foreground, s.reach)
        number = np.bincount(labels[labels > 0], minlength=s.num_segments)
        free = number < s.min_pixels
        free[0] = False
        labels = np.where((labels > 0) & ~free[np.maximum(labels, 0)], labels, -1)
        source, missing = np.full(s.num_segments, -2), 0
        if first:
            source[1:][~free[1:]] = -1
        else:
            new, source, missing = born(
                foreground & (labels < 0), side, source_label, free, s.min_side_px, s.min_pixels
            )
            labels = np.where(new > 0, new, labels)
        is_new = source > -2
        counted = (labels > 0) & ((labels == kept) | (is_new[np.maximum(labels, 0)] & (source_label >= 0)))
        labels = np.where(valid & static, 0, labels)
        area = np.bincount(labels[labels >= 0], minlength=s.num_segments)
        lives = (area > 0) & ~is_new
        self.life = np.where(lives, self.life + dt, 0.0)
        self.displacement[~lives], self.moved = 0.0, self.moved & lives
        self.labels, self.depth, self.lives, self.area = labels, depth, lives, area
        return counted, source, missing

    def displaced(self, motion):
        self.displacement += np.where(self.lives[:, None], motion, 0.0)
        self.moved |= self.lives & (np.linalg.norm(self.displacement, axis=1) > self.s.moved_m)


def motion(rays, antennas, labels, counted, depth, last, flow, max_change, num_segments):
    """Mean change of range (antenna, segment) and of place (segment, 3), and where it is known."""
    height, width = depth.shape
    pixel = np.array([rays[0, 1, 0] - rays[0, 0, 0], rays[1, 0, 1] - rays[0, 0, 1]])
    changes = [[] for _ in range(num_segments)]
    for y, x in np.argwhere(counted & (depth > 0) & (labels > 0)):
        u, v = float(x) + float(flow[y, x, 0]), float(y) + float(flow[y, x, 1])
        if not (0 <= u <= width - 1 and 0 <= v <= height - 1):
            continue
        nearest = last[int(np.rint(v)), int(np.rint(u))]
        total, mixed = 0.0, 0.0
        for row in {int(np.floor(v)), int(np.ceil(v))}:
            for column in {int(np.floor(u)), int(np.ceil(u))}:
                tap = last[row, column]
                if tap > 0 and abs(tap - nearest) < 0.03 * nearest:
                    weight = (1 - abs(u - column)) * (1 - abs(v - row))
                    total, mixed = total + weight, mixed + weight * tap
        if total > 1e-3 and abs(depth[y, x] - mixed / total) < max_change:
            ray = np.append(rays[y, x, :2] + pixel * flow[y, x], 1.0)
            now, then = depth[y, x] * rays[y, x], mixed / total * ray
            ranges = [np.linalg.norm(now - a) - np.linalg.norm(then - a) for a in antennas]
            changes[labels[y, x]].append([*ranges, *(now - then)])
    known = np.array([len(c) >= 2 for c in changes])
    columns = np.stack([np.mean(c, axis=0) if len(c) >= 2 else np.zeros(len(antennas) + 3) for c in changes])
    known[0] = True
    return columns[:, : len(antennas)].T, columns[:, len(antennas) :], known
