"""An antenna's position from the phases of a tag that is moved along a known path.

Read r of a tag at p_r has the phase phi_r = 4 pi f_r |p_r - a| / c + offset + noise, with one offset for each group of reads
(a channel, or a dwell) and possibly an extra pi. The position a minimises

    sum_r rho( wrap(m (phi_r - 4 pi f_r |p_r - a| / c - s f_r) - o_g) / (m sigma_r) ) ,

with m = 2 where phases count modulo pi, rho flat for outliers, and o_g the direction of group g's mean phasor at a: the
offsets are profiled out. The slope s of the offsets by frequency is fitted where one group has several carriers, else it is 0.
Only changes of the distance count. So the path must go about in space: along a line, or about the antenna at one distance, some
direction stays unknown, and motion in a plane leaves the two sides of that plane alike.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from ..core.numerics import safe_atan2, safe_norm, wrap_to_pi
from .coherence import coherence, phase_residual

SLOPE_UNIT_RAD_HZ = 1e-7
"""The slope is fitted in this unit: 0.1 rad/MHz."""

_SLOPE_STD = 10.0  # prior of the slope, in that unit: readers have 3 to 4
_KNEE = 2.5  # residuals beyond it, in standard deviations, count less
_UNKNOWN_M = 10.0  # prior of the position about its start, which bounds a direction that nothing determines


class PathReads(eqx.Module):
    """Reads of a tag, each with the tag's position at that time.

    Phases grow with distance. `group` numbers the reads that share an offset from 0; `cluster` those whose errors are not
    independent (of one dwell, say), from 0.
    """

    phase_rad: Float[Array, " reads"]
    carrier_hz: Float[Array, " reads"]
    sigma_rad: Float[Array, " reads"]
    position_m: Float[Array, "reads 3"]
    group: Int[Array, " reads"]
    cluster: Int[Array, " reads"]
    num_groups: int = eqx.field(static=True)
    num_clusters: int = eqx.field(static=True)
    multiple: int = eqx.field(static=True)  # m: 2 where phases count modulo pi, else 1


class AntennaPosition(eqx.Module):
    """A fitted position, camera frame, metres.

    `covariance_m2` is the larger one of that of independent noise and that which allows for errors in common within a
    cluster (the sandwich estimator; Liang and Zeger, 1986). Errors of the path in common to all reads are not in it.
    """

    position_m: Float[Array, " 3"]
    covariance_m2: Float[Array, "3 3"]
    slope_rad_hz: Float[Array, ""]
    noise_rad: Float[Array, ""]  # root mean square of the residuals, outliers left out
    cost: Float[Array, ""]  # mean of the flattened squared residuals
    converged: Bool[Array, ""]

    @property
    def std_m(self) -> Float[Array, " 3"]:
        """Standard deviation of each coordinate."""
        return jnp.sqrt(jnp.diagonal(self.covariance_m2))


def position_coherence(reads: PathReads, positions_m: Float[Array, "candidates 3"]) -> Float[Array, " candidates"]:
    """Coherence of the reads with the distances to each position, 0 to 1 (`radio.coherence`); offsets have no slope."""

    def one(position_m: Float[Array, " 3"]) -> Float[Array, ""]:
        left = phase_residual(reads.phase_rad, reads.carrier_hz, safe_norm(reads.position_m - position_m[None]))
        return coherence(left, jnp.ones_like(left), reads.group, num_channels=reads.num_groups, multiple=reads.multiple)

    return jax.lax.map(one, positions_m, batch_size=64)


def _residuals(reads: PathReads, unknown: Float[Array, " 4"]) -> Float[Array, " reads"]:
    """Phase residuals over their standard deviation; `unknown` are x, y, z and the slope in its unit."""
    centred_hz = reads.carrier_hz - jnp.mean(reads.carrier_hz)
    left = phase_residual(reads.phase_rad, reads.carrier_hz, safe_norm(reads.position_m - unknown[None, :3]))
    angle = reads.multiple * (left - SLOPE_UNIT_RAD_HZ * unknown[3] * centred_hz)
    weight = 1.0 / jnp.square(reads.sigma_rad)

    def of_groups(values: Float[Array, " reads"]) -> Float[Array, " groups"]:
        return jax.ops.segment_sum(weight * values, reads.group, reads.num_groups)

    offset = safe_atan2(of_groups(jnp.sin(angle)), of_groups(jnp.cos(angle)))
    return wrap_to_pi(angle - offset[reads.group]) / (reads.multiple * reads.sigma_rad)


def fit_position(
    reads: PathReads, start_m: Float[Array, " 3"], start_slope_rad_hz: Float[Array, ""], *, max_steps: int = 64
) -> AntennaPosition:
    """The position from a start whose distances are right to a fraction of a wavelength: Levenberg-Marquardt (Optimistix)."""
    start = jnp.concatenate([start_m, (start_slope_rad_hz / SLOPE_UNIT_RAD_HZ)[None]])

    def flattened(unknown: Float[Array, " 4"], _: None) -> Float[Array, " residuals"]:
        left = _residuals(reads, unknown)
        flat = left / jnp.power(1.0 + jnp.square(left / _KNEE), 0.25)
        near = jnp.concatenate([(unknown[:3] - start[:3]) / _UNKNOWN_M, unknown[3:] / _SLOPE_STD])
        return jnp.concatenate([flat, near])

    solver = optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)
    solution = optx.least_squares(flattened, solver, start, throw=False, max_steps=max_steps)
    left = _residuals(reads, solution.value)
    kept = (jnp.abs(left) < 2 * _KNEE).astype(left.dtype)
    noise = jnp.sqrt(jnp.sum(kept * jnp.square(left * reads.sigma_rad)) / jnp.maximum(jnp.sum(kept), 1.0))
    return AntennaPosition(
        position_m=solution.value[:3],
        covariance_m2=_covariance(reads, flattened, solution.value),
        slope_rad_hz=SLOPE_UNIT_RAD_HZ * solution.value[3],
        noise_rad=noise,
        cost=jnp.mean(jnp.square(flattened(solution.value, None)[: left.shape[0]])),
        converged=solution.result == optx.RESULTS.successful,
    )


def _covariance(reads: PathReads, flattened, unknown: Float[Array, " 4"]) -> Float[Array, "3 3"]:
    """The larger one of both covariances, by their traces."""
    number = reads.phase_rad.shape[0]
    jacobian, value = jax.jacfwd(flattened)(unknown, None), flattened(unknown, None)
    bread = jnp.linalg.inv(jacobian.T @ jacobian)
    freedom = max(number - reads.num_groups - 4, 1)
    independent = bread * jnp.maximum(jnp.sum(jnp.square(value[:number])) / freedom, 1.0)
    scores = jax.ops.segment_sum(jacobian[:number] * value[:number, None], reads.cluster, reads.num_clusters)
    few = reads.num_clusters / max(reads.num_clusters - 4, 1)
    clustered = few * bread @ (scores.T @ scores) @ bread
    larger = jnp.trace(clustered[:3, :3]) > jnp.trace(independent[:3, :3])
    return jnp.where(larger, clustered, independent)[:3, :3]
