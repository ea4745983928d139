"""Past displacements of segments, and motion pooled over what travels together: `tagattention.segments.travel`."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import travel as original


def top(values: Float[np.ndarray, " segment"], number: int) -> Int[np.ndarray, " top"]:
    """The indices of the largest values, falling; of equal values the first."""
    return np.argsort(-values, kind="stable")[:number]


def norm(x: Float[np.ndarray, "*batch axis"]) -> Float[np.ndarray, "*batch"]:
    """Euclidean norm over the last axis."""
    return np.sqrt(np.einsum("...i,...i->...", x, x))


def squared_distance(one: Float[np.ndarray, "one 3"], other: Float[np.ndarray, "other 3"]) -> np.ndarray:
    """Of each point to each; (one, other), m^2."""
    return sum(np.square(own[:, None] - their[None]) for own, their in zip(one.T, other.T, strict=True))  # pyright: ignore[reportReturnType]


class Past:
    """A ring of displacements; see `PastMotion`."""

    def __init__(self, num_segments: int, span_s: float, num_entries: int = 24) -> None:
        self.displacement_m = np.zeros((num_entries, num_segments, 3), np.float32)
        self.time_s = np.full(num_entries, -np.inf, np.float32)
        self.newest, self.spacing_s = 0, span_s / (num_entries - 2) - 5e-4

    def inherit(self, new: Int[np.ndarray, " new"], source: Int[np.ndarray, " new"]) -> None:
        """New segments take the past of their sources, and none where the source is 0 or less."""
        past = self.displacement_m[:, np.maximum(source, 0)]
        past[:, source <= 0] = 0
        self.displacement_m[:, new] = past

    def add(self, displacement_m: Float[np.ndarray, "segment 3"], now_s: np.float32) -> None:
        """Write an entry, if the last one is old enough."""
        if now_s - self.time_s[self.newest] >= np.float32(self.spacing_s):
            self.newest = (self.newest + 1) % len(self.time_s)
            self.displacement_m[self.newest], self.time_s[self.newest] = displacement_m, now_s

    def since(
        self, lag_s: float, displacement_m: np.ndarray, life_s: np.ndarray, now_s: np.float32
    ) -> tuple[Float[np.ndarray, "segment 3"], Float[np.ndarray, " segment"]]:
        """Displacement over the last `lag_s` or since birth, and that time."""
        at = int(np.argmin(np.abs(self.time_s - (now_s - np.float32(lag_s)))))
        if not np.isfinite(self.time_s[at]):
            return np.zeros_like(displacement_m), np.zeros_like(life_s)
        return displacement_m - self.displacement_m[at], np.minimum(now_s - self.time_s[at], life_s)


@dataclasses.dataclass
class Segments:
    """A frame's segments as the stages of tags need them; see `SegmentFrame`."""

    increment_m: Float[np.ndarray, "antenna segment"]
    motion_m: Float[np.ndarray, "segment 3"]
    known: Bool[np.ndarray, " segment"]
    centre_m: Float[np.ndarray, "segment 3"]
    area: Float[np.ndarray, " segment"]
    size_m: Float[np.ndarray, " segment"]
    life_s: Float[np.ndarray, " segment"]
    displacement_m: Float[np.ndarray, "segment 3"]
    front: Float[np.ndarray, " segment"]
    source: Int[np.ndarray, " segment"]

    @property
    def exists(self) -> Bool[np.ndarray, " segment"]:
        """Slots with a segment, without the background's."""
        out = self.area > 0
        out[0] = False
        return out


