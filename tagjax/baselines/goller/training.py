"""Training of the parameters that the paper leaves open, by gradient through both filters, from known carriers."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from .alarm import exit_score
from .calibration import Calibration, floor_grid
from .location import FloorGrid, locate
from .matching import associate
from .offline import Observations
from .settings import GollerSettings
from .truth import TrueTags, true_states

_MIN_PROBABILITY = 1e-6


class _Batch(eqx.Module):
    time_s: Float[Array, "*tag time"]
    rssi_dbm: Float[Array, "*tag time antennas"]
    received: Bool[Array, "*tag time antennas"]
    blob_m: Float[Array, "*tag time slots 2"]
    identity: Int[Array, "*tag time slots"]
    state: Int[Array, "*tag time"]
    leaves: Bool[Array, "*tag"]


def _batch(examples: Sequence[tuple[Observations, TrueTags]], exit_x_m: float) -> _Batch:
    """All tags of all recordings; shorter recordings repeat their last frame, with unknown states."""
    longest = max(len(observed.time_s) for observed, _ in examples)
    tags = []
    for observed, truth in examples:
        index = np.minimum(np.arange(longest), len(observed.time_s) - 1)
        state = np.where(np.arange(longest) < len(observed.time_s), true_states(observed, truth)[:, index], -1)
        for tag in range(len(observed.epcs)):
            tags.append(
                _Batch(
                    jnp.asarray(observed.time_s[index]),
                    jnp.asarray(observed.rssi.rssi_dbm[index, tag]),
                    jnp.asarray(observed.rssi.received[index, tag]),
                    jnp.asarray(observed.blobs.position_m[index]),
                    jnp.asarray(observed.blobs.identity[index]),
                    jnp.asarray(state[tag], jnp.int32),
                    jnp.asarray(truth.kind(truth.epcs.index(observed.epcs[tag]), exit_x_m) == "leaves"),
                )
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *tags)


class Losses(eqx.Module):
    """The two parts of the training loss: negative log probabilities, nats."""

    frame: Float[Array, ""]  # of each frame's true state
    alarm: Float[Array, ""]  # of an alarm for tags that leave, of no alarm for the others


def association_losses(calibration: Calibration, grid: FloorGrid, batch: _Batch, exit_x_m: Float[Array, ""]) -> Losses:
    """Means of -log p, with equal weight for background and blobs, and for tags that leave and those that do not.

    The probability of an alarm is the highest `exit_score`.
    """

    def one(inputs: _Batch):
        path = locate(calibration.location, grid, inputs.time_s, inputs.rssi_dbm, inputs.received)
        states = associate(
            calibration.association,
            inputs.time_s,
            path.position_m,
            path.velocity_m_s,
            path.received,
            inputs.blob_m,
            inputs.identity,
        )
        true_probability = jnp.take_along_axis(states.probability, jnp.maximum(inputs.state, 0)[:, None], axis=1)[:, 0]
        counts = (inputs.state >= 0) & path.known
        alarm = jnp.max(exit_score(states.probability, inputs.blob_m, inputs.identity, exit_x_m))
        return (
            true_probability,
            counts & (inputs.state == 0),
            counts & (inputs.state > 0),
            jnp.where(inputs.leaves, alarm, 1.0 - alarm),
        )

    true_probability, still, moving, alarm = jax.vmap(one)(batch)
    return Losses(
        0.5 * (_mean_log(true_probability, still) + _mean_log(true_probability, moving)),
        0.5 * (_mean_log(alarm, batch.leaves) + _mean_log(alarm, ~batch.leaves)),
    )


def _mean_log(probability: Float[Array, "*some"], counts: Bool[Array, "*some"]) -> Float[Array, ""]:
    """Mean of -log p where `counts`; 0 where nothing does."""
    total = jnp.sum(jnp.where(counts, -jnp.log(probability + _MIN_PROBABILITY), 0.0))
    return total / jnp.maximum(jnp.sum(counts.astype(total.dtype)), 1.0)


def fit_association(
    calibration: Calibration,
    examples: Sequence[tuple[Observations, TrueTags]],
    settings: GollerSettings,
    *,
    num_steps: int = 120,
    learning_rate: float = 0.05,
    frame_weight: float = 0.1,
) -> tuple[Calibration, Float[np.ndarray, " steps"]]:
    """Fit the parameters of location and association (not of the antennas) to recordings of known carriers.

    Gradient descent (Adam) on the alarm loss plus `frame_weight` times the frame loss (see `association_losses`),
    through the scans of location and HMM. Returns the calibration and the loss at each step. Raises `ValueError`
    without any read tag.
    """
    if not any(observed.epcs for observed, _ in examples):
        raise ValueError(
            f"Found no read tag in {len(examples)} recordings, expected some. Train on recordings whose tags were read."
        )
    batch, grid = _batch(examples, settings.exit_x_m), floor_grid(calibration, settings)
    exit_x_m = jnp.asarray(settings.exit_x_m, jnp.float32)
    free = jax.tree.map(lambda _: True, calibration)
    free = eqx.tree_at(
        lambda c: (c.location.antennas, c.alarm_threshold, c.rssi_threshold_dbm),
        free,
        (jax.tree.map(lambda _: False, calibration.location.antennas), False, False),
    )
    learned, fixed = eqx.partition(calibration, free)
    optimiser = optax.adam(learning_rate)

    @eqx.filter_jit
    def descend(learned, fixed, grid, batch):
        def objective(part):
            losses = association_losses(eqx.combine(part, fixed), grid, batch, exit_x_m)
            return losses.alarm + frame_weight * losses.frame

        def step(carry, _):
            learned, state = carry
            loss, gradient = jax.value_and_grad(objective)(learned)
            with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
                updates, state = optimiser.update(gradient, state)
            return (eqx.apply_updates(learned, updates), state), loss

        (learned, _), losses = jax.lax.scan(step, (learned, optimiser.init(learned)), None, length=num_steps)
        return learned, losses

    learned, losses = descend(learned, fixed, grid, batch)
    return eqx.combine(learned, fixed), np.asarray(losses)
