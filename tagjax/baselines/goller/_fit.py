"""Fitting what the paper leaves open: widths and rates, by gradient through location and filter, from known carriers."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from ...recording import Recording, RecordingError
from ._alarm import exit_score
from ._association import associate
from ._location import FloorGrid, locate
from ._site import find_site
from ._system import Calibration, GollerSettings, Observations, floor_grid

_NEAR_M = 1.0  # a blob this close to where a tag is carries it
_MOVES_M_S = 0.3  # a carried tag that moves less could as well be background: it teaches nothing
_STILL_M = 0.05
_LEAST = 1e-6


@dataclasses.dataclass(frozen=True)
class Carried:
    """The truth of a recording's tags, in the order of its EPCs with a known place, read or not."""

    epcs: tuple[str, ...]
    position_m: Float[np.ndarray, "tag time 2"]  # room frame
    still: Bool[np.ndarray, " tag"]  # never moved by more than 5 cm

    def leaves(self, tag: int, exit_x_m: float) -> bool:
        """Whether a tag that moves is ever in the exit region."""
        return bool(not self.still[tag] and np.nanmin(self.position_m[tag, :, 0]) < exit_x_m)


def carried(recording: Recording) -> Carried:
    """Where a recording's tags truly were; tags that were never read count too. `RecordingError` without that truth."""
    truth = recording.truth
    if truth is None or not truth.tag_position_m:
        raise RecordingError(
            f"{recording.name}: it does not know where its tags were (truth.tag_position_m); no rate can be counted."
        )
    site = find_site(recording)
    epcs = tuple(truth.tag_position_m)
    paths = np.stack([site.to_room(np.asarray(truth.tag_position_m[epc], np.float64)) for epc in epcs])
    return Carried(epcs, paths[..., :2], np.ptp(paths, axis=1).max(axis=-1) < _STILL_M)


def true_states(seen: Observations, truth: Carried) -> Int[np.ndarray, "tag time"]:
    """The filter's right state of each read tag at each frame: 0 background, 1 + slot, -1 where that is not known.

    A still tag is background. A moving one belongs to the nearest blob, if one is within 1 m.
    """
    states = np.full((len(seen.epcs), len(seen.time_s)), -1)
    for row, epc in enumerate(seen.epcs):
        tag = truth.epcs.index(epc)
        if truth.still[tag]:
            states[row] = 0
            continue
        path = truth.position_m[tag]
        apart = np.linalg.norm(seen.blobs.position_m - path[:, None], axis=-1)
        apart = np.where(seen.blobs.identity > 0, apart, np.inf)
        speed = np.linalg.norm(np.gradient(path, seen.time_s.astype(np.float64), axis=0), axis=-1)
        known = (apart.min(axis=1) < _NEAR_M) & (speed > _MOVES_M_S)
        states[row] = np.where(known, 1 + np.argmin(apart, axis=1), -1)
    return states


class _Batch(eqx.Module):
    time_s: Float[Array, "*tag time"]
    rssi_dbm: Float[Array, "*tag time antennas"]
    heard: Bool[Array, "*tag time antennas"]
    blob_m: Float[Array, "*tag time slots 2"]
    identity: Int[Array, "*tag time slots"]
    state: Int[Array, "*tag time"]
    leaves: Bool[Array, "*tag"]


def _batch(examples: Sequence[tuple[Observations, Carried]], exit_x_m: float) -> _Batch:
    """All tags of all recordings, the shorter ones held at their last frame, whose state is then unknown."""
    longest = max(len(seen.time_s) for seen, _ in examples)
    rows = []
    for seen, truth in examples:
        index = np.minimum(np.arange(longest), len(seen.time_s) - 1)
        state = np.where(np.arange(longest) < len(seen.time_s), true_states(seen, truth)[:, index], -1)
        for tag in range(len(seen.epcs)):
            rows.append(
                _Batch(
                    jnp.asarray(seen.time_s[index]),
                    jnp.asarray(seen.rssi.rssi_dbm[index, tag]),
                    jnp.asarray(seen.rssi.heard[index, tag]),
                    jnp.asarray(seen.blobs.position_m[index]),
                    jnp.asarray(seen.blobs.identity[index]),
                    jnp.asarray(state[tag], jnp.int32),
                    jnp.asarray(truth.leaves(truth.epcs.index(seen.epcs[tag]), exit_x_m)),
                )
            )
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *rows)


