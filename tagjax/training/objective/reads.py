"""Terms that compare the mask's motion with the reads: contrast, and calibration of the confidence."""

from __future__ import annotations

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...core.numerics import safe_divide
from ...radio.coherence import coherence, phase_likelihood, phase_residual
from ...radio.reads import PhaseReads
from .inputs import ObjectiveInputs, ObjectiveSettings


def distance_at(
    step_m: Float[Array, " time"], frame_time_s: Float[Array, " time"], query_s: Float[Array, " reads"]
) -> Float[Array, " reads"]:
    """Distance relative to the first frame at any time: the cumulative sum of the steps, linear between frames, metres."""
    distance = jnp.cumsum(step_m.at[0].set(0.0))
    return jnp.interp(query_s, frame_time_s, distance)


def _piece_frames(num_frames: int, settings: ObjectiveSettings) -> tuple[np.ndarray, int]:
    """The first frame of each of a clip's pieces, and their length in frames; pieces overlap by half."""
    span = min(settings.span_frames, num_frames - 1)
    skip = min(settings.skip_frames, num_frames - 1 - span)
    return np.arange(skip, num_frames - span, max(span // 2, 1)), span


def _pieces(
    frame_time_s: Float[Array, " time"], reads: PhaseReads, settings: ObjectiveSettings
) -> Bool[Array, "tag piece reads"]:
    """Which reads belong to which piece of the clip."""
    starts, span = _piece_frames(frame_time_s.shape[0], settings)
    begin, end = frame_time_s[starts][None, :, None], frame_time_s[starts + span][None, :, None]
    time_s = reads.time_s[:, None]
    inside = (time_s > begin) & (time_s <= end) & reads.valid[:, None]
    enough = jnp.sum(inside, axis=-1, keepdims=True) >= settings.min_reads
    return inside & enough


class Agreement(eqx.Module):
    """How well candidate motions explain each tag's reads, by piece of the clip; pieces of all antennas are concatenated."""

    pairwise: Float[Array, "reads_tag motion_tag piece"]  # reads of one tag with the motion of another's mask
    altered: Float[Array, "tag candidate piece"]  # own reads with the own motion, shifted or mirrored
    stationary: Float[Array, "tag piece"]  # own reads with no motion
    own_coherence: Float[Array, "tag piece"]  # own reads with own motion, 0 to 1, whichever `evidence` is used
    weight: Float[Array, "tag piece"]  # information in the piece: 0 for a tag that is stationary or not read
    calibration_weight: Float[
        Array, "tag piece"
    ]  # information for calibration: 0 only if the own mask is stationary, too

    def own(self) -> Float[Array, "tag piece"]:
        """Own reads with the own mask's motion."""
        return jnp.einsum("iip->ip", self.pairwise)

    def candidates(self) -> Float[Array, "tag candidate piece"]:
        """`own`, followed by every other pairing of a tag's reads or motion; minus infinity where there is none."""
        same = jnp.eye(self.pairwise.shape[0], dtype=bool)[:, :, None]
        others = jnp.where(same, -jnp.inf, self.pairwise)
        return jnp.concatenate(
            [self.own()[:, None], others, jnp.swapaxes(others, 0, 1), self.altered, self.stationary[:, None]], axis=1
        )

    def mean(self, values: Float[Array, "tag piece"]) -> Float[Array, ""]:
        """Mean over the pieces, weighted by `weight`; 0 where all weights are 0."""
        return _weighted_mean(values, self.weight)

    def calibration_mean(self, values: Float[Array, "tag piece"]) -> Float[Array, ""]:
        """Mean over the pieces, weighted by `calibration_weight`."""
        return _weighted_mean(values, self.calibration_weight)


def _weighted_mean(values: Float[Array, "tag piece"], weight: Float[Array, "tag piece"]) -> Float[Array, ""]:
    return safe_divide(jnp.sum(values * weight), jnp.sum(weight))


def agreement(inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array) -> Agreement:
    """Compare every tag's reads with the motion of its own mask, of the other masks, and of shifted and mirrored ones.

    Each antenna's reads are compared with the distances to that antenna.
    """
    for_antenna = functools.partial(_antenna_agreement, frame_time_s=inputs.frames.time_s, settings=settings, key=key)
    each = jax.vmap(for_antenna, in_axes=(1, 2), out_axes=-2)(inputs.reads, inputs.trace.step_m)
    return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-2], -1), each)


