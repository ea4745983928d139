"""Label-free objective: where the mask goes must explain what the tag's reads say, and nobody else's.

The soft mask's distance over time, linear between frames, is held against raw phases by their coherence or likelihood:
nothing is unwrapped, and no label is used. Each term is a function of a `Seen` clip; `TERMS` names them, settings weigh them.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._numerics import safe_divide
from ..image.warp import gather
from ..rf.coherence import coherence, phase_likelihood, phase_residual
from ..rf.reads import PhaseReads
from ..tracer import AbstractTracer, Camera, Frame, Trace, trace


@dataclasses.dataclass(frozen=True)
class ObjectiveSettings:
    """Weights of the terms and what they look at. Terms of weight 0 are not computed."""

    contrast: float = 1.0
    coverage: float = 0.3
    area: float = 0.0  # weak priors, which know nothing of the tag: of the mask's share of the picture,
    compactness: float = 0.0  # of its spread in 3D, m^2,
    steadiness: float = 0.0  # and of what changes of it along the flow
    calibration: float = 0.0  # of the confidence: how often a mask's motion does explain the reads best
    evidence: Literal["coherence", "likelihood"] = "coherence"  # of the contrast
    temperature: float = 0.1  # of the contrast, in units of coherence; of the likelihood in nats
    flip_share: float = 0.05  # of the likelihood: reads that are off by pi
    num_shifts: int = 4  # time-shifted copies of the own motion among the negatives
    span_frames: int = 6  # coherence is taken over pieces this long: drift of the sum does not reach further
    skip_frames: int = 12  # at the start of a clip, while the tracer has not seen enough
    min_reads: int = 6  # a piece with fewer reads says nothing
    rest_margin: float = (
        0.05  # a piece whose reads, modulo pi, lose less coherence than this by taking the tag to rest is left out
    )
    max_reads: int = 384  # reads of one tag in a clip
    num_channels: int = 32  # distinct channels of one tag in a clip; reads of further ones are left out
    multiple: int = 1  # of the coherence: 2 takes phases modulo pi: right whether the reader flips or not, but ambiguous twice as soon
    future_alpha_m2: float = 1e-3  # a pixel agrees with the future if it is within about the root of this
    future_stride: int = 2  # every n-th working pixel is asked
    rematerialise: bool = True  # keep only the tracer's states for the backward pass
    memory: float = 0.5  # share of the gradient that a frame hands on to the frame before

    def __post_init__(self) -> None:
        if not 0 < self.flip_share < 1:
            raise ValueError(f"flip_share is {self.flip_share}; expected a share between 0 and 1, both left out.")

    def weights(self) -> dict[str, float]:
        """The weight of each term that takes part, by name."""
        weights = {name: float(getattr(self, name)) for name in TERMS}
        taking_part = {name: weight for name, weight in weights.items() if weight != 0.0}
        if not taking_part:
            raise ValueError(f"All terms of the objective have weight 0; give one of {', '.join(TERMS)} a weight.")
        return taking_part


class Seen(eqx.Module):
    """A clip with what the tracer made of it."""

    camera: Camera
    frames: Frame
    said: Trace
    reads: PhaseReads  # (tag, antenna, reads): each read of the clip once


class _Trained(AbstractTracer):
    """A tracer as the backward pass sees it: steps computed again rather than kept, gradients fading into the past.

    A recurrent tracer multiplies gradients from frame to frame; without fading, those of the first frames drown all
    others. Values are unchanged.
    """

    tracer: AbstractTracer
    memory: float = eqx.field(static=True)
    rematerialise: bool = eqx.field(static=True)

    def init(self, camera: Camera, frame: Frame) -> Any:
        return self.tracer.init(camera, frame)

    def step(self, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
        state = jax.tree.map(self._fade, state)
        if not self.rematerialise:
            return self.tracer.step(camera, state, frame)
        return eqx.filter_checkpoint(lambda t, c, s, f: t.step(c, s, f))(self.tracer, camera, state, frame)

    def _fade(self, leaf: Array) -> Array:
        if not jnp.issubdtype(leaf.dtype, jnp.inexact):
            return leaf
        return self.memory * leaf + jax.lax.stop_gradient((1.0 - self.memory) * leaf)

    def finish(self, state: Any) -> Any:
        return self.tracer.finish(state)


def see(tracer: AbstractTracer, camera: Camera, frames: Frame, settings: ObjectiveSettings) -> Seen:
    """Run the tracer over a clip (leading time axis)."""
    wrapped = _Trained(tracer, settings.memory, settings.rematerialise)
    return Seen(camera, frames, trace(wrapped, camera, frames), clip_reads(frames, settings))


def clip_reads(frames: Frame, settings: ObjectiveSettings) -> PhaseReads:
    """Each tag's reads of the whole clip by each antenna, (tag, antenna, reads), from the overlapping windows of its frames.

    Of a frame's window only what came after the frame before is new. Channels are numbered anew by first appearance
    and cut at `num_channels`; of more than `max_reads` reads the newest stay.
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
                residual, weight, channel, num_channels=settings.num_channels, flip_share=settings.flip_share
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
        lost = jax.nn.relu(1.0 - explained - settings.rest_margin)
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


