"""What is learned from hindsight: the soft mask, made from the past alone, should be the smoother's mask."""

from __future__ import annotations

import dataclasses
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, PyTree

from ...core.numerics import safe_divide
from ...core.settings import ConfigError
from ...tagattention.segments import TagAttention
from ...tracing.tracer import AbstractTracer, Camera
from ..fading import faded
from .pieces import PieceFrames, frame_of
from .teachers import Teacher


@dataclasses.dataclass(frozen=True)
class HindsightSettings:
    """Settings of learning from hindsight."""

    sure: float = (
        0.9  # a mask counts where the teacher's confidence is above this, its silence where below 1 minus this
    )
    memory: float = 0.9  # fraction of the gradient that a frame passes to the frame before
    clip_norm: float = 0.3  # of a piece's gradient, at most: some have 50 times the median
    piece_frames: int = 256  # a recording is cut into pieces of at most so many frames
    teacher: Teacher = "smoother"  # or labels: the true masks of simulated recordings, to compare with
    term_norms: ClassVar[bool] = False  # there is one term

    def __post_init__(self) -> None:
        if not 0.5 <= self.sure < 1:
            raise ConfigError(f"sure is {self.sure}; expected a confidence from 0.5 to 1, 1 excluded.")
        if not 0 <= self.memory <= 1:
            raise ConfigError(f"memory is {self.memory}; expected a fraction from 0 to 1.")
        if not self.clip_norm > 0:
            raise ConfigError(f"clip_norm is {self.clip_norm}; expected a positive norm.")
        if self.piece_frames < 1:
            raise ConfigError(f"piece_frames is {self.piece_frames}; expected at least 1 frame.")

    def weights(self) -> dict[str, float]:
        """The weight of each term."""
        return {"hindsight": 1.0}

    def bounded(self, gradient: PyTree) -> PyTree:
        """The gradient of a piece, scaled to at most `clip_norm`."""
        norm = optax.tree.norm(gradient)
        return jax.tree.map(lambda leaf: leaf * jnp.minimum(1.0, self.clip_norm / jnp.maximum(norm, 1e-12)), gradient)

    def terms(
        self, tracer: AbstractTracer, camera: Camera, frames: PieceFrames
    ) -> tuple[dict[str, Float[Array, ""]], dict[str, Array]]:
        """The loss of a piece, and what it consists of."""
        assert isinstance(tracer, TagAttention)
        missed, claimed, num_there, num_away = hindsight_sums(tracer, camera, frames, self)
        loss = safe_divide(missed + claimed, num_there + num_away)
        return {"hindsight": loss}, {
            "overlap": 1.0 - safe_divide(missed, num_there),
            "false_confidence": safe_divide(claimed, num_away),
        }


def hindsight_sums(
    tracer: TagAttention, camera: Camera, frames: PieceFrames, settings: HindsightSettings
) -> tuple[Float[Array, ""], Float[Array, ""], Float[Array, ""], Float[Array, ""]]:
    """Sums over the tag-frames of which the teacher is sure, and their numbers.

    Where it sees the object: 1 - soft IoU of its mask with the tracer's mask times confidence, on segments weighted by
    their areas. Where it sees none: the tracer's confidence.
    """
    num_antennas, num_tags = camera.antennas_m.shape[0], frames.present.shape[1]
    window = frames.radio.relative_m.shape[-1]

    def step(state: Any, frame: PieceFrames) -> tuple[Any, tuple[Array, Array, Array]]:
        state = faded(state, settings.memory)
        state, out = tracer.associate(camera, state, frame.found, frame_of(frame, num_antennas))
        mask, area = out.membership * out.confidence[:, None], frame.found.area
        both = mask * frame.target
        overlap = safe_divide(both @ area, (mask + frame.target - both) @ area)
        return state, (overlap, out.confidence, frame.target @ area)

    state = tracer.no_reads(num_tags, num_antennas, window, frames.time_s[0])
    # In a scan nothing can be merged across the forward and the backward pass.
    _, (overlap, confidence, size) = jax.lax.scan(jax.checkpoint(step, prevent_cse=False), state, frames)
    there = frames.present & (frames.confidence > settings.sure) & (size > 0)
    away = frames.present & (frames.confidence < 1.0 - settings.sure)
    missed = jnp.sum(jnp.where(there, 1.0 - overlap, 0.0))
    claimed = jnp.sum(jnp.where(away, confidence, 0.0))
    return missed, claimed, jnp.sum(there.astype(missed.dtype)), jnp.sum(away.astype(missed.dtype))
