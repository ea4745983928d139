"""TagAttention as a learnable tracer: the paper's stages, each hard step relaxed, each constant a parameter.

Per frame: the motion map slides (Eq. 3); pixels are grouped into 3D segments; attention compares each one's motion
with the tag's (Eqs. 4-6), and coherence compares it with the raw phase reads; the log-odds map is carried along the
flow and updated (Eq. 7 with a background class and forgetting), pooled in the segments (III.G), and cut. What goes
beyond the paper: an object is one compact thing in 3D, and it is next to where it was a frame ago.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._numerics import logit, safe_norm
from .attention import att_corr, att_rbf, attention, centre_first
from .motion import MotionMap, carry, empty_motion, push_gather
from .propagation import log_likelihood_ratio, propagate, radio_speed, soft_clip, velocity_gate
from .rf.coherence import coherence, phase_residual
from .rf.reads import PhaseReads, RadioWindow
from .segmentation import (
    Segments,
    bounding_box,
    diffuse,
    mean_shift,
    pool,
    segment,
    segment_affinity,
    unpool,
)
from .tracer import AbstractTracer, Camera, Frame, Trace


class TagAttentionState(eqx.Module):
    """Everything a frame hands to the next: fixed shapes, whatever the length of the recording."""

    motion: MotionMap
    time_s: Float[Array, " window"]
    log_odds: Float[Array, "tag height width"]
    centre_m: Float[Array, "tag 3"]
    velocity_m_s: Float[Array, "tag 3"]
    confidence: Float[Array, " tag"]


def _log(value: float) -> Float[Array, ""]:
    if value <= 0:
        raise ValueError(f"A positive value is needed for a parameter kept as its logarithm; found {value}.")
    return jnp.log(jnp.asarray(value, jnp.float32))


def _logit(value: float) -> Float[Array, ""]:
    return jnp.asarray(logit(min(max(value, 1e-6), 1.0 - 1e-6)), jnp.float32)


class TagAttention(AbstractTracer):
    """Learnable TagAttention.

    Leaves whose names start with `log_` or `logit_` are stored unconstrained; properties give the physical values.
    """

    log_alpha: Float[Array, ""]
    logit_beta: Float[Array, ""]
    log_floor: Float[Array, ""]
    logit_background: Float[Array, ""]
    log_coherent_weight: Float[Array, ""]
    coherent_level: Float[Array, ""]
    log_v0: Float[Array, ""]
    log_gate_width: Float[Array, ""]
    logit_forgetting: Float[Array, ""]
    log_evidence_limit: Float[Array, ""]
    logit_pool_motion: Float[Array, ""]
    logit_pool_log_odds: Float[Array, ""]
    log_segment_temperature: Float[Array, ""]
    logit_diffusion: Float[Array, ""]
    log_affinity_length: Float[Array, ""]
    log_affinity_step: Float[Array, ""]
    cut: Float[Array, ""]
    log_cut_width: Float[Array, ""]
    log_cut_margin: Float[Array, ""]
    log_extent: Float[Array, ""]
    log_prior_weight: Float[Array, ""]
    log_prior_radius: Float[Array, ""]
    logit_inertia: Float[Array, ""]

    cell: int = eqx.field(static=True)
    max_speed_m_s: float = eqx.field(static=True)
    box_tail: float = eqx.field(static=True)
    doubled_angle: bool = eqx.field(static=True)

    def __init__(
        self,
        *,
        alpha_m2: float = 0.01,
        beta: float = 0.8,
        floor: float = 0.02,
        background: float = 0.2,
        coherent_weight: float = 1.0,
        coherent_level: float = 0.6,
        v0_m_s: float = 0.2,
        gate_width_m_s: float = 0.05,
        forgetting: float = 0.93,
        evidence_limit: float = 12.0,
        pool_motion: float = 0.9,
        pool_log_odds: float = 0.8,
        segment_temperature_m: float = 0.06,
        diffusion: float = 0.5,
        affinity_length_m: float = 0.3,
        affinity_step_m: float = 0.08,
        cut: float = 1.0,
        cut_width: float = 0.5,
        cut_margin: float = 2.0,
        extent_m: float = 0.8,
        prior_weight: float = 8.0,
        prior_radius_m: float = 0.5,
        inertia: float = 0.9,
        cell: int = 8,
        max_speed_m_s: float = 3.0,
        box_tail: float = 0.02,
        doubled_angle: bool = True,
    ):
        """Initial values in physical units.

        Args:
            alpha_m2: RBF kernel parameter (Eq. 4), m^2.
            beta: share of the RBF attention (Eq. 6).
            floor, background: floor and background attention of the log-likelihood ratio.
            coherent_weight, coherent_level: weight of the coherent phase term, and the score that speaks for neither.
            v0_m_s, gate_width_m_s: velocity threshold (Eq. 7) and width of its soft step.
            forgetting: factor on the past per frame of full evidence; 1 in the paper.
            evidence_limit: bound of the log odds.
            pool_motion, pool_log_odds: share of the 3D segment's mean in a pixel's motion and log odds.
            segment_temperature_m: softness of K-means, metres.
            diffusion, affinity_length_m, affinity_step_m: how much, how far and how alike segments share log odds.
            cut, cut_width, cut_margin: log odds of the mask's edge; its softness; at most `cut_margin` below the best.
            extent_m: how far an object reaches from its centre.
            prior_weight, prior_radius_m, inertia: pull towards the place predicted from the last frame.
            cell: cell of the segmentation grid, pixels of the working resolution.
            max_speed_m_s: a faster change of a pixel's distance is another surface.
            box_tail: share of the mask that the box may leave out on each side.
            doubled_angle: take phases modulo pi in the coherent term (readers with pi flips).
        """
        self.log_alpha, self.logit_beta = _log(alpha_m2), _logit(beta)
        self.log_floor, self.logit_background = _log(floor), _logit(background)
        self.log_coherent_weight = _log(coherent_weight)
        self.coherent_level = jnp.asarray(coherent_level, jnp.float32)
        self.log_v0, self.log_gate_width = _log(v0_m_s), _log(gate_width_m_s)
        self.logit_forgetting, self.log_evidence_limit = _logit(forgetting), _log(evidence_limit)
        self.logit_pool_motion, self.logit_pool_log_odds = _logit(pool_motion), _logit(pool_log_odds)
        self.log_segment_temperature = _log(segment_temperature_m)
        self.logit_diffusion = _logit(diffusion)
        self.log_affinity_length, self.log_affinity_step = _log(affinity_length_m), _log(affinity_step_m)
        self.cut = jnp.asarray(cut, jnp.float32)
        self.log_cut_width, self.log_cut_margin = _log(cut_width), _log(cut_margin)
        self.log_extent = _log(extent_m)
        self.log_prior_weight, self.log_prior_radius = _log(prior_weight), _log(prior_radius_m)
        self.logit_inertia = _logit(inertia)
        self.cell, self.max_speed_m_s = cell, max_speed_m_s
        self.box_tail, self.doubled_angle = box_tail, doubled_angle

    def physical(self) -> dict[str, float]:
        """The learnable parameters in physical units, by name."""
        values = {}
        for name, leaf in vars(self).items():
            if isinstance(leaf, jax.Array):
                if name.startswith("log_"):
                    values[name.removeprefix("log_")] = float(jnp.exp(leaf))
                elif name.startswith("logit_"):
                    values[name.removeprefix("logit_")] = float(jax.nn.sigmoid(leaf))
                else:
                    values[name] = float(leaf)
        return values

    def init(self, camera: Camera, frame: Frame) -> TagAttentionState:
        height, width = frame.depth_m.shape
        num_tags, num_window = frame.radio.relative_m.shape
        return TagAttentionState(
            motion=empty_motion(height, width, num_window),
            time_s=jnp.broadcast_to(frame.time_s, (num_window,)),
            log_odds=jnp.zeros((num_tags, height, width)),
            centre_m=jnp.zeros((num_tags, 3)),
            velocity_m_s=jnp.zeros((num_tags, 3)),
            confidence=jnp.zeros(num_tags),
        )

    def step(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, Trace]:
        points = camera.rays * frame.depth_m[..., None]
        valid = frame.depth_m > 0
        distance = jnp.where(valid, safe_norm(points - camera.antenna_m[None, None]), 0.0)
        time_s = jnp.concatenate([state.time_s[1:], frame.time_s[None]])
        elapsed_s = jnp.maximum(time_s[-1] - time_s[-2], 1e-3)
        motion = push_gather(state.motion, frame.backward_px, distance, self.max_speed_m_s * elapsed_s + 0.05)

        recent = motion.valid[..., -1] & motion.valid[..., -2]
        step_m = jnp.where(recent, motion.distance_m[..., -1] - motion.distance_m[..., -2], 0.0)
        segments = segment(
            jnp.concatenate([points, step_m[..., None]], axis=-1),
            valid,
            jnp.exp(self.log_segment_temperature),
            cell=self.cell,
        )
        rho, known, rho_segment = self._pooled_motion(segments, motion)
        means, _ = pool(segments, jnp.concatenate([points, step_m[..., None]], axis=-1), valid.astype(points.dtype))
        affinity = segment_affinity(
            segments, means[..., :3], means[..., 3], jnp.exp(self.log_affinity_length), jnp.exp(self.log_affinity_step)
        )
        carried = jnp.moveaxis(carry(jnp.moveaxis(state.log_odds, 0, -1), frame.backward_px, jnp.zeros(())), -1, 0)
        # A surface that was hidden a frame ago brings no history of its own.
        carried = jnp.where((motion.valid[..., -2] | ~valid)[None], carried, 0.0)

        def one_tag(carried, radio, reads, centre, velocity, confidence):
            evidence = self._evidence(segments, rho, known, rho_segment, radio, reads, time_s)
            speed = radio_speed(radio.relative_m, time_s)
            alpha = jnp.exp(self.log_alpha)
            uncertainty = jnp.mean(jnp.square(jnp.where(jnp.isfinite(radio.std_m), radio.std_m, 1e3)))
            gate = velocity_gate(speed, jnp.exp(self.log_v0), jnp.exp(self.log_gate_width))
            gate = gate * alpha / (alpha + uncertainty)
            log_odds = propagate(carried, evidence, gate, jax.nn.sigmoid(self.logit_forgetting))
            log_odds = soft_clip(log_odds, jnp.exp(self.log_evidence_limit))
            share = jax.nn.sigmoid(self.logit_pool_log_odds)
            pooled, _ = pool(segments, log_odds[..., None], valid.astype(log_odds.dtype))
            refined = jnp.where(valid, (1 - share) * log_odds + share * unpool(segments, pooled)[..., 0], log_odds)
            spread = diffuse(pooled[..., 0], affinity, jax.nn.sigmoid(self.logit_diffusion))
            smooth = jnp.where(
                valid, (1 - share) * log_odds + share * unpool(segments, spread[..., None])[..., 0], log_odds
            )
            predicted = centre + velocity * elapsed_s * jax.nn.sigmoid(self.logit_inertia)
            mask, new_centre = self._cut(points, valid, smooth, predicted, confidence)
            inside = jnp.max(jnp.where((mask > 0.5) & valid, refined, -9.0))
            new_confidence = jax.nn.sigmoid(inside)
            both = (confidence > 0.5) & (new_confidence > 0.5)
            move = jnp.clip((new_centre - centre) / elapsed_s, -self.max_speed_m_s, self.max_speed_m_s)
            new_velocity = jnp.where(both, 0.5 * velocity + 0.5 * move, 0.0)
            return refined, mask, new_centre, new_velocity, new_confidence

        log_odds, mask, centre, velocity, confidence = jax.vmap(one_tag)(
            carried, frame.radio, frame.reads, state.centre_m, state.velocity_m_s, state.confidence
        )
        # The place prior feeds its own result back; gradients through that loop grow without bound within a second.
        place = jax.lax.stop_gradient((centre, velocity, confidence))
        new_state = TagAttentionState(motion, time_s, log_odds, *place)
        return new_state, describe(mask, centre, step_m, recent, confidence, self.box_tail)

    def finish(self, state: TagAttentionState) -> TagAttentionState:
        return state

    def _pooled_motion(
        self, segments: Segments, motion: MotionMap
    ) -> tuple[Float[Array, "height width window"], Bool[Array, "height width"], Float[Array, "rows columns window"]]:
        """Motion vectors of pixels mixed with their segment's mean, where that is known, and the segments' own."""
        num_window = motion.distance_m.shape[-1]
        full = jnp.all(motion.valid, axis=-1)
        own = jnp.where(full[..., None], centre_first(motion.distance_m, motion.valid), 0.0)
        mean, mass = pool(segments, own, full.astype(own.dtype))
        solid = (mass > 1.0).astype(own.dtype)[..., None]
        spread = unpool(segments, jnp.concatenate([mean * solid, solid], axis=-1))
        share = spread[..., num_window:]
        has = share[..., 0] > 0.5
        pooled = spread[..., :num_window] / jnp.maximum(share, 1e-3)
        mix = jax.nn.sigmoid(self.logit_pool_motion)
        blended = jnp.where(has[..., None], (1 - mix) * own + mix * pooled, own)
        return jnp.where(full[..., None], blended, pooled), full | has, mean * solid

    def _evidence(
        self,
        segments: Segments,
        rho: Float[Array, "height width window"],
        known: Bool[Array, "height width"],
        rho_segment: Float[Array, "rows columns window"],
        radio: RadioWindow,
        reads: PhaseReads,
        time_s: Float[Array, " window"],
    ) -> Float[Array, "height width"]:
        """Log-likelihood ratio of object against background at each pixel: Eqs. 4-6 and the coherent phase term."""
        everywhere = jnp.ones(rho.shape, dtype=bool)
        # The mean misfit over the window is profiled out: a single noisy first sample would offset all others.
        offset = jnp.mean(rho - radio.relative_m[None, None], axis=-1, keepdims=True)
        relative = radio.relative_m[None, None]
        rbf = att_rbf(rho - offset, relative, everywhere, jnp.exp(self.log_alpha)[None, None])
        corr = att_corr(rho, relative, everywhere)
        att = attention(rbf, corr, jax.nn.sigmoid(self.logit_beta))
        ratio = log_likelihood_ratio(att, jax.nn.sigmoid(self.logit_background), jnp.exp(self.log_floor))
        score = coherent_score(rho_segment, reads, time_s, doubled_angle=self.doubled_angle)
        coherent = unpool(segments, (score - self.coherent_level)[..., None] * _read_support(reads))[..., 0]
        return jnp.where(known, ratio + jnp.exp(self.log_coherent_weight) * coherent, 0.0)

    def _cut(
        self,
        points: Float[Array, "height width 3"],
        valid: Bool[Array, "height width"],
        log_odds: Float[Array, "height width"],
        predicted_m: Float[Array, " 3"],
        confidence: Float[Array, ""],
    ) -> tuple[Float[Array, "height width"], Float[Array, " 3"]]:
        """The soft mask, and the object's centre: log odds with the place prior, cut, kept to one compact thing."""
        away = jnp.sum(jnp.square(points - predicted_m[None, None]), axis=-1) / (
            2.0 * jnp.exp(2.0 * self.log_prior_radius)
        )
        prior = jnp.exp(self.log_prior_weight) * confidence * (2.0 * jnp.exp(-away) - 1.0)
        total = log_odds + prior
        best = jnp.max(jnp.where(valid, total, -1e3))
        threshold = jnp.minimum(self.cut, best - jnp.exp(self.log_cut_margin))
        width = jnp.exp(self.log_cut_width)
        known = valid.astype(total.dtype)
        weight = jax.nn.sigmoid((total - threshold) / width) * known
        peak = jnp.where(valid, jnp.exp(jnp.minimum(total - best, 0.0) / width), 0.0)
        start = jnp.sum(points * peak[..., None], axis=(0, 1)) / jnp.maximum(jnp.sum(peak), 1e-6)
        extent = jnp.exp(self.log_extent)
        centre = mean_shift(points, weight, start, extent)
        spread = jnp.sum(jnp.square(points - centre[None, None]), axis=-1) / (2.0 * extent**2)
        return jax.nn.sigmoid((total - threshold - spread) / width) * known, centre


