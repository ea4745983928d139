"""TagAttention as a learnable tracer: the paper's stages, each hard step relaxed, each constant a parameter.

Per frame: the motion map slides (Eq. 3); pixels are grouped into 3D segments; attention compares each one's motion
with the tag's (Eqs. 4-6), and coherence and phase memory with the raw phase reads; the log-odds map is carried along the
flow and updated (Eq. 7 with a background class and forgetting), pooled in the segments (III.G), and cut.

What goes beyond the paper: the range anchor, by which all of the past says how far away the tag is now; a memory of
the still background; tags that compete for pixels; an object is one compact thing in 3D, next to where it was a frame ago,
and moves in space as one. `paper_limit` gives the settings at which all of it is gone and the likelihood and the cut are
the paper's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

import jax.numpy as jnp

from ..core.parameters import (
    check_positive,
    check_shares,
    check_whole,
    physical,
    stored_log,
    stored_logit,
    with_physical,
)
from ._stages import AbstractStages


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
        "fate_weight": nothing,
        "rivalry": nothing,
        "rest_doubt": 0.0,
        "cut_rule": "cdf_corner",
        "cut_width": 1e-7,
    }


class TagAttention(AbstractStages):
    """The learnable TagAttention (Shi et al., ToN 2021, Eqs. 3-7 and III.G, each hard step relaxed)."""

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
        fate_weight: float = 0.001,
        fate_spread_m: float = 0.015,
        fate_slack: float = 0.25,
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
            phase_weight: weight of the phase evidence (`tagjax.tagattention.phases`), whose reads count once each.
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
            fate_weight: share of the evidence of common fate in space (`tagjax.tagattention.common_fate`) that counts, a frame.
            fate_spread_m, fate_slack: how far apart parts of one thing may come over the window, m, and as a share of its
                own way.
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
            fate_weight=fate_weight,
            fate_spread_m=fate_spread_m,
            fate_slack=fate_slack,
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
        self.log_fate_weight, self.log_fate_slack = stored_log(fate_weight), stored_log(fate_slack)
        self.log_fate_spread = stored_log(fate_spread_m)
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