def _antenna_agreement(
    reads: PhaseReads,
    step_m: Float[Array, "time tag"],
    *,
    frame_time_s: Float[Array, " time"],
    settings: ObjectiveSettings,
    key: Array,
) -> Agreement:
    steps = step_m.T
    num_tags, num_frames = steps.shape
    inside = _pieces(frame_time_s, reads, settings)

    def score(
        evidence: str,
        one: PhaseReads,
        member: Bool[Array, "piece reads"],
        step_m: Float[Array, " time"],
        multiple: int = settings.multiple,
    ) -> Array:
        residual = phase_residual(one.phase_rad, one.carrier_hz, distance_at(step_m, frame_time_s, one.time_s))
        weight = member.astype(residual.dtype) / (jnp.square(one.sigma_rad) + 0.1)[None]
        residual, channel = (jnp.broadcast_to(part, weight.shape) for part in (residual, one.channel))
        if evidence == "likelihood":
            return phase_likelihood(
                residual,
                weight,
                channel,
                num_channels=settings.num_channels,
                flip_probability=settings.flip_probability,
            )
        return coherence(residual, weight, channel, num_channels=settings.num_channels, multiple=multiple)

    # Shifts of a few frames are avoided on both sides of 0: motion is similar within a few frames.
    clear = min(3, num_frames // 4)
    shifts = jax.random.randint(key, (num_tags, settings.num_shifts), clear, max(num_frames - clear, clear + 1))
    rolled = jax.vmap(lambda step, shift: jax.vmap(lambda by: jnp.roll(step, by))(shift))(steps, shifts)
    altered = jnp.concatenate([rolled, -steps[:, None]], axis=1)
    score_evidence, coherent = functools.partial(score, settings.evidence), functools.partial(score, "coherence")
    over_motions = jax.vmap(score_evidence, in_axes=(None, None, 0))
    no_motion = jnp.zeros(num_frames)
    # Reads of a stationary tag are coherent with no motion, but for noise and pi flips, which the doubled angle removes.
    modulo_pi = functools.partial(coherent, multiple=2)
    stationary = jax.vmap(modulo_pi, in_axes=(0, 0, None))(reads, inside, no_motion)
    own = jax.vmap(modulo_pi)(reads, inside, steps)

    def information(explained: Float[Array, "tag piece"]) -> Float[Array, "tag piece"]:
        lost = jax.nn.relu(1.0 - explained - settings.stationary_margin)
        return jax.lax.stop_gradient(jnp.where(jnp.any(inside, axis=-1), lost, 0.0))

    return Agreement(
        pairwise=jax.vmap(over_motions, in_axes=(0, 0, None))(reads, inside, steps),
        altered=jax.vmap(over_motions)(reads, inside, altered),
        stationary=jax.vmap(score_evidence, in_axes=(0, 0, None))(reads, inside, no_motion),
        own_coherence=jax.vmap(coherent)(reads, inside, steps),
        weight=information(stationary),
        calibration_weight=information(jnp.minimum(stationary, own)),
    )


def contrast(
    inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """InfoNCE: own reads with the own mask's motion against every other pairing; log(candidates) by chance.

    Negatives: own reads with other masks' motion, other tags' reads with the own motion, and own reads with the own
    motion shifted in time, mirrored, or zero. Pieces are weighted by the motion of their tag.
    """
    agreed = agreement(inputs, settings, key)
    candidates, own = agreed.candidates(), agreed.own()
    loss = jax.nn.logsumexp(candidates / settings.temperature, axis=1) - own / settings.temperature
    margin = own - jnp.max(candidates[:, 1:], axis=1)
    return agreed.mean(loss), {
        "own_coherence": agreed.mean(agreed.own_coherence),
        "margin": agreed.mean(margin),
        "contrast_accuracy": agreed.mean((margin > 0).astype(margin.dtype)),
        "moving": jnp.mean(agreed.weight),
    }


def calibration(
    inputs: ObjectiveInputs, settings: ObjectiveSettings, key: Array
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Logarithmic score of the confidence in each piece as a forecast of whether the own mask's motion explains it best.

    A proper score (Good, 1952), minimal where the own motion is best in a fraction p of the pieces with confidence p.
    Contrast and coverage do not depend on the scale of the log odds. Pieces are weighted by the coherence, modulo pi, that
    either no motion or the own motion loses: a moving mask of a stationary tag counts as a wrong detection. The outcome
    (which motion is best) carries no gradient.
    """
    agreed = agreement(inputs, settings, key)
    starts, span = _piece_frames(inputs.frames.time_s.shape[0], settings)
    confidence = inputs.trace.confidence[starts[:, None] + np.arange(1, span + 1)].mean(axis=1).T
    confidence = jnp.tile(confidence, (1, inputs.reads.valid.shape[1]))  # the pieces are the same for every antenna
    probability = jnp.clip(confidence, 1e-6, 1.0 - 1e-6)
    correct = agreed.own() > jnp.max(agreed.candidates()[:, 1:], axis=1)
    score = -jnp.where(correct, jnp.log(probability), jnp.log1p(-probability))
    return agreed.calibration_mean(score), {
        "confidence": agreed.calibration_mean(confidence),
        "calibration_accuracy": agreed.calibration_mean(correct.astype(score.dtype)),
    }
