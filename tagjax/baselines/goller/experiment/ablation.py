"""Which sensor misses what: the same rule with true positions of tags, true blobs, or both in place of measured
ones.
"""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..alarm import best_threshold, exit_score
from ..calibration import Calibration
from ..location import locate
from ..matching import associate
from ..offline import ModelInputs, Observations, model_inputs, peak
from ..settings import GollerSettings
from .rates import Example, Rates, TagOutcome, rates, rule_roc, tag_outcomes

CONDITIONS: dict[str, tuple[bool, bool]] = {
    "measured": (False, False),
    "true blobs": (False, True),
    "true positions of tags": (True, False),
    "both true": (True, True),
}
"""Whether the tags' positions, and whether their blobs, are the true ones."""

_MAX_DISTANCE_M = 0.7  # a measured blob this close to a carried tag is its carrier's, which the true one replaces
_TRUE_BLOB = 1 << 20  # an identity that no measured blob has


def sensor_ablation(
    calibration: Calibration, known: Sequence[Example], test: Sequence[Example], settings: GollerSettings
) -> dict[str, dict[str, Rates]]:
    """Rates of every variant, and of all together ("all"), for each of `CONDITIONS`.

    Each condition has its own threshold, chosen on `known`. A tag that was never read stays undetected in every
    condition, and a frame without reads stays one without: the true position is used where the tag was received.
    """
    found: dict[str, dict[str, Rates]] = {}
    for name, (positions, blobs) in CONDITIONS.items():
        before, after = (
            [tag for example in part for tag in _outcomes(calibration, example, settings, positions, blobs)]
            for part in (known, test)
        )
        threshold = best_threshold(rule_roc(before, "fused", stays=True))
        variants = sorted({tag.variant for tag in after})
        found[name] = {one: rates([t for t in after if t.variant == one], "fused", threshold) for one in variants}
        found[name]["all"] = rates(after, "fused", threshold)
    return found


def _outcomes(
    calibration: Calibration, example: Example, settings: GollerSettings, positions: bool, blobs: bool
) -> list[TagOutcome]:
    observed, truth = example.observed, example.truth
    score: dict[str, float] = {}
    if observed.epcs:
        tags = [truth.epcs.index(epc) for epc in observed.epcs]
        path = truth.position_m[tags].astype(np.float32)
        identity, blob_m = _with_true_blobs(observed, path, ~truth.still[tags] & blobs)
        scores = _score(
            model_inputs(calibration, observed, settings),
            jnp.asarray(path),
            jnp.asarray(positions),
            jnp.asarray(blob_m),
            jnp.asarray(identity),
        )
        score = dict(zip(observed.epcs, peak(scores).tolist(), strict=True))
    return tag_outcomes(example, settings, score, {})


def _with_true_blobs(
    observed: Observations, path_m: Float[np.ndarray, "tag time 2"], use_true: Bool[np.ndarray, " tag"]
) -> tuple[Int[np.ndarray, "tag time slots"], Float[np.ndarray, "tag time slots 2"]]:
    """For each tag the measured blobs and one more slot, which holds a blob at the tag's position where `use_true`."""
    num = len(path_m)
    identity = np.broadcast_to(observed.blobs.identity, (num, *observed.blobs.identity.shape)).copy()
    position = np.broadcast_to(observed.blobs.position_m, (num, *observed.blobs.position_m.shape))
    near = np.linalg.norm(position - path_m[:, :, None], axis=-1) < _MAX_DISTANCE_M
    identity[near & use_true[:, None, None]] = 0
    extra = np.broadcast_to(np.where(use_true, _TRUE_BLOB, 0)[:, None, None], (*identity.shape[:2], 1))
    every = np.concatenate([position, path_m[:, :, None]], axis=2)
    return np.concatenate([identity, extra], axis=2).astype(np.int32), every.astype(np.float32)


@eqx.filter_jit
def _score(
    inputs: ModelInputs,
    path_m: Float[Array, "tag time 2"],
    use_true: Bool[Array, ""],
    blob_m: Float[Array, "tag time slots 2"],
    identity: Int[Array, "tag time slots"],
) -> Float[Array, "tag time"]:
    def one_tag(rssi_dbm, received, path, blob, identities):
        where = locate(inputs.location, inputs.grid, inputs.time_s, rssi_dbm, received)
        step_s = jnp.diff(inputs.time_s)[:, None]
        speed = jnp.diff(path, axis=0) / jnp.where(step_s > 0, step_s, 1.0)
        speed = jnp.concatenate([jnp.zeros_like(path[:1]), speed])
        position = jnp.where(use_true, path, where.position_m)
        velocity = jnp.where(use_true, speed, where.velocity_m_s)
        states = associate(inputs.association, inputs.time_s, position, velocity, where.received, blob, identities)
        return exit_score(states.probability, blob, identities, inputs.exit_x_m)

    return jax.vmap(one_tag)(inputs.rssi_dbm, inputs.received, path_m, blob_m, identity)
