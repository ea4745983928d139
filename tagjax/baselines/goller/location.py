"""Location of a tag: a probability grid of the floor, updated by the antenna mixture (Goller et al., III.A);
velocity.
"""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from .antennas import POWER_SCALE_DB, AntennaModel, antenna_weights, mixture_likelihood

_MIN_LIKELIHOOD = 1e-6  # relative to the highest


class FloorGrid(eqx.Module):
    """Cell centres of a rectangular grid on the floor, room frame, metres."""

    x_m: Float[Array, " columns"]
    y_m: Float[Array, " rows"]

    def points(self) -> Float[Array, "cells 2"]:
        """Centres of all cells; x varies slowest."""
        x, y = jnp.meshgrid(self.x_m, self.y_m, indexing="ij")
        return jnp.stack([x.reshape(-1), y.reshape(-1)], axis=-1)


def make_grid(low_m: tuple[float, float], high_m: tuple[float, float], cell_m: float = 0.2) -> FloorGrid:
    """A grid of about `cell_m` spacing between two corners. Raises `ValueError` for an empty area or cell."""
    if not cell_m > 0 or not (high_m[0] > low_m[0] and high_m[1] > low_m[1]):
        raise ValueError(
            f"Found a floor from {low_m} to {high_m} m in cells of {cell_m} m; expected low below high and a positive cell."
        )
    axes = [
        np.linspace(low, high, max(2, round((high - low) / cell_m) + 1))
        for low, high in zip(low_m, high_m, strict=True)
    ]
    return FloorGrid(*(jnp.asarray(axis, jnp.float32) for axis in axes))


class LocationModel(eqx.Module):
    """The location filter: antennas, random walk, and the weight of one observation."""

    antennas: AntennaModel
    log_scale_db: Float[Array, ""]  # log of the scale of `antenna_weights`
    log_walk_m2_s: Float[Array, ""]  # variance of the random walk, per second and axis
    log_gain_hz: Float[Array, ""]  # independent observations per second
    log_lag_s: Float[Array, ""]  # time constant of the velocity's low-pass


def make_location(
    antennas: AntennaModel,
    *,
    scale_db: float = POWER_SCALE_DB,
    walk_m2_s: float = 1.0,
    gain_hz: float = 8.0,
    lag_s: float = 0.8,
) -> LocationModel:
    """A `LocationModel` from plain values, which must be positive."""
    values = {"scale_db": scale_db, "walk_m2_s": walk_m2_s, "gain_hz": gain_hz, "lag_s": lag_s}
    for name, value in values.items():
        if not value > 0:
            raise ValueError(f"{name} is {value}; expected a positive number.")
    return LocationModel(antennas, *(jnp.asarray(np.log(value), jnp.float32) for value in values.values()))


class Location(eqx.Module):
    """Estimated location of a tag, frame by frame."""

    position_m: Float[Array, "*time 2"]  # mean of the grid's distribution
    std_m: Float[Array, "*time 2"]
    velocity_m_s: Float[Array, "*time 2"]  # Eq. 4
    received: Bool[Array, "*time"]  # an antenna received the tag within the observation period
    known: Bool[Array, "*time"]  # the tag was received at some time up to this frame


def _blur(axis_m: Float[Array, " cells"], variance_m2: Float[Array, ""]) -> Float[Array, "cells cells"]:
    """Column j is the distribution of a tag from cell j after a random walk; columns sum to 1: nothing leaves the
    grid.
    """
    squared_m2 = jnp.square(axis_m[:, None] - axis_m[None, :])
    kernel = jnp.exp(-0.5 * squared_m2 / (variance_m2 + 1e-9))
    return kernel / jnp.sum(kernel, axis=0, keepdims=True)


class LocationState(eqx.Module):
    """State of a tag's location filter after a frame."""

    probability: Float[Array, "columns rows"]  # sums to 1
    mean_m: Float[Array, " 2"]
    velocity_m_s: Float[Array, " 2"]
    known: Bool[Array, ""]