class Losses(eqx.Module):
    """What a fit lowers: negative log probabilities, nats."""

    frame: Float[Array, ""]  # of each frame's right state
    alarm: Float[Array, ""]  # of alarms for those who leave, and of none for the others


def association_losses(calibration: Calibration, grid: FloorGrid, batch: _Batch, exit_x_m: Float[Array, ""]) -> Losses:
    """Means of -log p; background and blobs count half each, and so do tags that leave and those that do not.

    The probability of an alarm is the highest `exit_score`.
    """

    def one(row: _Batch):
        path = locate(calibration.location, grid, row.time_s, row.rssi_dbm, row.heard)
        held = associate(
            calibration.association,
            row.time_s,
            path.position_m,
            path.velocity_m_s,
            path.heard,
            row.blob_m,
            row.identity,
        )
        right = jnp.take_along_axis(held.probability, jnp.maximum(row.state, 0)[:, None], axis=1)[:, 0]
        counts = (row.state >= 0) & path.known
        alarm = jnp.max(exit_score(held.probability, row.blob_m, row.identity, exit_x_m))
        return right, counts & (row.state == 0), counts & (row.state > 0), jnp.where(row.leaves, alarm, 1.0 - alarm)

    right, still, moving, alarm = jax.vmap(one)(batch)
    return Losses(
        0.5 * (_mean_log(right, still) + _mean_log(right, moving)),
        0.5 * (_mean_log(alarm, batch.leaves) + _mean_log(alarm, ~batch.leaves)),
    )


def _mean_log(probability: Float[Array, "*some"], counts: Bool[Array, "*some"]) -> Float[Array, ""]:
    """Mean of -log p where it counts; 0 where nothing does."""
    total = jnp.sum(jnp.where(counts, -jnp.log(probability + _LEAST), 0.0))
    return total / jnp.maximum(jnp.sum(counts.astype(total.dtype)), 1.0)


def fit_association(
    calibration: Calibration,
    examples: Sequence[tuple[Observations, Carried]],
    settings: GollerSettings,
    *,
    num_steps: int = 120,
    learning_rate: float = 0.05,
    frame_weight: float = 0.1,
) -> tuple[Calibration, Float[np.ndarray, " steps"]]:
    """Fit the location's and the association's widths and rates (not the antennas) to recordings of known carriers.

    Gradient descent (Adam) on the alarm's loss plus `frame_weight` times the frames' (see `association_losses`), through
    the location's and the HMM's scans. Returns the calibration and the loss at each step. Raises `ValueError` without any read tag.
    """
    if not any(seen.epcs for seen, _ in examples):
        raise ValueError(f"{len(examples)} recordings without a read tag; fitting needs tags that were read.")
    batch, grid = _batch(examples, settings.exit_x_m), floor_grid(calibration, settings)
    exit_x_m = jnp.asarray(settings.exit_x_m, jnp.float32)
    free = jax.tree.map(lambda _: True, calibration)
    free = eqx.tree_at(
        lambda c: (c.location.antennas, c.alarm_threshold, c.rssi_threshold_dbm),
        free,
        (jax.tree.map(lambda _: False, calibration.location.antennas), False, False),
    )
    learnt, fixed = eqx.partition(calibration, free)
    optimiser = optax.adam(learning_rate)

    @eqx.filter_jit
    def descend(learnt, fixed, grid, batch):
        def objective(part):
            losses = association_losses(eqx.combine(part, fixed), grid, batch, exit_x_m)
            return losses.alarm + frame_weight * losses.frame

        def step(carry, _):
            learnt, state = carry
            loss, gradient = jax.value_and_grad(objective)(learnt)
            with jax.numpy_dtype_promotion("standard"):  # Optax takes powers of its integer step count
                updates, state = optimiser.update(gradient, state)
            return (eqx.apply_updates(learnt, updates), state), loss

        (learnt, _), losses = jax.lax.scan(step, (learnt, optimiser.init(learnt)), None, length=num_steps)
        return learnt, losses

    learnt, losses = descend(learnt, fixed, grid, batch)
    return eqx.combine(learnt, fixed), np.asarray(losses)
