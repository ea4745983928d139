"""Least-squares refinement of a tag's distance at given times, with implicit gradients and covariance."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from ..core.numerics import SPEED_OF_LIGHT_M_S, wrap_to_pi
from .bayes_filter import RadioModel, remove_channel_slope
from .reads import PhaseReads

_OFFSET_STD_RAD = 10.0
_WALK_STD_M = 10.0


class RefinedPath(eqx.Module):
    """Distance at the knots relative to the first knot, metres, with its covariance, square metres."""

    relative_m: Float[Array, " knots"]
    covariance_m2: Float[Array, "knots knots"]


def interpolation_weights(
    query_s: Float[Array, " query"], knot_s: Float[Array, " knots"]
) -> Float[Array, "query knots"]:
    """Weights of linear interpolation between knots in order of time; outside, the end knot is repeated."""
    upper = jnp.clip(jnp.searchsorted(knot_s, query_s), 1, knot_s.shape[0] - 1)
    span = knot_s[upper] - knot_s[upper - 1]
    fraction = jnp.clip((query_s - knot_s[upper - 1]) / jnp.where(span > 0, span, 1.0), 0.0, 1.0)
    one_hot = jax.nn.one_hot
    size = knot_s.shape[0]
    return (1.0 - fraction)[:, None] * one_hot(upper - 1, size, dtype=query_s.dtype) + fraction[:, None] * one_hot(
        upper, size, dtype=query_s.dtype
    )


def refine_path(
    reads: PhaseReads,
    knot_s: Float[Array, " knots"],
    start_m: Float[Array, " knots"],
    reference_hz: Float[Array, ""],
    model: RadioModel,
    *,
    max_steps: int = 8,
) -> RefinedPath:
    """Maximum a posteriori distance at the knots, linear in between, from reads and a start within half a cycle.

    `start_m` counts from the first read, as the filter's distances do: the distance moved before the window shifts phases by
    4 pi f_r x / c, which differs by 1 rad a metre between the ends of FCC's band.
    Residuals: (phi_r - 4 pi f_r x(t_r) / c - offset) wrapped modulo pi (so that pi flips have no effect) over the
    read's noise, flattened for outliers; second differences of the knots over the acceleration prior. Solved by
    Levenberg-Marquardt (Optimistix) with implicit gradients; the covariance is the Laplace approximation.
    """
    import optimistix as optx  # a third of a second, which a live stream does not need

    dtype = knot_s.dtype
    weights = interpolation_weights(reads.time_s, knot_s)
    wavenumber = (4 * jnp.pi / SPEED_OF_LIGHT_M_S) * reads.carrier_hz
    # The path begins at 0, but not so the channels' phases: what was moved before tilts them.
    moved_before = wavenumber * start_m[0]
    level = remove_channel_slope(reads, model, reference_hz) - moved_before
    sigma = jnp.sqrt(jnp.square(reads.sigma_rad) + model.multipath_rad**2)
    inside = reads.valid & (reads.time_s >= knot_s[0]) & (reads.time_s <= knot_s[-1])
    precision = jnp.where(inside, 1.0 / sigma, 0.0)
    gap = jnp.maximum(jnp.diff(knot_s), 1e-3)
    # The phase offset of the start is the circular mean of the reads' residuals modulo pi.
    doubled = 2.0 * (level - wavenumber * (weights @ (start_m - start_m[0])))
    offset = 0.5 * jnp.arctan2(
        jnp.sum(precision * jnp.sin(doubled)), jnp.sum(precision * jnp.cos(doubled)) + jnp.asarray(1e-12, dtype)
    )

    def residuals(unknown: Float[Array, " unknowns"], _: None) -> Float[Array, " residuals"]:
        path = jnp.concatenate([jnp.zeros(1, dtype), unknown[:-1]])
        phase = precision * wrap_to_pi(level - wavenumber * (weights @ path) - unknown[-1], jnp.pi)
        flattened = phase / jnp.power(1.0 + jnp.square(phase / 2.5), 0.25)
        velocity = jnp.diff(path) / gap
        bend = jnp.diff(velocity) / (0.5 * (gap[1:] + gap[:-1]) * model.acceleration_m_s2)
        ends = jnp.stack([path[-1] / _WALK_STD_M, unknown[-1] / _OFFSET_STD_RAD])
        return jnp.concatenate([flattened, bend, ends])

    start = jnp.concatenate([start_m[1:] - start_m[0], (offset + jnp.zeros((), dtype))[None]])
    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
    solution = optx.least_squares(residuals, solver, jax.lax.stop_gradient(start), throw=False, max_steps=max_steps)
    jacobian = jax.jacfwd(residuals)(solution.value, None)
    size = start.shape[0]
    information = jacobian.T @ jacobian + 1e-6 * jnp.eye(size, dtype=dtype)
    covariance = jnp.linalg.inv(information)[:-1, :-1]
    path = jnp.concatenate([jnp.zeros(1, dtype), solution.value[:-1]])
    return RefinedPath(path, jnp.pad(covariance, ((1, 0), (1, 0))))
