"""TagAttention as a learnable tracer: the paper's stages, each hard step relaxed, each constant a parameter.

Per frame: the motion map slides (Eq. 3); pixels are grouped into 3D segments; attention compares each one's motion
with the tag's (Eqs. 4-6), and coherence and phase memory with the raw phase reads; the log-odds map is carried along the
flow and updated (Eq. 7 with a background class and forgetting), pooled in the segments (III.G), and cut.

What goes beyond the paper: the range anchor, by which all of the past says how far away the tag is now; a memory of
the still background; tags that compete for pixels; and an object is one compact thing in 3D, next to where it was a frame
ago. `paper_limit` gives the settings at which all of it is gone and the likelihood and the cut are the paper's.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from ._numerics import safe_sqrt
from .anchor import Anchor, joined, log_density, lost_drift_m, move_anchor, update_belief, votes
from .attention import att_corr, att_rbf, attention, coherent_score, read_support
from .background import Background, empty_background, is_background, remember, shows_rest
from .motion import MotionMap, carry, empty_motion, push_gather
from .parameters import check_positive, check_shares, check_whole, physical, stored_log, stored_logit, with_physical
from .phase_memory import PhaseMemory, carry_phases, phase_evidence
from .phases import PhaseNoise
from .propagation import log_likelihood_ratio, propagate, radio_speed, rival_log_odds, soft_clip, velocity_gate
from .rf.reads import PhaseReads, RadioWindow
from .segmentation import cdf_cut, compact_cut, diffuse, pool, unpool
from .tracer import AbstractSmoother, Camera, Frame, Later, Trace, describe
from .view import Grouping, Ranging, View, elapsed_s, of_each_antenna, view_of

SIGNIFICANCE = 1e-3
"""Share of the pixels by which the histogram rises at a corner of its CDF."""


MIN_RADIUS_M = 0.05
"""No object is taken to be smaller than this."""


class Place(eqx.Module):
    """Where each tag's object was at the last frame."""

    centre_m: Float[Array, "*tag 3"]
    velocity_m_s: Float[Array, "*tag 3"]
    confidence: Float[Array, "*tag"]
    radius_m: Float[Array, "*tag"]  # root mean square distance of its points from the centre


class Belief(eqx.Module):
    """What a tag's radio says of every pixel by now, as log odds of object against background."""

    log_odds: Float[Array, "*tag height width"]  # what is carried on to the next frame
    held: Float[Array, "*tag height width"]  # spread over segments that are alike
    near: Float[Array, "*tag height width"]  # log density of its range by the anchor


class _Observation(eqx.Module):
    """One frame as a step sees it."""

    view: View
    belief: Belief
    step_m: Float[Array, "antenna height width"]
    recent: Bool[Array, "height width"]


class TagAttentionState(eqx.Module):
    """Everything a frame hands to the next: fixed shapes, whatever the length of the recording."""

    motion: MotionMap
    time_s: Float[Array, " window"]
    log_odds: Float[Array, "tag height width"]
    place: Place
    anchor: Anchor
    background: Background
    phases: PhaseMemory


def paper_limit() -> dict[str, Any]:
    """Settings at which `TagAttention` is the paper's Eqs. 4-7 and its CDF-corner cut (without the refinement).

    Pixels are carried by gathering instead of splatting, and those without a full window stay as they are.
    """
    nothing = 1e-12
    return {
        "alpha_m2": 5e-4,
        "beta": 0.8,
        "floor": 1e-6,
        "background": 1.0,
        "profile": 0.0,
        "slack": nothing,
        "noise_share": nothing,
        "rest": 0.0,
        "coherent_weight": nothing,
        "phase_weight": nothing,
        "v0_m_s": 0.1,
        "gate_width_m_s": 1e-6,
        "memory_s": 1e9,
        "evidence_limit": 1e6,
        "pool_motion": 0.0,
        "pool_log_odds": 0.0,
        "diffusion": 0.0,
        "prior_weight": nothing,
        "anchor_limit": nothing,
        "anchor_rate": nothing,
        "foreground_weight": nothing,
        "rivalry": nothing,
        "rest_doubt": 0.0,
        "cut_rule": "cdf_corner",
        "cut_width": 1e-7,
    }


