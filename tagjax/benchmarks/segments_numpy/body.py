"""Each tag's body: `tagattention.segments.rigid` and `.body` on the segments that exist, for all tags at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

from ...tagattention.segments import body as original
from ...tagattention.segments import rigid
from .connection import reached, touching
from .travel import Past, Segments, norm, squared_distance, top


def sigmoid(x: np.ndarray) -> np.ndarray:
    """1 / (1 + exp(-x)) without overflow."""
    with np.errstate(over="ignore"):
        return 1 / (1 + np.exp(-x))


class Rigid:
    """Log ratio of segments' motion as part of each tag's body; see `RigidMotion`."""

    def __init__(self, settings: rigid.RigidMotion) -> None:
        names = "noise_m", "noise_fraction", "travel_per_m", "other_fraction", "most", "least", "shrink_m2"
        self.value = {name: np.float32(getattr(settings, name).value) for name in names}

    def log_ratio(
        self,
        weight: Float[np.ndarray, "tag active"],
        before_m: Float[np.ndarray, "lag active 3"],
        known: Bool[np.ndarray, "lag active"],
        centre_m: Float[np.ndarray, "active 3"],
        moved_m: Float[np.ndarray, "lag active"],
    ) -> Float[np.ndarray, "tag active"]:
        """The sum over lags, nats; `moved_m` are the lengths of `centre_m - before_m`."""
        v = self.value
        own = weight[:, None] * known[None]
        total = own.sum(axis=-1, keepdims=True)
        enough = total > rigid.LEAST_KNOWN * weight.sum(axis=-1)[:, None, None]
        own = np.where(enough, own / np.where(enough, total, 1), 0)
        middle_before, middle_after = np.einsum("tla,lad->tld", own, before_m), own @ centre_m
        from_m, to_m = before_m[None] - middle_before[:, :, None], centre_m - middle_after[:, :, None]
        covariance = np.swapaxes(from_m, -1, -2) @ (to_m * own[..., None])
        rotation = best_rotation(covariance, v["shrink_m2"])
        residual_m = to_m - from_m @ np.swapaxes(rotation, -1, -2)
        residual_m2 = np.einsum("tlad,tlad->tla", residual_m, residual_m)
        body_m = np.einsum("tla,la->tl", own, moved_m)[..., None]
        square = np.square(np.maximum(moved_m[None], body_m))
        inside = np.square(v["noise_m"]) + np.square(v["noise_fraction"]) * square
        inside += np.square(v["travel_per_m"] * np.square(body_m))
        outside = inside + np.square(v["other_fraction"]) * square
        ratio = np.float32(1.5) * np.log(outside / inside)
        ratio -= np.float32(0.5) * residual_m2 * (1 / inside - 1 / outside)
        return np.where(known[None], np.clip(ratio, -v["least"], v["most"]), np.float32(0)).sum(axis=1)


def best_rotation(covariance: Float[np.ndarray, "*batch 3 3"], shrink: np.float32) -> Float[np.ndarray, "*batch 3 3"]:
    """Horn's rotation by powers; see `rigid.best_rotation`."""
    (xx, xy, xz), (yx, yy, yz), (zx, zy, zz) = np.moveaxis(covariance, (-2, -1), (0, 1))
    rows = [
        [xx + yy + zz + shrink, yz - zy, zx - xz, xy - yx],
        [yz - zy, xx - yy - zz, xy + yx, zx + xz],
        [zx - xz, xy + yx, yy - xx - zz, yz + zy],
        [xy - yx, zx + xz, yz + zy, zz - xx - yy],
    ]
    power = np.moveaxis(np.array(rows, np.float32), (0, 1), (-2, -1))
    size = np.sqrt(np.square(power).sum(axis=(-2, -1)) + np.float32(1e-20))
    power = power + size[..., None, None] * np.eye(4, dtype=np.float32)
    power /= np.trace(power, axis1=-2, axis2=-1)[..., None, None]
    for _ in range(rigid._SQUARINGS):
        power = power @ power
        power /= np.trace(power, axis1=-2, axis2=-1)[..., None, None]
    quaternion = power[..., 0] + np.array([1e-12, 0, 0, 0], np.float32)
    w, x, y, z = np.moveaxis(quaternion / norm(quaternion)[..., None], -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows, np.float32), (0, 1), (-2, -1))