def _first_of_channel(reads: PhaseReads) -> Array:
    """Reads grouped by channel within the buffer: each read's group is the index of the channel's first read."""
    same = reads.channel[:, None] == reads.channel[None, :]
    return jnp.argmax(same & reads.valid[None, :], axis=1)


def _read_support(reads: PhaseReads) -> Float[Array, ""]:
    """Share of the reads left once every channel has spent one on its unknown offset; 0 without reads."""
    first = reads.valid & (_first_of_channel(reads) == jnp.arange(reads.channel.shape[0]))
    count, groups = (jnp.sum(flags.astype(reads.time_s.dtype)) for flags in (reads.valid, first))
    return jnp.where(count > 0, (count - groups) / jnp.maximum(count, 1.0), 0.0)


def coherent_score(
    rho_m: Float[Array, "rows columns window"],
    reads: PhaseReads,
    time_s: Float[Array, " window"],
    *,
    doubled_angle: bool,
) -> Float[Array, "rows columns"]:
    """Coherence of raw reads with motion known at frame times, linear in between; in [0, 1]."""
    upper = jnp.clip(jnp.searchsorted(time_s, reads.time_s), 1, time_s.shape[0] - 1)
    span = time_s[upper] - time_s[upper - 1]
    fraction = jnp.clip((reads.time_s - time_s[upper - 1]) / jnp.where(span > 0, span, 1.0), 0.0, 1.0)
    share = fraction[None, None]
    distance = rho_m[..., upper - 1] * (1.0 - share) + rho_m[..., upper] * share
    residual = phase_residual(reads.phase_rad[None, None], reads.carrier_hz[None, None], distance)
    weight = reads.valid.astype(rho_m.dtype) / (jnp.square(reads.sigma_rad) + 0.1)
    return coherence(
        residual,
        weight[None, None],
        _first_of_channel(reads)[None, None],
        num_channels=reads.channel.shape[0],
        multiple=2 if doubled_angle else 1,
    )