def locate_start(grid: FloorGrid) -> LocationState:
    """Before the first frame: a uniform distribution over the floor, velocity 0."""
    shape = (grid.x_m.shape[0], grid.y_m.shape[0])
    flat = jnp.full(shape, 1.0 / (shape[0] * shape[1]), grid.x_m.dtype)
    middle = jnp.stack([jnp.mean(grid.x_m), jnp.mean(grid.y_m)])
    return LocationState(flat, middle, jnp.zeros_like(middle), jnp.asarray(False))


def locate_step(
    model: LocationModel,
    grid: FloorGrid,
    state: LocationState,
    elapsed_s: Float[Array, ""],
    rssi_dbm: Float[Array, " antennas"],
    received: Bool[Array, " antennas"],
) -> tuple[LocationState, Location]:
    """One frame of the recursive update of III.A, on a grid of the floor.

    b_t ~ (G * b_{t-1}) (P(x | z_t) / max P + 1e-6)^h: G a random walk of `walk` times the frame interval, P the mixture
    of Eq. 1, h = gain times the frame interval, at most 1, since successive observations overlap. Without an
    observation the distribution only widens. The velocity is the mean's derivative (Eq. 4), low-passed; 0 until the tag
    was received.
    """
    walk, gain = jnp.exp(model.log_walk_m2_s), jnp.exp(model.log_gain_hz)
    shape = state.probability.shape
    any_received = jnp.any(received)
    predicted = _blur(grid.x_m, walk * elapsed_s) @ state.probability @ _blur(grid.y_m, walk * elapsed_s).T
    weights = antenna_weights(rssi_dbm, received, jnp.exp(model.log_scale_db))
    likelihood = mixture_likelihood(model.antennas, weights, grid.points()).reshape(shape)
    highest = jnp.max(likelihood)
    relative = jnp.where(any_received, likelihood / jnp.where(highest > 0, highest, 1.0), 1.0) + _MIN_LIKELIHOOD
    # The first observation has full weight: it overlaps no earlier one.
    power = jnp.where(state.known, jnp.clip(gain * elapsed_s, 0.0, 1.0), 1.0)
    updated = predicted * jnp.exp(power * jnp.log(relative))
    probability = updated / jnp.sum(updated)
    in_x, in_y = jnp.sum(probability, axis=1), jnp.sum(probability, axis=0)
    mean = jnp.stack([jnp.sum(in_x * grid.x_m), jnp.sum(in_y * grid.y_m)])
    variance = jnp.stack(
        [jnp.sum(in_x * jnp.square(grid.x_m - mean[0])), jnp.sum(in_y * jnp.square(grid.y_m - mean[1]))]
    )
    moved = state.known & (elapsed_s > 0)
    raw = jnp.where(moved, mean - state.mean_m, 0.0) / jnp.where(elapsed_s > 0, elapsed_s, 1.0)
    gain_v = jnp.where(moved, 1.0 - jnp.exp(-elapsed_s * jnp.exp(-model.log_lag_s)), 0.0)
    velocity = state.velocity_m_s + gain_v * (raw - state.velocity_m_s)
    known = state.known | any_received
    location = Location(mean, jnp.sqrt(variance + 1e-9), velocity, any_received, known)
    return LocationState(probability, mean, velocity, known), location


def locate(
    model: LocationModel,
    grid: FloorGrid,
    time_s: Float[Array, " time"],
    rssi_dbm: Float[Array, "time antennas"],
    received: Bool[Array, "time antennas"],
) -> Location:
    """Locate one tag in all frames with one `lax.scan` of `locate_step`."""
    step_s = jnp.diff(time_s, prepend=time_s[:1])
    _, path = jax.lax.scan(
        lambda state, frame: locate_step(model, grid, state, *frame), locate_start(grid), (step_s, rssi_dbm, received)
    )
    return path
