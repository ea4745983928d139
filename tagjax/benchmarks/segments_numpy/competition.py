"""Competition between tags: `tagattention.segments.competition`."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Bool, Float, Int

from ...tagattention.segments import competition as original
from .travel import Segments


@dataclasses.dataclass(frozen=True)
class Bodies:
    """The bodies of the last frame, on the segments `at` of this one."""

    at: Int[np.ndarray, " some"]
    member: Float[np.ndarray, "body some"]
    weight: Float[np.ndarray, "body some"]  # pixels
    present: Bool[np.ndarray, " tag"]

    def evidence_of(self, evidence: Float[np.ndarray, "tag segment"]) -> Float[np.ndarray, "tag body"]:
        """The mean evidence of each tag over each body."""
        mass = self.weight.sum(axis=1)
        some = mass > original._SOME
        mean = evidence[:, self.at] @ self.weight.T / np.where(some, mass, 1)
        return np.where(some, mean, np.float32(original._NOWHERE))


class Competition:
    """Holds the tags' bodies of the last frame; see `tagattention.segments.Competition`."""

    def __init__(
        self, settings: original.Competition, temperature_nats: np.float32, num_tags: int, num_segments: int
    ) -> None:
        self.apart = np.float32(1) - np.float32(settings.together.value)
        self.temperature_nats = temperature_nats
        self.membership = np.zeros((num_tags, num_segments), np.float32)
        self.confidence = np.zeros(num_tags, np.float32)

    def bodies(self, found: Segments, present: Bool[np.ndarray, " tag"]) -> Bodies:
        """The bodies of the last frame on the segments of this one."""
        at = np.flatnonzero(found.exists)
        source = np.where(found.source[at] > -2, np.maximum(found.source[at], 0), at)
        member = np.where((source > 0) & present[:, None], self.membership[:, source], np.float32(0))
        return Bodies(at, member, member * found.area[at], present)

    def prior_nats(
        self, bodies: Bodies, evidence: Float[np.ndarray, "tag segment"]
    ) -> Float[np.ndarray, "tag segment"]:
        """The log prior of each segment as the place of each tag, times the temperature of the place."""
        member = bodies.member
        free = evidence[:, bodies.at[member.max(axis=0, initial=0) < original._HELD]]
        elsewhere = free.max(axis=1, initial=0)
        mass = bodies.weight.sum(axis=1)
        shared = (bodies.weight @ member.T).sum(axis=1) / np.where(mass > 0, mass, 1)
        of_body = bodies.evidence_of(evidence) / self.temperature_nats - np.log(np.maximum(shared, 1))
        logits = np.concatenate([of_body, elsewhere[:, None] / self.temperature_nats], axis=1)
        on_body = np.exp(logits - logits.max(axis=1, keepdims=True))
        on_body = (
            np.where(bodies.present, self.confidence, 0)[:, None] * on_body[:, :-1] / on_body.sum(axis=1, keepdims=True)
        )
        left = np.log1p(-self.apart * np.clip(on_body @ member, 0, 1))
        out = np.zeros_like(evidence)
        out[:, bodies.at] = self.temperature_nats * (left.sum(axis=0) - left)
        return out