def describe(
    mask: Float[Array, "tag height width"],
    centre_m: Float[Array, "tag 3"],
    step_m: Float[Array, "height width"],
    recent: Bool[Array, "height width"],
    confidence: Float[Array, " tag"],
    box_tail: float,
) -> Trace:
    """The `Trace` of one frame from soft masks: box, centroid, and the mask-weighted change of distance."""
    hard = jnp.where(mask > 0.5, mask, 0.0)
    total = jnp.sum(hard, axis=(1, 2))
    height, width = mask.shape[1:]
    divisor = jnp.maximum(total, 1e-6)
    x = jnp.sum(hard * jnp.arange(width, dtype=mask.dtype)[None, None], axis=(1, 2)) / divisor
    y = jnp.sum(hard * jnp.arange(height, dtype=mask.dtype)[None, :, None], axis=(1, 2)) / divisor
    moving = mask * recent.astype(mask.dtype)[None]
    change = jnp.sum(moving * step_m[None], axis=(1, 2)) / jnp.maximum(jnp.sum(moving, axis=(1, 2)), 1e-6)
    return Trace(
        mask=mask,
        box_px=jax.vmap(lambda m: bounding_box(m, box_tail))(hard),
        centre_px=jnp.stack([x, y], axis=-1),
        centre_m=centre_m,
        step_m=change,
        confidence=confidence,
        found=(confidence > 0.5) & (total > 0),
    )
