"""Bodies completed, and remembered while hidden: `tagattention.segments.whole` and `.hidden`, for all tags at once."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import hidden, whole
from .body import sigmoid
from .connection import connected, touching
from .travel import Segments, norm, squared_distance, top


class Whole:
    """Completes bodies that travel; see `WholeBody`."""

    def __init__(self, settings: whole.WholeBody) -> None:
        self.lag_s, self.num_active = settings.lag_s, settings.num_active
        self.travel_m_s, self.share = (np.float32(one.value) for one in (settings.travel_m_s, settings.share))

    def complete(
        self, membership: Float[np.ndarray, "tag segment"], found: Segments, moved_m: np.ndarray, elapsed_s: np.ndarray
    ) -> None:
        """Complete memberships (probabilities) in place."""
        one, zero = np.float32(1), np.float32(0)
        speed_m_s = norm(moved_m) / np.maximum(elapsed_s, np.float32(self.lag_s))
        travels = sigmoid((speed_m_s - self.travel_m_s) / (np.float32(0.2) * self.travel_m_s))
        travels = np.where(found.exists, travels, zero)
        joins = np.where(found.life_s < np.float32(self.lag_s), one, travels)
        joins = np.where(found.exists & (found.front > np.float32(0.5)), joins, zero)
        at = top(joins, self.num_active)
        at = at[found.exists[at]]
        if not len(at):
            return
        flat = found.centre_m * np.array([1, whole._UPRIGHT, 1], np.float32)
        body = connected(touching(flat[at], found.size_m[at]), joins[at] > 0.5)
        weight = membership * found.area
        total = weight.sum(axis=1)
        members = (body[:, None] == np.arange(len(at))[None]).astype(np.float32)
        of_body = (weight * travels * joins)[:, at] @ members
        goes = sigmoid((of_body.max(axis=1) / np.where(total != 0, total, 1) - self.share) / np.float32(0.1))
        least = one / (one + np.exp(self.share / np.float32(0.1)))
        goes = (goes - least) / (1 - least)
        same = body[None] == np.argmax(of_body, axis=1)[:, None]
        more = np.where(same, np.float32(whole._MOST) * goes[:, None] * joins[at][None], zero)
        membership[:, at] = 1 - (1 - membership[:, at]) * (1 - more)


class Hidden:
    """The last body of each tag; see `HiddenBody`."""

    def __init__(self, settings: hidden.HiddenBody, num_tags: int) -> None:
        names = "margin_nats", "reach_m", "drift_m_s", "stop_s"
        self.value = {name: np.float32(getattr(settings, name).value) for name in names}
        self.evidence_nats = np.full(num_tags, hidden._NOTHING, np.float32)
        self.centre_m, self.velocity_m_s = np.zeros((num_tags, 3), np.float32), np.zeros((num_tags, 3), np.float32)
        self.age_s = np.zeros(num_tags, np.float32)

    def inherit(self, log_likelihood: Float[np.ndarray, "tag segment"], found: Segments) -> None:
        """Raise the evidence of new segments near a tag's last body, in place."""
        v, new = self.value, np.flatnonzero(found.source > -2)
        reach_m2 = np.square(v["reach_m"] + v["drift_m_s"] * self.age_s)[:, None]
        apart_m2 = squared_distance(self.centre_m, found.centre_m[new])
        near = self.evidence_nats[:, None] - np.float32(0.5) * v["margin_nats"] * apart_m2 / reach_m2
        log_likelihood[:, new] = np.maximum(log_likelihood[:, new], near)

    def predicted(self, dt_s: np.float32) -> tuple[np.ndarray, np.ndarray]:
        """Place and velocity of each last body at this frame, if it is hidden."""
        velocity_m_s = self.velocity_m_s * np.exp(-dt_s / self.value["stop_s"])
        return self.centre_m + velocity_m_s * dt_s, velocity_m_s

    def out_of_view(
        self,
        rays: tuple[np.ndarray, np.ndarray],
        depth_m: Float[np.ndarray, "height width"],
        labels: Int[np.ndarray, "height width"],
        membership: Float[np.ndarray, "tag segment"],
        dt_s: np.float32,
    ) -> Bool[np.ndarray, " tag"]:
        """Whether the camera does not see the place of each last body."""
        place_m, _ = self.predicted(dt_s)
        out = np.ones(len(place_m), bool)
        for tag in np.flatnonzero(place_m[:, 2] > hidden._NEAREST_M):
            ray = place_m[tag, :2] / place_m[tag, 2]
            limits = ((ray[0], rays[0][0, 0], rays[0][0, -1]), (ray[1], rays[1][0, 0], rays[1][-1, 0]))
            at = [
                (one - first) / (last - first) * (size - 1) if last != first else 0.0
                for (one, first, last), size in zip(limits, depth_m.shape[::-1], strict=True)
            ]
            column, row = (round(float(one)) for one in at)
            if 0 <= column < depth_m.shape[1] and 0 <= row < depth_m.shape[0]:
                seen_m, slot = depth_m[row, column], labels[row, column]
                in_front = 0 < seen_m < place_m[tag, 2] - np.float32(hidden._IN_FRONT_M)
                out[tag] = in_front and not (slot >= 0 and membership[tag, slot] > 0.5)
        return out

    def step(
        self,
        body_nats: np.ndarray,
        in_view: np.ndarray,
        centre_m: np.ndarray,
        velocity_m_s: np.ndarray,
        kept: np.float32,
        dt_s: np.float32,
        rival_nats: np.ndarray | None,
    ) -> Bool[np.ndarray, " tag"]:
        """Which last bodies are remembered after a frame."""
        nothing, v = np.float32(hidden._NOTHING), self.value
        body_nats = np.where(in_view, body_nats, nothing)
        remembered = np.where(self.evidence_nats > 0.5 * nothing, kept * self.evidence_nats, nothing)
        in_view_nats = body_nats if rival_nats is None else np.maximum(body_nats, rival_nats)
        kept_on = remembered > in_view_nats + v["margin_nats"]
        gone, (place_m, slowed_m_s) = kept_on[:, None], self.predicted(dt_s)
        self.evidence_nats = np.where(kept_on, remembered, body_nats)
        self.centre_m = np.where(gone, place_m, centre_m)
        self.velocity_m_s = np.where(gone, slowed_m_s, velocity_m_s)
        self.age_s = np.where(kept_on, self.age_s + dt_s, np.float32(0))
        return kept_on
