"""TagAttention's own evidence on segments: attention to motion that agrees with the tag's (Eqs. 4-6), propagated by Eq. 7.

With rho a segment's distances over a window of frames, relative to its first, and rd those of the tag as the radio estimates
them,

    a = beta exp(-|rho - rd|^2 / (2 alpha)) + (1 - beta) max(corr(rho, rd), 0) ,    l' = l + step(v - v0) log(a + floor) ,

where v is the tag's speed over the window. Several antennas' evidence adds up. Source: Shi et al., ToN 2021.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from ...core.constrained import Fraction, Positive
from ...radio.reads import RadioWindow
from ..attention import att_corr, att_rbf, attention, centre_first
from ..propagation import log_likelihood_ratio, radio_speed, velocity_gate
from .cells import row_sources


class VelocityGate(eqx.Module):
    """A soft step at a speed: the velocity threshold v0 (Eq. 7)."""

    threshold_m_s: Positive
    width_m_s: Positive

    def __init__(self, *, threshold_m_s: float = 0.1, width_m_s: float = 0.02) -> None:
        """Raises `ValueError` for a speed that is not positive."""
        self.threshold_m_s, self.width_m_s = Positive(threshold_m_s), Positive(width_m_s)

    def open(self, speed_m_s: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
        """From 0 for a slow motion to 1 for a fast one."""
        return velocity_gate(speed_m_s, self.threshold_m_s.value, self.width_m_s.value)


class AttentionState(eqx.Module):
    """The segments' distances over the window, and what has been propagated."""

    distance_m: Float[Array, "antenna segment window"]  # sums of increments
    known: Bool[Array, "segment window"]  # the segment existed, and all its increments since were measured
    time_s: Float[Array, " window"]
    log_likelihood: Float[Array, "tag segment"]

    @staticmethod
    def nothing(
        num_tags: int, num_antennas: int, num_segments: int, num_window: int, time_s: Float[Array, ""]
    ) -> AttentionState:
        """Before the first frame, which is at `time_s`."""
        return AttentionState(
            distance_m=jnp.zeros((num_antennas, num_segments, num_window)),
            known=jnp.zeros((num_segments, num_window), bool),
            time_s=jnp.broadcast_to(time_s, (num_window,)),
            log_likelihood=jnp.zeros((num_tags, num_segments)),
        )

    @property
    def num_window(self) -> int:
        """Frames in the window."""
        return self.time_s.shape[0]


class AttentionEvidence(eqx.Module):
    """Stage of Eqs. 4-7. The defaults are the paper's constants; it gives no floor and no memory."""

    gate: VelocityGate
    alpha_m2: Positive
    beta: Fraction
    floor: Positive  # bounds what one wrong frame can do
    weight: Positive  # of this evidence beside that of the dwells
    memory_s: Positive | None  # the log likelihood decays as exp(-age / memory); None: never

    def __init__(
        self,
        gate: VelocityGate | None = None,
        *,
        alpha_m2: float = 5e-4,
        beta: float = 0.8,
        floor: float = 0.02,
        weight: float = 1.0,
        memory_s: float | None = 4.0,
    ) -> None:
        """Raises `ValueError` for a value that is not positive, or a beta that is not between 0 and 1."""
        self.gate = VelocityGate() if gate is None else gate
        self.alpha_m2, self.beta = Positive(alpha_m2), Fraction(beta)
        self.floor, self.weight = Positive(floor), Positive(weight)
        self.memory_s = None if memory_s is None else Positive(memory_s)

    def step(
        self,
        state: AttentionState,
        radio: RadioWindow,
        increment_m: Float[Array, "antenna segment"],
        known: Bool[Array, " segment"],
        newborn_source: Int[Array, " segment"],
        since_s: Float[Array, ""],
        now_s: Float[Array, ""],
    ) -> tuple[AttentionState, Float[Array, "tag segment"]]:
        """The state after the frame at `now_s`, and the propagated log likelihood, nats.

        `radio` is (tag, antenna, window). `newborn_source` is -2 for a segment that goes on; a newborn one inherits from
        this slot, -1 has no past and the lowest likelihood of all.
        """
        source, new = row_sources(newborn_source), newborn_source == -1
        before_m, was_known = state.distance_m[:, source], state.known[source] & ~new[:, None]
        lowest = jnp.min(state.log_likelihood, axis=1, keepdims=True)
        carried = jnp.where(new[None], lowest, state.log_likelihood[:, source])
        now_m = before_m[..., -1:] + increment_m[..., None]
        distance_m = jnp.concatenate([before_m[..., 1:], now_m], axis=-1)
        # Where this frame's increment is missing nothing connects now with before.
        valid = jnp.concatenate([was_known[:, 1:] & known[:, None], jnp.ones((known.shape[0], 1), bool)], axis=-1)
        time_s = jnp.concatenate([state.time_s[1:], now_s[None]])
        rho_m = centre_first(distance_m, jnp.broadcast_to(valid, distance_m.shape))
        full = jnp.all(valid, axis=-1)

        def of_antenna(rho: Float[Array, "segment window"], rd: Float[Array, " window"]) -> Float[Array, " segment"]:
            alpha = jnp.broadcast_to(self.alpha_m2.value, (1,))
            rbf, corr = att_rbf(rho, rd[None], valid, alpha), att_corr(rho, rd[None], valid)
            agreed = attention(rbf, corr, self.beta.value)
            return log_likelihood_ratio(jnp.where(full, agreed, 0.0), jnp.ones(()), self.floor.value)

        def of_tag(one: RadioWindow, likelihood: Float[Array, " segment"]) -> Float[Array, " segment"]:
            known_radio = jnp.all(jnp.isfinite(one.std_m), axis=-1)
            speed = jax.vmap(lambda rd: radio_speed(rd, time_s))(one.relative_m)
            gates = jnp.where(known_radio, self.gate.open(speed), 0.0)
            evidence = jax.vmap(of_antenna)(rho_m, one.relative_m)
            return likelihood + gates @ evidence

        if self.memory_s is not None:
            carried = carried * jnp.exp(-(now_s - since_s) / self.memory_s.value)
        log_likelihood = jax.vmap(of_tag)(radio, carried)
        return AttentionState(distance_m, valid, time_s, log_likelihood), log_likelihood