class TagAttention(AbstractSmoother):
    """Learnable TagAttention.

    Leaves whose names start with `log_` or `logit_` are stored unconstrained; `physical` gives the values.
    """

    log_alpha: Float[Array, ""]
    logit_beta: Float[Array, ""]
    log_floor: Float[Array, ""]
    logit_background: Float[Array, ""]
    logit_profile: Float[Array, ""]
    log_slack: Float[Array, ""]
    log_noise_share: Float[Array, ""]
    logit_rest: Float[Array, ""]
    log_coherent_weight: Float[Array, ""]
    coherent_level: Float[Array, ""]
    log_phase_weight: Float[Array, ""]
    log_phase_spread: Float[Array, ""]
    log_phase_rest_spread: Float[Array, ""]
    log_phase_slack: Float[Array, ""]
    logit_phase_outlier: Float[Array, ""]
    log_v0: Float[Array, ""]
    log_gate_width: Float[Array, ""]
    log_memory: Float[Array, ""]
    log_evidence_limit: Float[Array, ""]
    logit_pool_motion: Float[Array, ""]
    logit_pool_log_odds: Float[Array, ""]
    log_segment_temperature: Float[Array, ""]
    logit_diffusion: Float[Array, ""]
    log_affinity_length: Float[Array, ""]
    log_affinity_speed: Float[Array, ""]
    cut: Float[Array, ""]
    log_cut_width: Float[Array, ""]
    log_cut_margin: Float[Array, ""]
    logit_cut_share: Float[Array, ""]
    log_extent: Float[Array, ""]
    log_prior_weight: Float[Array, ""]
    log_prior_reach: Float[Array, ""]
    logit_inertia: Float[Array, ""]
    logit_size_rate: Float[Array, ""]
    logit_range_share: Float[Array, ""]
    log_anchor_weight: Float[Array, ""]
    log_anchor_width: Float[Array, ""]
    log_anchor_depth: Float[Array, ""]
    log_anchor_limit: Float[Array, ""]
    log_anchor_drift: Float[Array, ""]
    log_anchor_rate: Float[Array, ""]
    anchor_unseen: Float[Array, ""]
    log_foreground_weight: Float[Array, ""]
    log_rivalry: Float[Array, ""]
    rest_doubt: Float[Array, ""]

    rest_nats: float = eqx.field(static=True)
    cell: int = eqx.field(static=True)
    max_speed_m_s: float = eqx.field(static=True)
    box_tail: float = eqx.field(static=True)
    doubled_angle: bool = eqx.field(static=True)
    anchor_bins: int = eqx.field(static=True)
    cut_rule: Literal["margin", "cdf_corner"] = eqx.field(static=True)

    def __init__(
        self,
        *,
        alpha_m2: float = 0.005,
        beta: float = 0.8,
        floor: float = 0.02,
        background: float = 0.3,
        profile: float = 1.0,
        slack: float = 0.05,
        noise_share: float = 0.1,
        rest: float = 0.9,
        coherent_weight: float = 2.0,
        coherent_level: float = 0.6,
        phase_weight: float = 0.01,
        phase_spread_rad: float = 0.07,
        phase_rest_spread_rad: float = 0.03,
        phase_slack: float = 0.2,
        phase_outlier: float = 0.05,
        v0_m_s: float = 0.2,
        gate_width_m_s: float = 0.05,
        memory_s: float = 3.3,
        evidence_limit: float = 12.0,
        pool_motion: float = 0.9,
        pool_log_odds: float = 0.8,
        segment_temperature: float = 0.2,
        diffusion: float = 0.5,
        affinity_length: float = 1.0,
        affinity_speed_m_s: float = 0.8,
        cut: float = 1.0,
        cut_width: float = 0.5,
        cut_margin: float = 2.0,
        cut_share: float = 0.02,
        extent_m: float = 0.8,
        prior_weight: float = 8.0,
        prior_reach: float = 0.625,
        inertia: float = 0.9,
        size_rate: float = 0.001,
        range_share: float = 0.97,
        anchor_weight: float = 0.2,
        anchor_width_m: float = 0.2,
        anchor_depth_m: float = 0.2,
        anchor_limit: float = 4.0,
        anchor_drift_m: float = 0.01,
        anchor_rate: float = 0.3,
        anchor_unseen: float = -1.0,
        foreground_weight: float = 3.0,
        rivalry: float = 16.0,
        cell: int = 6,
        max_speed_m_s: float = 3.0,
        rest_doubt: float = 0.0,
        rest_nats: float = 2.0,
        box_tail: float = 0.0,
        doubled_angle: bool = True,
        anchor_bins: int = 120,
        cut_rule: Literal["margin", "cdf_corner"] = "margin",
    ):
        """Initial values in physical units.

        Args:
            alpha_m2: RBF kernel parameter (Eq. 4), m^2.
            beta: share of the RBF attention (Eq. 6).
            floor, background: floor and background attention of the log-likelihood ratio.
            profile: share of the mean misfit over a window that is taken for noise of its first sample; 0 in the paper.
            slack: misfit allowed as a share of the tag's own motion: what swings or turns moves a little unlike it.
            noise_share: share of the radio's variance that widens the kernel.
            rest: how much a pixel at rest counts as explained by the background; 0 in the paper.
            coherent_weight, coherent_level: weight of the coherent phase term, and the score that speaks for neither.
            phase_weight: weight of the phase evidence (`tagjax.phases`), whose reads count once each.
            phase_spread_rad, phase_rest_spread_rad: standard deviation of phases that a pixel's motion explains, and of
                those of a tag at rest, beside thermal noise.
            phase_slack, phase_outlier: share of the motion by which reflections bend phases; share of reads that say
                nothing.
            v0_m_s, gate_width_m_s: velocity threshold (Eq. 7) and width of its soft step.
            memory_s: time in which evidence fades to 1/e while more comes in; infinite in the paper.
            evidence_limit: bound of the log odds.
            pool_motion, pool_log_odds: share of the 3D segment's mean in a pixel's motion and log odds.
            segment_temperature: softness of K-means, cells.
            diffusion, affinity_length, affinity_speed_m_s: how much, how far (cells) and how alike segments share
                log odds.
            cut, cut_width, cut_margin, cut_share: log odds of the mask's edge; its softness; at least `cut_margin` below
                the best; and so far from `cut` towards the best (the paper's cut is relative to the best alone).
            extent_m: how far an object reaches from its centre.
            prior_weight, prior_reach, inertia: pull towards the place predicted from the last frame, within so many
                radii of the object as it was then.
            size_rate: how fast that radius follows the mask's; at 0 it stays `extent_m`.
            range_share: share of the anchor in the confidence.
            anchor_weight, anchor_width_m, anchor_unseen: how much a frame's evidence tells about the tag's range; how
                near a segment must be to vote; log likelihood of a range at which nothing agrees (it may be hidden).
            anchor_depth_m, anchor_limit, anchor_rate: depth of an object; bound of the log density of its range; the
                share of it that counts as evidence of the pixel's identity.
            anchor_drift_m: error of the radio's distance that adds up, per frame.
            foreground_weight: pull of what stands before the background.
            rivalry: log odds that a pixel of another tag's object counts less, at most; infinite where a thing has one tag.
            rest_doubt, rest_nats: log odds that a claim loses while rest explains all of the tag's reads; against how much
                evidence of the reads that it has moved, in nats, 1/e of that is left (not learned: chance sets it).
            cell: cell of the segmentation grid, pixels of the working resolution.
            max_speed_m_s: a faster change of a pixel's distance is another surface.
            box_tail: share of the mask that the box may leave out on each side.
            doubled_angle: take phases modulo pi in the coherent term (readers with pi flips).
            anchor_bins: number of ranges of 0.1 m that the anchor tells apart.
            cut_rule: "margin", or "cdf_corner" as in the paper.

        Raises `ValueError`, by name, for a value that such a parameter cannot have.
        """
        if cut_rule not in ("margin", "cdf_corner"):
            raise ValueError(f"cut_rule is {cut_rule!r}; expected 'margin' or 'cdf_corner'.")
        check_positive(
            alpha_m2=alpha_m2,
            floor=floor,
            slack=slack,
            noise_share=noise_share,
            coherent_weight=coherent_weight,
            phase_weight=phase_weight,
            phase_slack=phase_slack,
            phase_spread_rad=phase_spread_rad,
            phase_rest_spread_rad=phase_rest_spread_rad,
            v0_m_s=v0_m_s,
            gate_width_m_s=gate_width_m_s,
            memory_s=memory_s,
            evidence_limit=evidence_limit,
            segment_temperature=segment_temperature,
            affinity_length=affinity_length,
            affinity_speed_m_s=affinity_speed_m_s,
            cut_width=cut_width,
            cut_margin=cut_margin,
            extent_m=extent_m,
            prior_weight=prior_weight,
            prior_reach=prior_reach,
            anchor_weight=anchor_weight,
            anchor_width_m=anchor_width_m,
            anchor_depth_m=anchor_depth_m,
            anchor_limit=anchor_limit,
            anchor_drift_m=anchor_drift_m,
            anchor_rate=anchor_rate,
            foreground_weight=foreground_weight,
            rivalry=rivalry,
            max_speed_m_s=max_speed_m_s,
            rest_nats=rest_nats,
        )
        check_shares(
            beta=beta,
            background=background,
            profile=profile,
            rest=rest,
            phase_outlier=phase_outlier,
            pool_motion=pool_motion,
            pool_log_odds=pool_log_odds,
            diffusion=diffusion,
            cut_share=cut_share,
            inertia=inertia,
            size_rate=size_rate,
            range_share=range_share,
            box_tail=box_tail,
        )
        check_whole(cell=cell, anchor_bins=anchor_bins)
        self.log_alpha, self.logit_beta = stored_log(alpha_m2), stored_logit(beta)
        self.log_floor, self.logit_background = stored_log(floor), stored_logit(background)
        self.logit_profile, self.log_slack = stored_logit(profile), stored_log(slack)
        self.log_noise_share, self.logit_rest = stored_log(noise_share), stored_logit(rest)
        self.log_coherent_weight = stored_log(coherent_weight)
        self.coherent_level = jnp.asarray(coherent_level, jnp.float32)
        self.log_phase_weight, self.log_phase_slack = stored_log(phase_weight), stored_log(phase_slack)
        self.log_phase_spread = stored_log(phase_spread_rad)
        self.log_phase_rest_spread = stored_log(phase_rest_spread_rad)
        self.logit_phase_outlier = stored_logit(phase_outlier)
        self.log_v0, self.log_gate_width = stored_log(v0_m_s), stored_log(gate_width_m_s)
        self.log_memory, self.log_evidence_limit = stored_log(memory_s), stored_log(evidence_limit)
        self.logit_pool_motion, self.logit_pool_log_odds = stored_logit(pool_motion), stored_logit(pool_log_odds)
        self.log_segment_temperature = stored_log(segment_temperature)
        self.logit_diffusion = stored_logit(diffusion)
        self.log_affinity_length, self.log_affinity_speed = stored_log(affinity_length), stored_log(affinity_speed_m_s)
        self.cut = jnp.asarray(cut, jnp.float32)
        self.log_cut_width, self.log_cut_margin = stored_log(cut_width), stored_log(cut_margin)
        self.logit_cut_share = stored_logit(cut_share)
        self.log_extent = stored_log(extent_m)
        self.log_prior_weight, self.log_prior_reach = stored_log(prior_weight), stored_log(prior_reach)
        self.logit_inertia, self.logit_size_rate = stored_logit(inertia), stored_logit(size_rate)
        self.logit_range_share = stored_logit(range_share)
        self.log_anchor_weight, self.log_anchor_width = stored_log(anchor_weight), stored_log(anchor_width_m)
        self.log_anchor_depth, self.log_anchor_limit = stored_log(anchor_depth_m), stored_log(anchor_limit)
        self.log_anchor_drift, self.log_anchor_rate = stored_log(anchor_drift_m), stored_log(anchor_rate)
        self.anchor_unseen = jnp.asarray(anchor_unseen, jnp.float32)
        self.log_foreground_weight, self.log_rivalry = stored_log(foreground_weight), stored_log(rivalry)
        self.rest_doubt, self.rest_nats = jnp.asarray(rest_doubt, jnp.float32), rest_nats
        self.cell, self.max_speed_m_s = cell, max_speed_m_s
        self.box_tail, self.doubled_angle = box_tail, doubled_angle
        self.anchor_bins, self.cut_rule = anchor_bins, cut_rule

    def physical(self) -> dict[str, float]:
        """The learnable parameters in physical units, by name."""
        return physical(self)

    def with_physical(self, values: Mapping[str, float]) -> TagAttention:
        """The tracer with these parameters, named and in the units of `physical`, in place of its own.

        Raises `ValueError` for names that are missing or unknown, and for values that such a parameter cannot have.
        """
        return with_physical(self, values)

    def init(self, camera: Camera, frame: Frame) -> TagAttentionState:
        height, width = frame.depth_m.shape
        num_tags, num_antennas, num_window = frame.radio.relative_m.shape
        return TagAttentionState(
            motion=jax.vmap(lambda _: empty_motion(height, width, num_window))(camera.antennas_m),
            time_s=jnp.broadcast_to(frame.time_s, (num_window,)),
            log_odds=jnp.zeros((num_tags, height, width)),
            place=Place(
                jnp.zeros((num_tags, 3)),
                jnp.zeros((num_tags, 3)),
                jnp.zeros(num_tags),
                jnp.broadcast_to(jnp.exp(self.log_extent), (num_tags,)),
            ),
            anchor=Anchor.unknown(num_tags, num_antennas, num_window=num_window, num_bins=self.anchor_bins),
            background=empty_background(num_tags, height, width),
            phases=PhaseMemory.nothing(num_tags, num_antennas, height, width),
        )

    def step(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, Trace]:
        state, seen = self._observe(camera, state, frame)
        view, belief, moved = seen.view, seen.belief, state.phases.moved
        if frame.later is not None:
            belief = jax.vmap(self._with_hindsight, in_axes=(None, 0, 0, 0))(view, belief, state.anchor, frame.later)
            moved = jnp.maximum(moved, frame.later.moved)
        rivals = soft_clip(rival_log_odds(belief.held + belief.near), jnp.exp(self.log_rivalry))
        mask, place, sure = jax.vmap(self._locate, in_axes=(None, 0, 0, 0))(view, belief, rivals, state.place)
        # Whether there is anything to claim is doubted, not where it is: the place is kept as it is.
        confidence = jax.nn.sigmoid(sure - self._doubt(jnp.max(moved, axis=1)))
        out = describe(mask, place.centre_m, seen.step_m, seen.recent, confidence, self.box_tail)
        # The place prior feeds its own result back; gradients through that loop grow without bound within a second.
        return eqx.tree_at(lambda one: one.place, state, jax.lax.stop_gradient(place)), out

    def look_back(self, camera: Camera, state: TagAttentionState, frame: Frame) -> tuple[TagAttentionState, Later]:
        state, seen = self._observe(camera, state, frame)
        return state, Later(seen.belief.log_odds, state.anchor, state.phases.moved)

    def _observe(
        self, camera: Camera, state: TagAttentionState, frame: Frame
    ) -> tuple[TagAttentionState, _Observation]:
        """What is believed by this frame and those before it; the next state, but for the objects' places."""
        points = camera.rays * frame.depth_m[..., None]
        valid = frame.depth_m > 0
        distances = jnp.where(valid[None], camera.ranges_m(points), 0.0)
        distance = distances[0]
        time_s = jnp.concatenate([state.time_s[1:], frame.time_s[None]])
        # What shows the surface that has always been there has not moved, whatever shadow runs over it.
        rests = shows_rest(state.background, distance, valid)
        backward_px = jnp.where(rests[..., None], 0.0, frame.backward_px)
        max_step_m = self.max_speed_m_s * elapsed_s(time_s) + 0.05
        motion = of_each_antenna(
            lambda one, distance_m: push_gather(one, backward_px, distance_m, max_step_m), state.motion, distances
        )
        followed = jnp.all(motion.valid[..., -2], axis=0)
        recent = followed & valid
        step_m = jnp.where(recent[None], motion.distance_m[..., -1] - motion.distance_m[..., -2], 0.0)
        grouping = Grouping(
            temperature=jnp.exp(self.log_segment_temperature),
            affinity_length=jnp.exp(self.log_affinity_length),
            affinity_speed_m_s=jnp.exp(self.log_affinity_speed),
            pool_motion=jax.nn.sigmoid(self.logit_pool_motion),
            cell=self.cell,
        )
        view = view_of(camera, points, distances, valid, motion, step_m, time_s, state.background, grouping)

        moved = jnp.moveaxis(carry(jnp.moveaxis(state.log_odds, 0, -1), backward_px, jnp.zeros(())), -1, 0)
        # A surface that was hidden a frame ago brings no history of its own, but for what its pixel remembers.
        shows = is_background(state.background, distance, valid)
        recalled = jnp.where(shows[None], state.background.log_odds, 0.0)
        carried = jnp.where((followed | ~valid)[None], moved, recalled)

        phases = carry_phases(state.phases, backward_px, followed)

        belief, anchor, phases = jax.vmap(self._believe, in_axes=(None, 0, 0, 0, 0, 0))(
            view, carried, frame.radio, frame.reads, state.anchor, phases
        )
        background = remember(state.background, distance, valid, belief.log_odds)
        state = TagAttentionState(motion, time_s, belief.log_odds, state.place, anchor, background, phases)
        return state, _Observation(view, belief, step_m, recent)

    def finish(self, state: TagAttentionState) -> TagAttentionState:
        return state

    def _believe(
        self,
        view: View,
        carried: Float[Array, "height width"],
        radio: RadioWindow,
        reads: PhaseReads,
        anchor: Anchor,
        phases: PhaseMemory,
    ) -> tuple[Belief, Anchor, PhaseMemory]:
        """What one tag's radio says of every pixel by now; radio, reads, anchor, phases per antenna."""
        gates = jax.vmap(self._gate, in_axes=(0, None))(radio, view.time_s)
        evidence, gate = self._weighed_evidence(view, radio, reads, gates)
        anchor, nears = of_each_antenna(
            functools.partial(self._update_anchor, view, evidence), view.ranging, anchor, radio, gates
        )
        near = jnp.sum(nears, axis=0)
        evidence = evidence + jnp.exp(self.log_anchor_rate) * near
        log_odds = propagate(carried, evidence, gate, jnp.exp(-view.elapsed_s / jnp.exp(self.log_memory)))
        told, phases = of_each_antenna(functools.partial(self._phase_evidence, view), view.ranging, reads, phases)
        log_odds = log_odds + jnp.sum(told, axis=0)
        log_odds = soft_clip(log_odds, jnp.exp(self.log_evidence_limit))

        return Belief(*self._spread(view, log_odds), near), anchor, phases

    def _spread(
        self, view: View, log_odds: Float[Array, "height width"]
    ) -> tuple[Float[Array, "height width"], Float[Array, "height width"]]:
        """Log odds shared within segments, and besides among segments that are alike."""
        share = jax.nn.sigmoid(self.logit_pool_log_odds)
        pooled, _ = pool(view.segments, log_odds[..., None], view.valid.astype(log_odds.dtype))

        def refine(grid: Float[Array, "rows columns"]) -> Float[Array, "height width"]:
            mixed = (1.0 - share) * log_odds + share * unpool(view.segments, grid[..., None])[..., 0]
            return jnp.where(view.valid, mixed, log_odds)

        spread = diffuse(pooled[..., 0], view.affinity, jax.nn.sigmoid(self.logit_diffusion))
        return refine(pooled[..., 0]), refine(spread)

    def _with_hindsight(self, view: View, belief: Belief, anchor: Anchor, later: Later) -> Belief:
        """What one tag's radio says by all frames, those to come included: two-filter smoothing (Fraser and Potter, 1969).

        Up to this frame and from it on motion and reads are different ones, so their log odds add up; anchors per antenna.
        """
        log_odds = soft_clip(belief.log_odds + later.log_odds, jnp.exp(self.log_evidence_limit))
        nears = of_each_antenna(
            lambda ranging, past, future: self._near(view, ranging, joined(past, future)),
            view.ranging,
            anchor,
            later.anchor,
        )
        return Belief(*self._spread(view, log_odds), jnp.sum(nears, axis=0))

    def _locate(
        self,
        view: View,
        belief: Belief,
        rivals: Float[Array, "height width"],
        place: Place,
    ) -> tuple[Float[Array, "height width"], Place, Float[Array, ""]]:
        """One tag's soft mask, place, and log odds of the claim, by what is believed of it and of the other tags."""
        valid, held, near = view.valid, belief.held, belief.near
        # Where nothing else can be its object, a tag shares one with its rivals. A maximum has the gradient 0 / 0 where it
        # is computed once more and rounded otherwise, as in the backward pass; and far from even odds it has none.
        elsewhere = jax.lax.stop_gradient(jnp.max(jnp.where(valid, held + near - rivals, -9.0)))
        rivals = rivals * jax.nn.sigmoid(elsewhere)
        # What carries the tag moves, so it stands before what has always been there; but where it began it is itself
        # what is remembered, and evidence outweighs that.
        front = jnp.where(view.front < 0, view.front * jax.nn.sigmoid(-held), view.front)
        shown = held + near + jnp.exp(self.log_foreground_weight) * front - rivals
        predicted = place.centre_m + place.velocity_m_s * view.elapsed_s * jax.nn.sigmoid(self.logit_inertia)
        mask, centre = self._cut(view, shown, predicted, place)
        told = belief.log_odds + jax.nn.sigmoid(self.logit_range_share) * near
        sure = jnp.max(jnp.where((mask > 0.5) & valid, told, -9.0))
        confidence = jax.nn.sigmoid(sure)
        both = (place.confidence > 0.5) & (confidence > 0.5)
        move = jnp.clip((centre - place.centre_m) / view.elapsed_s, -self.max_speed_m_s, self.max_speed_m_s)
        velocity = jnp.where(both, 0.5 * place.velocity_m_s + 0.5 * move, 0.0)
        away = jnp.sum(jnp.square(view.points_m - centre[None, None]), axis=-1)
        radius = safe_sqrt(jnp.sum(mask * away) / jnp.maximum(jnp.sum(mask), 1e-6))
        rate = jax.nn.sigmoid(self.logit_size_rate)
        size_m = jnp.where(confidence > 0.5, (1.0 - rate) * place.radius_m + rate * radius, place.radius_m)
        return mask, Place(centre, velocity, confidence, size_m), sure

    def _doubt(self, moved: Float[Array, "*tag"]) -> Float[Array, "*tag"]:
        """Log odds that a claim loses, by the evidence of the tag's reads that it has moved at all, in nats."""
        return self.rest_doubt * jnp.exp(-moved / self.rest_nats)

    def _phase_evidence(
        self, view: View, ranging: Ranging, reads: PhaseReads, phases: PhaseMemory
    ) -> tuple[Float[Array, "height width"], PhaseMemory]:
        """One antenna's evidence by the reads since the last frame, in units of the log odds."""
        noise = PhaseNoise(
            spread_rad2=jnp.exp(2.0 * self.log_phase_spread),
            slack=jnp.exp(self.log_phase_slack),
            outlier=jax.nn.sigmoid(self.logit_phase_outlier),
        )
        rest_spread_rad2 = jnp.exp(2.0 * self.log_phase_rest_spread)
        told, phases = phase_evidence(
            view, ranging, reads, phases, noise, rest_spread_rad2, doubled_angle=self.doubled_angle
        )
        return jnp.exp(self.log_phase_weight) * told, phases

    def _gate(self, radio: RadioWindow, time_s: Float[Array, " window"]) -> Float[Array, ""]:
        """The soft step of Eq. 7, closed as well where the radio knows less than the kernel asks."""
        speed = radio_speed(radio.relative_m, time_s)
        alpha = jnp.exp(self.log_alpha)
        uncertainty = jnp.mean(jnp.square(jnp.where(jnp.isfinite(radio.std_m), radio.std_m, 1e3)))
        gate = velocity_gate(speed, jnp.exp(self.log_v0), jnp.exp(self.log_gate_width))
        return gate * alpha / (alpha + uncertainty)

    def _weighed_evidence(
        self, view: View, radio: RadioWindow, reads: PhaseReads, gates: Float[Array, " antenna"]
    ) -> tuple[Float[Array, "height width"], Float[Array, ""]]:
        """Evidence of all antennas, and the gate that it passes.

        What antennas measure is independent, so their evidence adds up, each behind its own gate; the common gate, which
        Eq. 7 forgets by, is the most open one, and the evidence is given relative to it.
        """
        each = of_each_antenna(functools.partial(self._evidence, view), view.ranging, radio, reads)
        gate = jnp.max(gates)
        return jnp.einsum("a,ahw->hw", gates / jnp.maximum(gate, 1e-6), each), gate

    def _evidence(
        self, view: View, ranging: Ranging, radio: RadioWindow, reads: PhaseReads
    ) -> Float[Array, "height width"]:
        """One antenna's log-likelihood ratio of object against background at each pixel: Eqs. 4-6 and coherence."""
        rho = ranging.rho
        everywhere = jnp.ones(rho.shape, dtype=bool)
        relative = radio.relative_m[None, None]
        profile = jax.nn.sigmoid(self.logit_profile)
        known_m = jnp.where(jnp.isfinite(radio.std_m), radio.std_m, 0.0)
        travelled_m2 = jnp.sum(jnp.square(radio.relative_m - profile * jnp.mean(radio.relative_m)))
        alpha = (
            jnp.exp(self.log_alpha)
            + jnp.exp(self.log_noise_share) * jnp.sum(jnp.square(known_m))
            + jnp.exp(2.0 * self.log_slack) * travelled_m2
        )
        # The mean misfit over the window is profiled out: a single noisy first sample would offset all others.
        offset = profile * jnp.mean(rho - relative, axis=-1, keepdims=True)
        rbf = att_rbf(rho - offset, relative, everywhere, alpha[None, None])
        corr = att_corr(rho, relative, everywhere)
        att = attention(rbf, corr, jax.nn.sigmoid(self.logit_beta))
        # What does not move at all needs no tag to explain it: at rest a pixel is background as far as it can be told.
        still = rho - profile * jnp.mean(rho, axis=-1, keepdims=True)
        at_rest = att_rbf(still, jnp.zeros_like(relative), everywhere, alpha[None, None])
        level = jax.nn.sigmoid(self.logit_background)
        background = level + (1.0 - level) * jax.nn.sigmoid(self.logit_rest) * at_rest
        ratio = log_likelihood_ratio(att, background, jnp.exp(self.log_floor))
        coherent_of = functools.partial(
            coherent_score, reads=reads, time_s=view.time_s, doubled_angle=self.doubled_angle
        )
        score, score_at_rest = coherent_of(ranging.rho_segment), coherent_of(jnp.zeros((1, 1, rho.shape[-1])))
        excess = jax.nn.relu(score_at_rest - self.coherent_level)
        beyond = score - self.coherent_level - jax.nn.sigmoid(self.logit_rest) * excess
        coherent = unpool(view.segments, beyond[..., None] * read_support(reads))[..., 0]
        return jnp.where(ranging.known, ratio + jnp.exp(self.log_coherent_weight) * coherent, 0.0)

    def _update_anchor(
        self,
        view: View,
        evidence: Float[Array, "height width"],
        ranging: Ranging,
        anchor: Anchor,
        radio: RadioWindow,
        gate: Float[Array, ""],
    ) -> tuple[Anchor, Float[Array, "height width"]]:
        """Move one antenna's anchor with its radio, let the segments that agree with the tag vote for its range.

        Also the log density of what the anchor then believes, at each pixel's range.
        """
        heard = jnp.all(jnp.isfinite(radio.std_m))
        drift = jnp.where(heard, jnp.exp(self.log_anchor_drift), lost_drift_m(view.time_s))
        anchor = move_anchor(anchor, radio.relative_m, heard, drift)
        told, _ = pool(view.segments, evidence[..., None], view.valid.astype(evidence.dtype))
        vote = votes(
            anchor,
            ranging.segment_range_m.reshape(-1),
            told.reshape(-1),
            view.segment_mass.reshape(-1) > 1.0,
            jnp.exp(self.log_anchor_width),
            self.anchor_unseen,
        )
        anchor = update_belief(anchor, vote, jnp.exp(self.log_anchor_weight) * gate)
        return anchor, self._near(view, ranging, anchor)

    def _near(self, view: View, ranging: Ranging, anchor: Anchor) -> Float[Array, "height width"]:
        """The log density of what an anchor believes, at each pixel's range."""
        near = log_density(anchor, ranging.distance_m, jnp.exp(self.log_anchor_depth), jnp.exp(self.log_anchor_limit))
        return near * view.valid.astype(near.dtype)

    def _cut(
        self,
        view: View,
        log_odds: Float[Array, "height width"],
        predicted_m: Float[Array, " 3"],
        place: Place,
    ) -> tuple[Float[Array, "height width"], Float[Array, " 3"]]:
        """The soft mask, and the object's centre: log odds with the place prior, cut, kept to one compact thing."""
        width = jnp.exp(self.log_cut_width)
        if self.cut_rule == "cdf_corner":
            mask = cdf_cut(log_odds, view.valid, jnp.asarray(SIGNIFICANCE), 0.1 * width)
            total = jnp.maximum(jnp.sum(mask), 1e-6)
            return mask, jnp.sum(view.points_m * mask[..., None], axis=(0, 1)) / total
        away = jnp.sum(jnp.square(view.points_m - predicted_m[None, None]), axis=-1)
        reach = jnp.exp(self.log_prior_reach) * jnp.maximum(place.radius_m, MIN_RADIUS_M)
        near = jnp.exp(-away / (2.0 * jnp.square(reach)))
        prior = jnp.exp(self.log_prior_weight) * jax.nn.relu(2.0 * place.confidence - 1.0) * (2.0 * near - 1.0)
        return compact_cut(
            view.points_m,
            view.valid,
            log_odds + prior,
            level=self.cut,
            share=jax.nn.sigmoid(self.logit_cut_share),
            margin=jnp.exp(self.log_cut_margin),
            width=width,
            extent_m=jnp.exp(self.log_extent),
        )
