"""What the backward pass of offline smoothing hands over to the forward pass of the pixel tracer."""

from __future__ import annotations

import equinox as eqx
from jaxtyping import Array, Float

from .anchor import Anchor


class BackwardMessage(eqx.Module):
    """Evidence from all frames after one, for every tag: the backward pass of offline (two-pass) smoothing computes it."""

    log_odds: Float[Array, "*time tag height width"]  # of object against background
    anchor: Anchor  # (*time, tag, antenna, ...): range posterior of the tag at this frame
    moved: Float[Array, "*time tag antenna"]  # evidence of later reads that the tag moves, nats
