"""The tracer's output on segments, for one frame."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Bool, Float, Int, Int8

from ...tracing.tracer import Evidence
from .detection import Explanations


class Association(eqx.Module):
    """Each tag's body among the segments of a frame."""

    membership: Float[Array, "tag segment"]  # probability that a segment belongs to the tag's body
    place: Float[Array, "tag segment"]  # probability that the tag is at this of all moving segments
    centre_m: Float[Array, "tag 3"]
    step_m: Float[Array, "tag antenna"]  # change of the body's range since the last frame
    nats: Explanations  # that of the body is 0 without one, that of a free path without the stage
    confidence: Float[Array, " tag"]
    detected: Bool[Array, " tag"]
    status: Int8[Array, " tag"]  # codes of `Status`
    best_nats: Float[Array, " tag"]  # evidence for the segment that explains the reads best; 0 without a segment

    def evidence(self) -> Evidence:
        """The evidence for each explanation that `Detection` compares, and for the best segment."""
        return Evidence(self.nats.body, self.nats.stationary, self.nats.free, self.best_nats)


class SegmentTrace(eqx.Module):
    """The output for one frame, for every tag, on segments; `TagAttention.step` makes dense masks of it."""

    labels: Int[Array, "height width"]  # slot of each pixel, -1 = none
    box_px: Float[Array, "tag 4"]
    centre_px: Float[Array, "tag 2"]
    tags: Association
