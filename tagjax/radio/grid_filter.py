"""An exact Bayes filter for phase reads on a grid over (distance modulo half a wavelength) x (radial velocity).

The state lives on a circle, so nothing is ever unwrapped: pi flips, outliers and gaps are alternatives that the
filter keeps open until later reads decide. The unwrapped path follows from the filter's own prediction.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..core.numerics import SPEED_OF_LIGHT_M_S, safe_atan2, wrap_to_pi
from .reads import PhaseReads


class RadioModel(eqx.Module):
    """What the robust estimator assumes. Arrays are differentiable; the grid is static."""

    multipath_rad: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.15)
    flip_share: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.05)
    outlier_share: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.02)
    velocity_walk_m2_s3: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=2.0)
    acceleration_m_s2: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=3.0)
    slope_rad_hz: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.0)
    hop_rad: Float[Array, ""] = eqx.field(converter=lambda x: jnp.asarray(x, jnp.float32), default=0.1)
    max_speed_m_s: float = eqx.field(static=True, default=2.4)
    num_velocities: int = eqx.field(static=True, default=49)
    num_phases: int = eqx.field(static=True, default=48)


class FilteredPath(eqx.Module):
    """The filter's unwrapped path after every read."""

    distance_m: Float[Array, " reads"]
    velocity_m_s: Float[Array, " reads"]
    velocity_std_m_s: Float[Array, " reads"]


def reference_carrier(reads: PhaseReads) -> Float[Array, ""]:
    """Mean carrier of the valid reads, Hz: what the circle of the filter is measured with."""
    weight = reads.valid.astype(reads.carrier_hz.dtype)
    mean = jnp.sum(weight * reads.carrier_hz) / jnp.maximum(jnp.sum(weight), 1.0)
    return jnp.where(jnp.sum(weight) > 0, mean, 915e6)


def level_phase(reads: PhaseReads, model: RadioModel, reference_hz: Float[Array, ""]) -> Float[Array, " reads"]:
    """Phases with the affine channel offset slope * (f - f_reference) taken out."""
    return reads.phase_rad - model.slope_rad_hz * (reads.carrier_hz - reference_hz)


def _fourier(size: int) -> tuple[np.ndarray, np.ndarray]:
    """The real Fourier transform of `size` values, cosine parts before sine parts, and its inverse, as matrices.

    At this size products take no longer than a fast transform, which in a loop on few cores can wait for ever: XLA's (jaxlib
    0.10) waits on a thread of the pool that its own threads come from.
    """
    forward = np.fft.rfft(np.eye(size), axis=0)
    back = np.fft.irfft(np.concatenate([np.eye(len(forward)), -1j * np.eye(len(forward))], axis=1), size, axis=0)
    return np.concatenate([forward.real, -forward.imag]), back


