"""Goller et al.'s antenna model (III.A, III.D): one Gaussian an antenna over the floor, fitted to RSSI on a tag
grid.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float

POWER_SCALE_DB = float(10.0 / np.log(10.0))
"""exp(RSSI / 4.34 dB) is the received power in milliwatts: weights are then ratios of powers."""

FLOOR_DBM = -80.0
"""The RSSI that a response of 0 stands for: just below the weakest read of the logs (-77.5 dBm)."""

_START_M = 1.0  # initial extent of the fit: the radius of an antenna's beam of 60 degrees on the floor, 2.5 m below


class AntennaModel(eqx.Module):
    """Gaussian interrogation zones on the floor: means mu_i and covariances Sigma_i = L L^T, room frame, metres.

    L = [[exp s_0, 0], [q, exp s_1]]. `log_peak_db` and `floor_dbm` give the RSSI of a tag at the mean; the likelihood
    does not use them.
    """

    mean_m: Float[Array, "antennas 2"]
    log_scale_m: Float[Array, "antennas 2"]  # s
    skew_m: Float[Array, " antennas"]  # q
    log_peak_db: Float[Array, " antennas"]
    floor_dbm: Float[Array, ""]


def covariance_m2(model: AntennaModel) -> Float[Array, "antennas 2 2"]:
    """Sigma_i of every antenna, square metres."""
    first, second = jnp.exp(model.log_scale_m[:, 0]), jnp.exp(model.log_scale_m[:, 1])
    lower = jnp.stack([jnp.stack([first, jnp.zeros_like(first)], -1), jnp.stack([model.skew_m, second], -1)], axis=-2)
    return lower @ jnp.swapaxes(lower, -1, -2)


def _squared_distance(model: AntennaModel, point_m: Float[Array, " 2"]) -> Float[Array, " antennas"]:
    """(x - mu)^T Sigma^-1 (x - mu), by forward substitution."""
    offset = point_m[None] - model.mean_m
    first = offset[:, 0] * jnp.exp(-model.log_scale_m[:, 0])
    second = (offset[:, 1] - model.skew_m * first) * jnp.exp(-model.log_scale_m[:, 1])
    return jnp.square(first) + jnp.square(second)


def log_component(model: AntennaModel, point_m: Float[Array, " 2"]) -> Float[Array, " antennas"]:
    """log g(x | mu_i, Sigma_i) of every antenna, g in 1/m^2."""
    return -0.5 * _squared_distance(model, point_m) - jnp.sum(model.log_scale_m, axis=1) - jnp.log(2.0 * jnp.pi)


def response_db(model: AntennaModel, point_m: Float[Array, " 2"]) -> Float[Array, " antennas"]:
    """Modelled RSSI above the floor of a tag at a point, for each antenna, dB: the fitted Gaussian."""
    return jnp.exp(model.log_peak_db - 0.5 * _squared_distance(model, point_m))


def antenna_weights(
    rssi_dbm: Float[Array, " antennas"], received: Bool[Array, " antennas"], scale_db: Float[Array, ""]
) -> Float[Array, " antennas"]:
    """w_i of Eq. 1, which sum to 1: proportional to exp(RSSI / scale), 0 for antennas that did not receive the tag.

    `POWER_SCALE_DB` makes them proportional to the received power. The paper leaves the unit open and asks for
    weights that do not change when the tag's orientation weakens it at all antennas: these depend on differences in dB
    only. All are 0 where no antenna received the tag.
    """
    known_dbm = jnp.where(received, rssi_dbm, 0.0)
    strongest = jax.lax.stop_gradient(jnp.max(jnp.where(received, rssi_dbm, -jnp.inf), initial=-jnp.inf))
    exponent = (known_dbm - jnp.where(jnp.isfinite(strongest), strongest, 0.0)) / scale_db
    strength = jnp.where(received, jnp.exp(jnp.where(received, exponent, 0.0)), 0.0)
    total = jnp.sum(strength)
    return jnp.where(total > 0, strength / jnp.where(total > 0, total, 1.0), 0.0)


def mixture_likelihood(
    model: AntennaModel, weights: Float[Array, " antennas"], points_m: Float[Array, "points 2"]
) -> Float[Array, " points"]:
    """P(x | z) = sum_i w_i g(x | mu_i, Sigma_i) (Eq. 1) at points of the floor, 1/m^2; 0 where all weights are 0."""
    return jax.vmap(lambda point: jnp.sum(weights * jnp.exp(log_component(model, point))))(points_m)


def fit_antennas(
    position_m: Float[np.ndarray, "points 2"],
    mean_rssi_dbm: Float[np.ndarray, "points antennas"],
    antenna_m: Float[np.ndarray, "antennas 2"],
    *,
    floor_dbm: float = FLOOR_DBM,
    fit_means: bool = False,
) -> AntennaModel:
    """Fit a Gaussian to each antenna's RSSI above the floor over the points of a tag grid (III.D), by least squares.

    NaN stands for no read there: a response of 0, which limits the extent of the zone. The means stay at the known
    positions of the antennas, as in the paper, unless `fit_means`. Solved by Optimistix' Levenberg-Marquardt. Raises
    `ValueError` where an antenna received the tag at fewer than 5 points, or all points lie on a line.
    """
    num_received = np.sum(np.isfinite(mean_rssi_dbm), axis=0)
    for antenna, count in enumerate(num_received, start=1):
        if count < 5:
            raise ValueError(
                f"Antenna {antenna} received the tag at {count} of {len(position_m)} points of the grid, expected at least 5 for "
                "a Gaussian. Use a finer grid, or leave the antenna out."
            )
    spread = np.linalg.svd(position_m - position_m.mean(axis=0), compute_uv=False)
    if spread[-1] < 1e-3 * max(spread[0], 1e-9):
        raise ValueError(
            "All points of the grid lie on a line, expected a grid in two directions. Record more rows of the grid."
        )
    above = np.clip(np.where(np.isfinite(mean_rssi_dbm), mean_rssi_dbm - floor_dbm, 0.0), 0.0, None)
    points, target = jnp.asarray(position_m, jnp.float32), jnp.asarray(above, jnp.float32)
    num = antenna_m.shape[0]
    start = AntennaModel(
        mean_m=jnp.asarray(antenna_m, jnp.float32),
        log_scale_m=jnp.full((num, 2), np.log(_START_M), jnp.float32),
        skew_m=jnp.zeros(num, jnp.float32),
        log_peak_db=jnp.asarray(np.log(np.maximum(above.max(axis=0), 1.0)), jnp.float32),
        floor_dbm=jnp.asarray(floor_dbm, jnp.float32),
    )
    where = lambda m: (m.log_scale_m, m.skew_m, m.log_peak_db, *((m.mean_m,) if fit_means else ()))  # noqa: E731

    def residuals(free, _: None) -> Float[Array, " residuals"]:
        model = eqx.tree_at(where, start, free)
        return (jax.vmap(lambda point: response_db(model, point))(points) - target).reshape(-1)

    solver = optx.LevenbergMarquardt(rtol=1e-4, atol=1e-4)
    solution = optx.least_squares(residuals, solver, where(start), max_steps=200, throw=False)
    fitted = eqx.tree_at(where, start, solution.value)
    leaves = jax.tree.leaves(eqx.filter(fitted, eqx.is_array))
    if not all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in leaves):
        raise ValueError(
            "The fit of the antennas did not converge to finite values. Look for outliers in the grid's RSSI."
        )
    return fitted