def coverage(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """1 - Dice of the mask, made from the past, with the pixels whose motion in the coming window is the tag's.

    Keeps the mask from shrinking to a few sure pixels. Nothing flows back into the pixels' future.
    """
    del key
    agrees, valid, weight = future_agreement(seen.camera, seen.frames, settings)
    stride, num_asked = settings.future_stride, agrees.shape[0]
    mask = jnp.where(valid[:, None], seen.said.mask[:num_asked, :, ::stride, ::stride], 0.0)
    overlap = jnp.sum(mask * agrees, axis=(-2, -1))
    size = jnp.sum(mask * mask, axis=(-2, -1)) + jnp.sum(agrees * agrees, axis=(-2, -1))
    dice = 2.0 * overlap / (size + 1.0)  # one pixel more keeps the gradient of a vanishing mask finite
    started = jnp.arange(num_asked) >= min(settings.skip_frames, num_asked - 1)
    weight = jnp.where(started[:, None], weight, 0.0)
    loss = safe_divide(jnp.sum((1.0 - dice) * weight), jnp.sum(weight))
    return loss, {"mask_share": jnp.mean(seen.said.mask)}


def future_agreement(
    camera: Camera, frames: Frame, settings: ObjectiveSettings
) -> tuple[Float[Array, "asked tag rows columns"], Bool[Array, "asked rows columns"], Float[Array, "asked tag"]]:
    """How well each pixel's motion over the next k - 1 frames agrees with the tag's, beyond what a resting pixel does.

    Pixels are followed along the forward flow to the nearest pixel; those lost on the way, or that jump, are not
    valid. The radio's window that ends k - 1 frames later tells the tag's motion. The weight says how far from rest
    the tag was.
    """
    num_window = frames.radio.relative_m.shape[-1]
    num_frames, height, width = frames.depth_m.shape
    num_asked = max(num_frames - (num_window - 1), 1)
    if num_frames < num_window:
        raise ValueError(f"A clip of {num_frames} frames is too short for the window of {num_window}; lengthen it.")
    stride = settings.future_stride
    ranges = camera.ranges_m(camera.rays[None] * frames.depth_m[..., None])
    ranges = jnp.where(frames.depth_m[None] > 0, ranges, 0.0)
    rows, columns = jnp.meshgrid(jnp.arange(0, height, stride), jnp.arange(0, width, stride), indexing="ij")

    def follow(distance: Float[Array, "time height width"], start: Int[Array, ""]) -> tuple[Array, Array]:
        x, y = columns.astype(distance.dtype), rows.astype(distance.dtype)
        at = distance[start][rows, columns]
        valid, values = at > 0, [at]
        for ahead in range(1, num_window):
            column, row = jnp.round(x).astype(jnp.int32), jnp.round(y).astype(jnp.int32)
            flow = frames.forward_px[start + ahead][jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
            x, y = x + flow[..., 0], y + flow[..., 1]
            column, row = jnp.round(x).astype(jnp.int32), jnp.round(y).astype(jnp.int32)
            inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            at = distance[start + ahead][jnp.clip(row, 0, height - 1), jnp.clip(column, 0, width - 1)]
            valid = valid & inside & (at > 0) & (jnp.abs(at - values[-1]) < 0.5)
            values.append(at)
        return jnp.stack(values, axis=-1), valid

    over_time = jax.vmap(follow, in_axes=(None, 0))
    followed, valid = jax.vmap(over_time, in_axes=(0, None), out_axes=1)(ranges, jnp.arange(num_asked))
    valid = jnp.all(valid, axis=1)
    centred = followed - jnp.mean(followed, axis=-1, keepdims=True)
    radio = jax.tree.map(lambda leaf: leaf[num_window - 1 :], frames.radio)
    known = jnp.all(jnp.isfinite(radio.std_m), axis=-1)
    tag = jnp.where(known[..., None], radio.relative_m, 0.0)
    tag = tag - jnp.mean(tag, axis=-1, keepdims=True)
    spread = settings.future_alpha_m2 + jnp.where(known, jnp.mean(jnp.square(radio.std_m), axis=-1), 0.0)
    misfit = jnp.mean(jnp.square(centred[:, None] - tag[:, :, :, None, None]), axis=-1)
    # An antenna that has not heard the tag says nothing; the others' errors are independent.
    told = jnp.where(known, 1.0 / (2.0 * spread), 0.0)
    agrees = jnp.exp(-jnp.sum(misfit * told[..., None, None], axis=2))
    resting = jnp.exp(-jnp.sum(jnp.mean(jnp.square(tag), axis=-1) * told, axis=-1))
    weight = jnp.where(jnp.any(known, axis=-1), 1.0 - resting, 0.0)
    beyond = safe_divide(
        jax.nn.relu(agrees - resting[..., None, None]), jnp.broadcast_to(weight[..., None, None], agrees.shape)
    )
    return jax.lax.stop_gradient((jnp.where(valid[:, None], beyond, 0.0), valid, weight))


def area(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean share of the picture that the soft masks cover: of masks that explain the reads alike the smaller one."""
    del key
    mask = _started(seen.said.mask, settings)
    return jnp.mean(mask), {}


def compactness(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """Mean square distance of the mask's points from their centre, m^2; masks of nothing have none."""
    del key
    depth = _started(seen.frames.depth_m, settings)
    points = seen.camera.rays[None] * depth[..., None]
    mask = jnp.where((depth > 0)[:, None], _started(seen.said.mask, settings), 0.0)
    mass = jnp.sum(mask, axis=(-2, -1))
    centre = safe_divide(
        jnp.einsum("tkhw,thwc->tkc", mask, points), jnp.broadcast_to(mass[..., None], (*mass.shape, 3))
    )
    away = jnp.sum(jnp.square(points[:, None] - centre[:, :, None, None]), axis=-1)
    return jnp.mean(safe_divide(jnp.sum(mask * away, axis=(-2, -1)), mass)), {}


def steadiness(seen: Seen, settings: ObjectiveSettings, key: Array) -> tuple[Float[Array, ""], dict[str, Array]]:
    """1 - Dice of each mask with that of the frame before, carried along the flow: an object does not come and go.

    Pixels whose past lies outside the picture are left out.
    """
    del key
    mask, backward = _started(seen.said.mask, settings), _started(seen.frames.backward_px, settings)
    if mask.shape[0] < 2:
        return jnp.zeros(()), {}
    carry = lambda before, flow: gather(jnp.moveaxis(before, 0, -1), flow)  # noqa: E731
    carried, known = jax.vmap(carry)(mask[:-1], backward[1:])
    before, now = jnp.moveaxis(carried, -1, 1), jnp.where(known[:, None], mask[1:], 0.0)
    overlap = jnp.sum(before * now, axis=(-2, -1))
    size = jnp.sum(jnp.square(before), axis=(-2, -1)) + jnp.sum(jnp.square(now), axis=(-2, -1))
    return jnp.mean(1.0 - (2.0 * overlap + 1.0) / (size + 1.0)), {}  # two masks of nothing agree


def _started(each: Float[Array, time * shape], settings: ObjectiveSettings) -> Float[Array, started * shape]:
    """What is said of the frames after the first ones, in which the tracer has not seen enough; of one at the least."""
    return each[min(settings.skip_frames, each.shape[0] - 1) :]


Term = Callable[[Seen, ObjectiveSettings, Array], tuple[Float[Array, ""], dict[str, Array]]]

TERMS: Mapping[str, Term] = {
    "contrast": contrast,
    "coverage": coverage,
    "area": area,
    "compactness": compactness,
    "steadiness": steadiness,
    "calibration": calibration,
}
"""The terms of the objective by name; `ObjectiveSettings` has a weight of each name."""


def objective(
    tracer: AbstractTracer, camera: Camera, frames: Frame, key: Array, settings: ObjectiveSettings
) -> tuple[dict[str, Float[Array, ""]], dict[str, Array]]:
    """Every term that has a weight, unweighted, and diagnostics, of one clip."""
    seen = see(tracer, camera, frames, settings)
    terms, diagnostics = {}, {}
    for name in settings.weights():
        terms[name], more = TERMS[name](seen, settings, key)
        diagnostics.update(more)
    return terms, diagnostics