def filter_reads(reads: PhaseReads, model: RadioModel) -> FilteredPath:
    """Run the filter over reads in order of time; invalid reads repeat the value before them.

    Likelihood of a read: von Mises around the predicted phase with the read's thermal noise and the multipath ripple,
    a share of it turned by pi, a share of it anywhere. Between reads the circle turns by 4 pi f v dt / c (exactly, in
    the Fourier domain) and velocity diffuses (exactly, in the cosine basis of the grid). At a channel change the
    circle is blurred by what the affine offset model leaves open.
    """
    num_phases, num_velocities = model.num_phases, model.num_velocities
    dtype = reads.time_s.dtype
    velocity = jnp.linspace(-model.max_speed_m_s, model.max_speed_m_s, num_velocities, dtype=dtype)
    spacing = 2 * model.max_speed_m_s / (num_velocities - 1)
    theta = jnp.arange(num_phases, dtype=dtype) * (2 * np.pi / num_phases)
    harmonic = jnp.arange(num_phases // 2 + 1, dtype=dtype)
    to_harmonics, from_harmonics = (jnp.asarray(matrix, dtype) for matrix in _fourier(num_phases))
    # Eigenbasis of the reflecting diffusion on the velocity grid: cosines.
    k = np.arange(num_velocities)
    cosines = np.cos(np.pi * k[:, None] * (k[None, :] + 0.5) / num_velocities)
    cosines /= np.linalg.norm(cosines, axis=1, keepdims=True)
    basis = jnp.asarray(cosines, dtype)
    decay = jnp.asarray(2.0 - 2.0 * np.cos(np.pi * k / num_velocities), dtype) / spacing**2
    reference = reference_carrier(reads)
    wavenumber = 4 * jnp.pi * reference / SPEED_OF_LIGHT_M_S
    phase = level_phase(reads, model, reference)
    kappa = 1.0 / (jnp.square(reads.sigma_rad) + model.multipath_rad**2)

    def advance(carry, read):
        belief, distance, last_time, last_channel, started = carry
        time, angle, carrier, concentration, channel, valid = read
        gap = jnp.where(started, jnp.maximum(time - last_time, 0.0), 0.0)
        cosine, sine = jnp.split(to_harmonics @ belief, 2)
        turn = harmonic[:, None] * (wavenumber * gap * velocity)[None, :]
        blur = jnp.where((channel != last_channel) & started, model.hop_rad, 0.0)
        damp = jnp.exp(-0.5 * jnp.square(harmonic * blur))[:, None]
        along, across = damp * jnp.cos(turn), damp * jnp.sin(turn)
        predicted = from_harmonics @ jnp.concatenate([cosine * along - sine * across, sine * along + cosine * across])
        spread = jnp.exp(-0.5 * model.velocity_walk_m2_s3 * gap * decay)
        predicted = jnp.maximum(((predicted @ basis.T) * spread[None, :]) @ basis, 0.0) + 1e-9
        mean_velocity = jnp.sum(predicted * velocity[None, :]) / jnp.sum(predicted)
        ahead = distance + mean_velocity * gap
        # The affine offset holds at the first distance; what the tag moved since tilts it by 4 pi (f - f0) x / c.
        level = angle - (4 * jnp.pi / SPEED_OF_LIGHT_M_S) * (carrier - reference) * ahead
        away = level - theta
        bump = jnp.exp(concentration * (jnp.cos(away) - 1.0))
        flipped = jnp.exp(concentration * (-jnp.cos(away) - 1.0))
        norm = jnp.sqrt(concentration / (2 * jnp.pi))
        likelihood = (1 - model.outlier_share) * norm * (
            (1 - model.flip_share) * bump + model.flip_share * flipped
        ) + model.outlier_share / (2 * jnp.pi)
        posterior = predicted * likelihood[:, None]
        posterior = posterior / jnp.sum(posterior)
        marginal = jnp.sum(posterior, axis=1)
        centre = safe_atan2(jnp.sum(marginal * jnp.sin(theta)), jnp.sum(marginal * jnp.cos(theta)))
        # The first read sets the zero: the circle then reads 4 pi f x / c directly.
        aligned = jnp.where(started, ahead + wrap_to_pi(centre - wavenumber * ahead) / wavenumber, centre / wavenumber)
        mean = jnp.sum(posterior * velocity[None, :])
        std = jnp.sqrt(jnp.sum(posterior * jnp.square(velocity - mean)[None, :]) + 1e-9)
        use = valid
        state = (
            jnp.where(use, posterior, belief),
            jnp.where(use, aligned, distance),
            jnp.where(use, time, last_time),
            jnp.where(use, channel, last_channel),
            started | valid,
        )
        return state, (state[1], mean, std)

    uniform = jnp.full((num_phases, num_velocities), 1.0 / (num_phases * num_velocities), dtype)
    zero = jnp.zeros((), dtype)
    first = (uniform, zero, zero, jnp.asarray(-1, reads.channel.dtype), jnp.asarray(False))
    _, (distance, mean, std) = jax.lax.scan(
        advance, first, (reads.time_s, phase, reads.carrier_hz, kappa, reads.channel, reads.valid)
    )
    return FilteredPath(distance, mean, std)
