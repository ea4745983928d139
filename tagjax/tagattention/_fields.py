"""The learnable tracer's parameters as its stages see them."""

from __future__ import annotations

from typing import Literal

import equinox as eqx
from jaxtyping import Array, Float

from ..tracing.tracer import AbstractSmoother


class AbstractTagAttention(AbstractSmoother):
    """What the learnable TagAttention's stages go by, as it is stored; `TagAttention` tells what each is.

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
    log_fate_weight: Float[Array, ""]
    log_fate_spread: Float[Array, ""]
    log_fate_slack: Float[Array, ""]
    log_rivalry: Float[Array, ""]
    rest_doubt: Float[Array, ""]

    rest_nats: float = eqx.field(static=True)
    cell: int = eqx.field(static=True)
    max_speed_m_s: float = eqx.field(static=True)
    box_tail: float = eqx.field(static=True)
    doubled_angle: bool = eqx.field(static=True)
    anchor_bins: int = eqx.field(static=True)
    cut_rule: Literal["margin", "cdf_corner"] = eqx.field(static=True)