class Body:
    """The state of `CarryingBody`; `step` takes the next frame."""

    def __init__(self, settings: original.CarryingBody, num_tags: int, num_segments: int) -> None:
        self.settings, self.rigid, self.lags_s = settings, Rigid(settings.rigid), settings.rigid.lags_s
        names = (
            "temperature_nats", "fit_nats", "evidence_nats", "most_against", "neighbour_m", "neighbours", "extent",
            "moving_m_s", "memory_s",
        )  # fmt: skip
        self.value = {name: np.float32(getattr(settings, name).value) for name in names}
        self.prior = np.float32(settings.prior)
        self.past = Past(num_segments, max(settings.speed_s, *self.lags_s))
        self.membership = np.zeros((num_tags, num_segments), np.float32)
        self.fastest_m_s = np.zeros(num_segments, np.float32)
        self.age_s = np.float32(0)

    def step(
        self, evidence: Float[np.ndarray, "tag segment"], found: Segments, since_s: np.float32, now_s: np.float32
    ) -> tuple[Float[np.ndarray, "tag segment"], Float[np.ndarray, "tag segment"]]:
        """Log odds of membership after a frame, and the distribution of each tag's place."""
        s, v = self.settings, self.value
        new = np.flatnonzero(found.source > -2)
        source = found.source[new]
        self.membership[:, new] = np.where(source > 0, self.membership[:, np.maximum(source, 0)], np.float32(0))
        self.past.inherit(new, source)
        self.past.add(found.displacement_m, now_s)
        moved_m, time_s = self.past.since(s.speed_s, found.displacement_m, found.life_s, now_s)
        speed_m_s = norm(moved_m) / np.maximum(time_s, np.float32(0.5 * s.speed_s))
        keep = np.exp(-(now_s - since_s) / v["memory_s"])
        before_m_s = self.fastest_m_s.copy()
        before_m_s[new] = np.where(source > 0, self.fastest_m_s[np.maximum(source, 0)], np.float32(0))
        before_m_s[0] = 0
        self.age_s = np.float32(self.age_s + (now_s - since_s))
        uncovered = found.life_s < min(s.young_s, self.age_s - original._SEEN_S)
        lagged = [self.past.since(lag, found.displacement_m, found.life_s, now_s) for lag in self.lags_s]
        slid = (self.age_s > original._SEEN_S) & (norm(lagged[-1][0]) > s.slid_m)
        behind = (found.front < 0.5) & (uncovered | slid)
        self.fastest_m_s = np.where(behind, np.float32(0), np.maximum(speed_m_s, keep * before_m_s))

        rank = self.fastest_m_s + np.float32(0.1) * np.maximum(self.membership.max(axis=0, initial=0), 0)
        active = top(np.where(found.exists, rank, -np.inf), s.num_active)
        gone = active[~found.exists[active]]
        active = active[found.exists[active]]
        out = np.full(self.membership.shape, original._APART, np.float32)
        place = np.zeros_like(out)
        memory = self.membership[:, active]
        self.membership *= keep
        self.membership[:, gone] = 0
        if len(active):
            moved = np.stack([moved[active] for moved, _ in lagged])
            enough = [
                elapsed[active] >= np.float32(0.8 * lag) for (_, elapsed), lag in zip(lagged, self.lags_s, strict=True)
            ]
            out[:, active], place[:, active], self.membership[:, active] = self._bodies(
                evidence[:, active], memory, found.centre_m[active], found.area[active], found.size_m[active], moved, np.stack(enough), keep,
                self.fastest_m_s[active],
            )  # fmt: skip
        return out, place

    def _bodies(
        self,
        own: Float[np.ndarray, "tag active"],
        memory: Float[np.ndarray, "tag active"],
        centre: Float[np.ndarray, "active 3"],
        size: Float[np.ndarray, " active"],
        size_m: Float[np.ndarray, " active"],
        moved: Float[np.ndarray, "lag active 3"],
        known: Bool[np.ndarray, "lag active"],
        keep: np.float32,
        fastest_m_s: Float[np.ndarray, " active"],
    ) -> tuple[Float[np.ndarray, "tag active"], Float[np.ndarray, "tag active"], Float[np.ndarray, "tag active"]]:
        """Log odds, the distribution of the tag's place, and remembered log odds of the active segments."""
        v, tiny = self.value, np.float32(original._TINY)
        reach_m2 = np.square(v["neighbour_m"])
        close = squared_distance(centre, centre) < reach_m2
        near = close * size[None]
        near = (near / near.sum(axis=1, keepdims=True)).astype(np.float32).T  # columns sum to 1
        moving = -np.logaddexp(0, -(fastest_m_s - v["moving_m_s"]) / (np.float32(0.3) * v["moving_m_s"]))
        smooth = own @ near
        level = smooth / v["temperature_nats"] + 4 * moving
        place = size * np.exp(level - level.max(axis=1, keepdims=True))
        place /= place.sum(axis=1, keepdims=True) + tiny
        peak = np.argmax(place @ close.astype(np.float32), axis=1)
        start = place * np.exp(
            np.float32(-0.5) * squared_distance(centre[peak], centre) / np.square(2 * v["neighbour_m"])
        )
        start /= start.sum(axis=1, keepdims=True) + tiny
        below = smooth - np.einsum("ta,ta->t", start, smooth)[:, None]
        against = np.clip(below / v["evidence_nats"], -v["most_against"], 0)
        trusted = np.exp(np.clip(below / v["fit_nats"], -20, 0))
        agrees = np.einsum("ta,ta->t", start, memory) > 0
        memory = np.where(agrees[:, None], memory, np.float32(0))
        before, lengths = centre[None] - moved, norm(moved)
        constant = self.prior + against + memory
        weight, log_odds, ratio = start, np.zeros_like(own), np.zeros_like(own)
        for _ in range(self.settings.num_rounds):
            ratio = self.rigid.log_ratio(weight * trusted, before, known, centre, lengths)
            total = weight.sum(axis=1, keepdims=True)
            part = weight / np.where(total > 0, total, 1)
            away_m2 = squared_distance(part @ centre, centre)
            spread_m2 = np.einsum("ta,ta->t", part, away_m2)[:, None]
            apart = np.float32(-0.5) * away_m2 / (np.square(v["extent"]) * spread_m2 + reach_m2)
            alone = ratio + constant + apart
            log_odds = alone + v["neighbours"] * (2 * (sigmoid(alone) @ near) - 1)
            weight = size * sigmoid(log_odds)
            weight = weight + np.float32(0.2) * weight.sum(axis=1, keepdims=True) * start
        member = log_odds > 0
        log_odds = np.where(member & ~reached(touching(centre, size_m), member, peak), -log_odds, log_odds)
        after = keep * memory + (1 - keep) * np.clip(ratio + against, -4, 4)
        return log_odds, place, np.clip(after, -4, 4)