class Travel:
    """Displacements that outlive segments; `step` pools the motion of a frame."""

    def __init__(self, settings: original.TravellingTogether, num_segments: int) -> None:
        self.settings = settings
        names = "reach_m", "noise_m", "noise_fraction", "travel_per_m", "heal_s"
        self.value = {name: np.float32(getattr(settings, name).value) for name in names}
        self.past = Past(num_segments, settings.lag_s)
        self.displacement_m, self.life_s = np.zeros((num_segments, 3), np.float32), np.zeros(num_segments, np.float32)

    def step(self, found: Segments, dt_s: np.float32, now_s: np.float32) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The segments that move, which of them have pooled motion, and the weights; `found` gets pooled motion and past."""
        newborn = found.source > -2
        new = np.flatnonzero(newborn)
        self._inherit(new, found.source[new])
        motion_m = np.where(newborn[:, None], np.float32(0), found.motion_m)
        lagged_m, elapsed_s = self.past.since(
            self.settings.lag_s, self.displacement_m + motion_m, self.life_s + dt_s, now_s
        )
        speed = norm(lagged_m) / np.maximum(elapsed_s, np.float32(original._SHORTEST_S))
        active = top(np.where(found.exists, speed, np.float32(-1)), self.settings.num_active)
        active = active[found.exists[active]]  # slots without a segment have neither weight nor motion
        self._adopt(found, active, newborn, speed)

        measured = found.known[active] & ~newborn[active]
        weight = self._kernel(found.centre_m[active], lagged_m[active])
        weight *= np.where(measured, found.area[active], np.float32(0))[None]
        total = weight.sum(axis=1)
        weight[np.diag_indices(len(active))] += np.float32(original._SELF)
        weight /= (total + np.float32(original._SELF))[:, None]
        pooled = total > 1
        found.motion_m[active] = np.where(pooled[:, None], weight @ found.motion_m[active], found.motion_m[active])
        own = found.increment_m[:, active]
        found.increment_m[:, active] = np.where(pooled[None], own @ weight.T, own)

        self.displacement_m += np.where(newborn[:, None], np.float32(0), found.motion_m)
        self.life_s += dt_s
        self.past.add(self.displacement_m, now_s)
        found.displacement_m, found.life_s = self.displacement_m, self.life_s
        return active, pooled, weight

    def heal(self, travel: tuple[np.ndarray, ...], log_likelihood: np.ndarray, dt_s: np.float32) -> None:
        """Draw evidence (tag, segment) to that of what travels together, in place."""
        active, pooled, weight = travel
        part = np.float32(1) - np.exp(-dt_s / self.value["heal_s"])
        every = log_likelihood[:, active]
        own = every[:, pooled]
        log_likelihood[:, active[pooled]] = own + part * (every @ weight[pooled].T - own)

    def _inherit(self, new: Int[np.ndarray, " new"], source: Int[np.ndarray, " new"]) -> None:
        has = source > 0
        displacement, life = self.displacement_m[np.maximum(source, 0)], self.life_s[np.maximum(source, 0)]
        self.displacement_m[new] = np.where(has[:, None], displacement, np.float32(0))
        self.life_s[new] = np.where(has, life, np.float32(0))
        self.past.inherit(new, source)

    def _kernel(self, centre_m: np.ndarray, lagged_m: np.ndarray) -> Float[np.ndarray, "active active"]:
        v = self.value
        length = norm(lagged_m)
        further = np.maximum(length[:, None], length[None])
        variance = np.square(v["noise_m"]) + np.square(v["noise_fraction"] * further)
        variance += np.square(v["travel_per_m"] * np.square(further))
        exponent = squared_distance(centre_m, centre_m) / np.square(v["reach_m"])
        exponent += squared_distance(lagged_m, lagged_m) / variance
        return np.exp(np.float32(-0.5) * exponent)

    def _adopt(self, found: Segments, active: np.ndarray, newborn: np.ndarray, speed: np.ndarray) -> None:
        """Give new segments from nowhere the nearest mover as their source."""
        lost = np.where(newborn & (found.source <= 0) & found.exists, found.area, np.float32(0))
        at = top(lost, self.settings.num_newborn)
        at = at[lost[at] > 0]
        mover = active[(speed[active] > np.float32(self.settings.mover_m_s)) & (speed[active] > 0) & ~newborn[active]]
        if not (len(at) and len(mover)):
            return
        apart = squared_distance(found.centre_m[at], found.centre_m[mover])
        nearest = np.argmin(apart, axis=1)
        close = apart[np.arange(len(at)), nearest] < np.float32(self.settings.adopt_m**2)
        found.source = found.source.copy()
        found.source[at[close]] = mover[nearest[close]]
        self._inherit(at[close], found.source[at[close]])  # movers are not new: their past is as it was
