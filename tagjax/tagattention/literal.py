"""TagAttention to the letter (Shi et al., 2021, III.E-G): Eqs. 3-7, CDF-corner cut, K-means refinement.

What the paper leaves open is fixed here and named: missing depth gets no attention; attentions below `FLOOR` count as
`FLOOR` (Eq. 7 takes a logarithm); a corner is a rise of the histogram by `SIGNIFICANCE` of the pixels.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from ..core.parameters import check_fractions, check_positive, check_positive_integers
from ..image.warp import splat
from ..tracing.tracer import AbstractTracer, Camera, Frame, Trace
from .attention import att_corr, att_rbf, attention, centre_first
from .frame_trace import describe
from .motion import MotionMap, empty_motion, push_splat
from .propagation import log_likelihood_ratio, propagate, radio_speed, velocity_gate
from .segmentation import cdf_cut, pool, segment, unpool

FLOOR = 1e-6
SIGNIFICANCE = 1e-3
_HARD = 1e-6


class LiteralState(eqx.Module):
    """Motion map, frame times of the window, and the refined log-likelihood maps."""

    motion: MotionMap
    time_s: Float[Array, " window"]
    log_likelihood: Float[Array, "tag height width"]


class TagAttentionLiteral(AbstractTracer):
    """Eqs. 3-7 with the paper's constants. `softness` > 0 relaxes every hard step; 0 is the paper."""

    alpha_m2: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=5e-4)
    beta: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.8)
    v0_m_s: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.1)
    forgetting: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=1.0)
    softness: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.0)
    cell: int = eqx.field(static=True, default=8)
    refine: bool = eqx.field(static=True, default=True)

    def __check_init__(self) -> None:
        # What is being traced has no value yet.
        told = {name: leaf for name, leaf in vars(self).items() if not isinstance(leaf, Tracer)}
        check_positive(**{name: round(float(told[name]), 9) for name in told.keys() & {"alpha_m2"}})
        check_fractions(**{name: round(float(told[name]), 6) for name in told.keys() & {"beta", "forgetting"}})
        for name in told.keys() & {"v0_m_s", "softness"}:
            if not told[name] >= 0:
                raise ValueError(f"{name} is {told[name]:g}; expected at least 0.")
        check_positive_integers(cell=self.cell)

    def init(self, camera: Camera, frame: Frame) -> LiteralState:
        height, width = frame.depth_m.shape
        num_tags, num_antennas, num_window = frame.radio.relative_m.shape
        if num_antennas != 1:
            raise ValueError(
                f"The paper's tracer knows one antenna; the clip has {num_antennas}. Set clips.antennas=busiest, or to one of them."
            )
        return LiteralState(
            motion=empty_motion(height, width, num_window),
            time_s=jnp.broadcast_to(frame.time_s, (num_window,)),
            log_likelihood=jnp.zeros((num_tags, height, width)),
        )

    def step(self, camera: Camera, state: LiteralState, frame: Frame) -> tuple[LiteralState, Trace]:
        points = camera.rays * frame.depth_m[..., None]
        valid = frame.depth_m > 0
        distance = jnp.where(valid, camera.ranges_m(points)[0], 0.0)
        time_s = jnp.concatenate([state.time_s[1:], frame.time_s[None]])
        motion = push_splat(state.motion, frame.forward_px, distance)
        rho = centre_first(motion.distance_m, motion.valid)
        full = jnp.all(motion.valid, axis=-1)
        warped, filled = splat(jnp.moveaxis(state.log_likelihood, 0, -1), frame.forward_px)
        # A hole has no past: it starts at the likelihood of the worst pixel, not at 0, which would be the best.
        lowest = jnp.min(state.log_likelihood, axis=(1, 2))
        warped = jnp.moveaxis(jnp.where(filled[..., None], warped, lowest), -1, 0)
        segments = segment(points, valid, 1e-3 + 0.05 * self.softness, cell=self.cell)
        width = _HARD + self.softness

        def one_tag(carried, radio):
            rd = radio.relative_m[:, None]
            att = attention(
                att_rbf(rho, rd, motion.valid, self.alpha_m2[None, None]), att_corr(rho, rd, motion.valid), self.beta
            )
            evidence = log_likelihood_ratio(jnp.where(full, att, 0.0), jnp.ones(()), jnp.asarray(FLOOR))
            known = jnp.all(jnp.isfinite(radio.std_m))
            gate = velocity_gate(radio_speed(radio.relative_m[0], time_s), self.v0_m_s, 0.1 * width)
            gate = gate * known.astype(gate.dtype)
            likelihood = propagate(carried, evidence, gate, self.forgetting)
            if self.refine:
                pooled, _ = pool(segments, likelihood[..., None], valid.astype(likelihood.dtype))
                likelihood = jnp.where(valid, unpool(segments, pooled)[..., 0], likelihood)
            return likelihood, cdf_cut(likelihood, valid, jnp.asarray(SIGNIFICANCE), 0.01 * width)

        likelihood, mask = jax.vmap(one_tag)(warped, frame.radio)
        total = jnp.maximum(jnp.sum(mask, axis=(1, 2)), 1e-6)
        centre = jnp.einsum("thw,hwc->tc", mask, points) / total[:, None]
        recent = motion.valid[..., -1] & motion.valid[..., -2]
        step_m = jnp.where(recent, motion.distance_m[..., -1] - motion.distance_m[..., -2], 0.0)
        return LiteralState(motion, time_s, likelihood), describe(mask, centre, step_m[None], recent)

    def finish(self, state: LiteralState) -> LiteralState:
        return state
