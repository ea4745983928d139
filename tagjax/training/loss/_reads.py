"""Terms that hold the mask's motion against the reads: contrast, and calibration of the confidence."""

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
from ._seen import ObjectiveSettings, Seen


def distance_at(
    step_m: Float[Array, " time"], frame_time_s: Float[Array, " time"], query_s: Float[Array, " reads"]
) -> Float[Array, " reads"]:
    """Distance relative to the first frame at any time: steps summed up, linear between frames, metres."""
    distance = jnp.cumsum(step_m.at[0].set(0.0))
    return jnp.interp(query_s, frame_time_s, distance)


def _piece_frames(num_frames: int, settings: ObjectiveSettings) -> tuple[np.ndarray, int]:
    """The frames at which a clip's pieces begin, and how many later each ends; pieces overlap by half."""
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
    """How well candidate motions explain each tag's reads, per piece of the clip; pieces of all antennas in a row."""

    between: Float[Array, "reads_of motion_of piece"]  # reads of one tag with the motion of another's mask
    altered: Float[Array, "tag candidate piece"]  # own reads with altered own motion
    still: Float[Array, "tag piece"]  # own reads with no motion at all
    own_coherence: Float[Array, "tag piece"]  # whatever the evidence: own reads with own motion, 0 to 1
    weight: Float[Array, "tag piece"]  # how much the piece can tell: 0 for a tag that rests or is not read
    told_of_claim: Float[Array, "tag piece"]  # how much it can tell of a claim: 0 only if the own mask rests as well

    def own(self) -> Float[Array, "tag piece"]:
        """Own reads with the own mask's motion."""
        return jnp.einsum("iip->ip", self.between)

    def candidates(self) -> Float[Array, "tag candidate piece"]:
        """`own`, and after it every other pairing that a tag's reads or motion enter; minus infinity where there is none."""
        same = jnp.eye(self.between.shape[0], dtype=bool)[:, :, None]
        others = jnp.where(same, -jnp.inf, self.between)
        return jnp.concatenate(
            [self.own()[:, None], others, jnp.swapaxes(others, 0, 1), self.altered, self.still[:, None]], axis=1
        )

    def mean(self, values: Float[Array, "tag piece"]) -> Float[Array, ""]:
        """Over the pieces, each as much as it can tell; 0 where none tells anything."""
        return _weighed(values, self.weight)

    def mean_of_claims(self, values: Float[Array, "tag piece"]) -> Float[Array, ""]:
        """Over the pieces, each as much as it can tell of what is claimed."""
        return _weighed(values, self.told_of_claim)


def _weighed(values: Float[Array, "tag piece"], weight: Float[Array, "tag piece"]) -> Float[Array, ""]:
    return safe_divide(jnp.sum(values * weight), jnp.sum(weight))


def agreement(seen: Seen, settings: ObjectiveSettings, key: Array) -> Agreement:
    """Hold every tag's reads against its own mask's motion, the other masks', time-shifted and mirrored ones.

    Each antenna's reads are held against the distances to that antenna.
    """
    of_antenna = functools.partial(_agreement_of_antenna, frame_time_s=seen.frames.time_s, settings=settings, key=key)
    each = jax.vmap(of_antenna, in_axes=(1, 2), out_axes=-2)(seen.reads, seen.said.step_m)
    return jax.tree.map(lambda leaf: leaf.reshape(*leaf.shape[:-2], -1), each)


def _agreement_of_antenna(
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
                residual, weight, channel, num_channels=settings.num_channels, flip_share=settings.flip_probability
            )
        return coherence(residual, weight, channel, num_channels=settings.num_channels, multiple=multiple)

    # Shifts stay clear of 0 from both sides: motion is alike within a few frames.
    clear = min(3, num_frames // 4)
    shifts = jax.random.randint(key, (num_tags, settings.num_shifts), clear, max(num_frames - clear, clear + 1))
    rolled = jax.vmap(lambda step, shift: jax.vmap(lambda by: jnp.roll(step, by))(shift))(steps, shifts)
    altered = jnp.concatenate([rolled, -steps[:, None]], axis=1)
    told, coherent = functools.partial(score, settings.evidence), functools.partial(score, "coherence")
    over_motions = jax.vmap(told, in_axes=(None, None, 0))
    rest = jnp.zeros(num_frames)
    # Reads of a resting tag are coherent with no motion at all, but for their noise, and flips, which two angles undo.
    modulo_pi = functools.partial(coherent, multiple=2)
    by_rest = jax.vmap(modulo_pi, in_axes=(0, 0, None))(reads, inside, rest)
    by_own = jax.vmap(modulo_pi)(reads, inside, steps)

    def told_by(explained: Float[Array, "tag piece"]) -> Float[Array, "tag piece"]:
        lost = jax.nn.relu(1.0 - explained - settings.stationary_margin)
        return jax.lax.stop_gradient(jnp.where(jnp.any(inside, axis=-1), lost, 0.0))

    return Agreement(
        between=jax.vmap(over_motions, in_axes=(0, 0, None))(reads, inside, steps),
        altered=jax.vmap(over_motions)(reads, inside, altered),
        still=jax.vmap(told, in_axes=(0, 0, None))(reads, inside, rest),
        own_coherence=jax.vmap(coherent)(reads, inside, steps),
        weight=told_by(by_rest),
        told_of_claim=told_by(jnp.minimum(by_rest, by_own)),
    )


def contrast(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """InfoNCE: own reads with the own mask's motion against every other pairing; log(candidates) by chance.

    Negatives: own reads with other masks' motion, other tags' reads with the own motion, and own reads with the own
    motion shifted in time, mirrored, or at rest. Pieces weigh as much as their tag moves.
    """
    found = agreement(seen, settings, key)
    candidates, own = found.candidates(), found.own()
    loss = jax.nn.logsumexp(candidates / settings.temperature, axis=1) - own / settings.temperature
    ahead = own - jnp.max(candidates[:, 1:], axis=1)
    return found.mean(loss), {
        "own_coherence": found.mean(found.own_coherence),
        "ahead": found.mean(ahead),
        "own_wins": found.mean((ahead > 0).astype(ahead.dtype)),
        "moving": jnp.mean(found.weight),
    }


def calibration(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Logarithmic score of the confidence in each piece as a forecast of whether the own mask's motion explains it best.

    A proper score (Good, 1952), least where of the pieces with confidence p a share p is won: contrast and coverage are blind to the
    scale of the log odds, of which the cut takes what is near the best. Pieces weigh as much coherence, modulo pi, as
    either rest or the own motion loses: a tag that rests while its mask moves is a claim that is lost. What is won carries
    no gradient.
    """
    found = agreement(seen, settings, key)
    starts, span = _piece_frames(seen.frames.time_s.shape[0], settings)
    confidence = seen.said.confidence[starts[:, None] + np.arange(1, span + 1)].mean(axis=1).T
    confidence = jnp.tile(confidence, (1, seen.reads.valid.shape[1]))  # every antenna has these pieces
    sure = jnp.clip(confidence, 1e-6, 1.0 - 1e-6)
    won = found.own() > jnp.max(found.candidates()[:, 1:], axis=1)
    score = -jnp.where(won, jnp.log(sure), jnp.log1p(-sure))
    return found.mean_of_claims(score), {
        "confidence": found.mean_of_claims(confidence),
        "claims_won": found.mean_of_claims(won.astype(score.dtype)),
    }
