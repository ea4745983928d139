"""The inputs of the objective: its settings, and a clip with the tracer's estimates."""

from __future__ import annotations

import dataclasses
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Int

from ...radio.reads import PhaseReads
from ...tracing.tracer import STORED, AbstractTracer, Camera, Frame, Trace, trace
from ..fading import faded

TERM_NAMES = ("contrast", "coverage", "area", "compactness", "steadiness", "calibration")
"""Names of the objective's terms; the settings hold a weight of each name."""


@dataclasses.dataclass(frozen=True)
class ObjectiveSettings:
    """Weights and parameters of the terms. Terms of weight 0 are not computed."""

    contrast: float = 1.0
    coverage: float = 0.3
    area: float = 0.0  # weak priors, independent of the tag: on the fraction of the picture that the mask covers,
    compactness: float = 0.0  # on its spatial variance, m^2,
    steadiness: float = 0.0  # and on its change along the flow
    calibration: float = 0.0  # of the confidence, as the probability that the mask's motion explains the reads best
    evidence: Literal["coherence", "likelihood"] = "coherence"  # of the contrast
    temperature: float = 0.1  # of the contrast, in units of coherence; of the likelihood in nats
    flip_probability: float = 0.05  # of the likelihood: that a read is off by pi
    num_shifts: int = 4  # time-shifted copies of the own motion among the negatives
    span_frames: int = 6  # length of the pieces that coherence is computed over: drift accumulates within a piece only
    skip_frames: int = 12  # at the start of a clip, where the tracer has too little evidence
    min_reads: int = 6  # a piece with fewer reads is left out
    stationary_margin: float = 0.05  # a piece whose reads, modulo pi, lose less coherence than this if the tag is assumed stationary is left out
    max_reads: int = 384  # reads of one tag in a clip
    num_channels: int = 32  # distinct channels of one tag in a clip; reads of further ones are left out
    multiple: int = (
        1  # of the coherence; 2 takes phases modulo pi: unaffected by pi flips, but ambiguous at half the distance
    )
    future_alpha_m2: float = 1e-3  # a pixel agrees with the future if it is within about the root of this
    future_stride: int = 2  # every n-th working pixel is compared
    rematerialise: bool = True  # keep only the tracer's states for the backward pass
    memory: float = 0.5  # fraction of the gradient that a frame passes to the frame before
    term_norms: bool = False  # log each term's gradient norm; with three terms a step takes 1.7 times the time

    def __post_init__(self) -> None:
        if not 0 < self.flip_probability < 1:
            raise ValueError(
                f"flip_probability is {self.flip_probability}; expected a value between 0 and 1, both excluded."
            )

    def weights(self) -> dict[str, float]:
        """The weight of each term whose weight is not 0, by name."""
        weights = {name: float(getattr(self, name)) for name in TERM_NAMES}
        active = {name: weight for name, weight in weights.items() if weight != 0.0}
        if not active:
            raise ValueError(
                f"All terms of the objective have weight 0; expected a weight for at least one of {', '.join(TERM_NAMES)}."
            )
        return active


class ObjectiveInputs(eqx.Module):
    """A clip with the tracer's estimates and its reads."""

    camera: Camera
    frames: Frame
    trace: Trace
    reads: PhaseReads  # (tag, antenna, reads): each read of the clip once


class _FadingTracer(AbstractTracer):
    """A tracer with another backward pass: steps are recomputed rather than stored, and gradients fade into the past.

    Values of the forward pass are unchanged.
    """

    tracer: AbstractTracer
    memory: float = eqx.field(static=True)
    rematerialise: bool = eqx.field(static=True)

    def init(self, camera: Camera, frame: Frame) -> Any:
        return self.tracer.init(camera, frame)

    def step(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
        state = faded(state, self.memory)
        if not self.rematerialise:
            return self.tracer.step(camera, state, frame)
        policy = jax.checkpoint_policies.save_only_these_names(STORED)
        # In a scan nothing can be merged across the forward and the backward pass.
        again = eqx.filter_checkpoint(lambda t, c, s, f: t.step(c, s, f), prevent_cse=False, policy=policy)
        return again(self.tracer, camera, state, frame)

    def finish(self, state: Any) -> Any:
        return self.tracer.finish(state)


def objective_inputs(
    tracer: AbstractTracer, camera: Camera, frames: Frame, settings: ObjectiveSettings
) -> ObjectiveInputs:
    """Run the tracer over a clip (leading time axis)."""
    wrapped = _FadingTracer(tracer, settings.memory, settings.rematerialise)
    return ObjectiveInputs(camera, frames, trace(wrapped, camera, frames), clip_reads(frames, settings))


def clip_reads(frames: Frame, settings: ObjectiveSettings) -> PhaseReads:
    """Each tag's reads of the whole clip by each antenna, (tag, antenna, reads), from the overlapping windows of its frames.

    Of a frame's window only the reads since the frame before are new. Channels are renumbered by first appearance and
    limited to `num_channels`; of more than `max_reads` reads the newest are kept.
    """
    before = jnp.concatenate([frames.time_s[:1], frames.time_s[:-1]])[:, None, None, None]
    reads = frames.reads
    new = reads.valid & (reads.time_s > before) & (reads.time_s <= frames.time_s[:, None, None, None])
    reads = eqx.tree_at(lambda r: r.valid, reads, new)

    def pack(one: PhaseReads) -> PhaseReads:
        flat = jax.tree.map(lambda leaf: leaf.reshape(-1), one)
        order = jnp.argsort(flat.valid, stable=True)[-settings.max_reads :]
        packed = jax.tree.map(lambda leaf: leaf[order], flat)
        number = _number_channels(packed.channel, packed.valid)
        keep = packed.valid & (number < settings.num_channels)
        return eqx.tree_at(lambda r: (r.channel, r.valid), packed, (jnp.where(keep, number, 0), keep))

    return jax.vmap(jax.vmap(pack))(jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, 2), reads))


def _number_channels(channel: Int[Array, " reads"], valid: Bool[Array, " reads"]) -> Int[Array, " reads"]:
    """Channels renumbered 0, 1, 2, ... in order of first appearance among the valid reads."""
    first = jnp.argmax((channel[:, None] == channel[None, :]) & valid[None, :], axis=1)
    leads = valid & (first == jnp.arange(channel.shape[0], dtype=first.dtype))
    return (jnp.cumsum(leads.astype(jnp.int32)) - 1)[first]
