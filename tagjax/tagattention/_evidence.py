"""What one frame's radio says of every pixel: attention and coherence behind the velocity gate, and raw phases."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..radio.reads import PhaseReads, RadioWindow
from ._fields import AbstractTagAttention
from .attention import att_corr, att_rbf, attention, coherent_score, read_support
from .phase_memory import PhaseMemory, phase_evidence
from .phases import PhaseNoise
from .propagation import log_likelihood_ratio, radio_speed, velocity_gate
from .segmentation import unpool
from .view import Ranging, View, of_each_antenna


class AbstractEvidence(AbstractTagAttention):
    """Log-likelihood ratios of object against background (Eqs. 4-7) by the parameters, for one tag at a time."""

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
