"""The background model of `tagattention.segments.background`, in place."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float

from ...tagattention.segments import background as original
from ...tagattention.segments import carry


@dataclasses.dataclass(frozen=True)
class View:
    """What the background model says of the pixels of one frame; see `BackgroundView`."""

    confirmed: Bool[np.ndarray, "height width"]
    matched: Bool[np.ndarray, "height width"]
    age_s: Float[np.ndarray, "height width"]
    still: Bool[np.ndarray, "height width"]
    front: Bool[np.ndarray, "height width"]


def on_surface(depth_m: Float[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Pixels with depth of which at least two of four neighbours have nearly the same."""
    limit = carry._FLYING * depth_m
    near = np.zeros(depth_m.shape, np.uint8)
    # A neighbour's difference is the same both ways, and compared with the limit of each.
    down, right = np.abs(depth_m[1:] - depth_m[:-1]), np.abs(depth_m[:, 1:] - depth_m[:, :-1])
    near[:-1] += down < limit[:-1]
    near[1:] += down < limit[1:]
    near[:, :-1] += right < limit[:, :-1]
    near[:, 1:] += right < limit[:, 1:]
    return (depth_m > 0) & (near >= 2)


class Background:
    """The background's state; `step` takes the next frame."""

    def __init__(self, settings: original.Background, height: int, width: int) -> None:
        self.confirm_s, self.early_s = np.float32(settings.confirm_s), np.float32(settings.early_s)
        self.still_m_s, self.reveal_s = np.float32(settings.still_m_s), np.float32(settings.reveal_s)
        self.tolerance_m, self.tolerance_m_m2 = np.float32(settings.tolerance_m), np.float32(settings.tolerance_m_m2)
        self.candidate_m, self.count, self.confirmed_m, self.rested_m = np.zeros((4, height, width), np.float32)
        self.resting_s, self.deeper_s = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
        self.started = False

    def step(
        self,
        depth_m: Float[np.ndarray, "height width"],
        valid: Bool[np.ndarray, "height width"],
        flow_px: Float[np.ndarray, "height width 2"],
        dt_s: np.float32,
        focal_px: np.float32,
    ) -> View:
        """One frame on."""
        tolerance = self.tolerance_m + self.tolerance_m_m2 * np.square(depth_m)
        speed = np.sqrt(np.square(flow_px[..., 0]) + np.square(flow_px[..., 1]))
        still = speed * depth_m < self.still_m_s * focal_px * dt_s
        matched = valid & (np.abs(depth_m - self.candidate_m) < tolerance)
        seen, other = matched & still, valid & ~matched
        count, candidate, age = self.count, self.candidate_m, self.resting_s
        np.minimum(count + 1, np.float32(original._MAX_COUNT), out=count, where=seen)
        np.add(candidate, (depth_m - candidate) / np.maximum(count, 1), out=candidate, where=seen)
        np.add(age, dt_s, out=age, where=seen)
        np.copyto(count, np.float32(1), where=other)
        np.copyto(candidate, depth_m, where=other)
        np.copyto(age, np.float32(0) if self.started else self.early_s, where=other)

        confirmed = self.confirmed_m
        nearer = (confirmed > 0) & (candidate < confirmed - tolerance)
        wait_s = np.where(nearer, np.float32(original._NEARER_FACTOR) * self.confirm_s, self.confirm_s)
        np.copyto(confirmed, candidate, where=seen & (age >= wait_s))
        behind = _behind(depth_m, confirmed, tolerance)
        np.add(self.deeper_s, dt_s, out=self.deeper_s, where=valid & behind)
        np.copyto(self.deeper_s, np.float32(0), where=valid & ~behind)
        revealed = self.deeper_s > max(self.reveal_s, np.float32(original._REVEAL_FRAMES) * dt_s)
        np.copyto(confirmed, np.float32(0), where=revealed)
        shown = valid & (confirmed > 0) & (np.abs(depth_m - confirmed) < tolerance)
        rested = self.rested_m
        np.copyto(rested, np.float32(0), where=valid & _behind(depth_m, rested, tolerance))
        np.maximum(rested, candidate, out=rested, where=seen & (age > self.early_s))
        front = valid & ((rested <= 0) | (depth_m < rested - 2 * tolerance))
        self.started |= bool(valid.any())
        return View(confirmed=shown, matched=matched, age_s=age, still=still, front=front)


def _behind(depth_m: np.ndarray, surface_m: np.ndarray, tolerance_m: np.ndarray) -> np.ndarray:
    """Whether the depth is behind a surface that is known."""
    return (surface_m > 0) & (depth_m > surface_m + tolerance_m) & (depth_m < 2 * surface_m + 1)
