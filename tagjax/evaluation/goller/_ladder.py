"""What is missed, and by which sensor: the same rule with true places of tags, true blobs, or both in their stead."""

from __future__ import annotations

from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...baselines.goller import (
    Calibration,
    Carried,
    GollerSettings,
    Observations,
    Prepared,
    associate,
    best_threshold,
    exit_score,
    locate,
    peak,
    prepared,
)
from ._tables import Kind, Rates, TagOutcome, rates, rule_roc

RUNGS: dict[str, tuple[bool, bool]] = {
    "as it is": (False, False),
    "true blobs": (False, True),
    "true places of tags": (True, False),
    "both": (True, True),
}
"""Whether the tags' places, and whether their blobs, are the true ones."""

_NEAR_M = 0.7  # a seen blob this close to a carried tag is its carrier's: the true one stands for it
_NAME = 1 << 20  # no blob's


def ladder(
    calibration: Calibration,
    known: Sequence[tuple[str, Observations, Carried]],
    tested: Sequence[tuple[str, Observations, Carried]],
    settings: GollerSettings,
) -> dict[str, dict[str, Rates]]:
    """Rates of every variant, and of all together ("all"), for each of `RUNGS`.

    Each rung has a threshold of its own, chosen on `known`. A tag that was read at no time stays undetected on every rung,
    and a frame without reads stays one: the true place is told when the tag is heard.
    """
    found: dict[str, dict[str, Rates]] = {}
    for name, (places, blobs) in RUNGS.items():
        before, after = (
            [_outcomes(calibration, one, settings, places, blobs) for one in part] for part in (known, tested)
        )
        threshold = best_threshold(rule_roc([tag for tags in before for tag in tags], "fused", stays=True))
        every = [tag for tags in after for tag in tags]
        variants = sorted({tag.variant for tag in every})
        found[name] = {one: rates([t for t in every if t.variant == one], "fused", threshold) for one in variants}
        found[name]["all"] = rates(every, "fused", threshold)
    return found


def _outcomes(
    calibration: Calibration,
    example: tuple[str, Observations, Carried],
    settings: GollerSettings,
    places: bool,
    blobs: bool,
) -> list[TagOutcome]:
    variant, seen, truth = example
    score: dict[str, float] = {}
    if seen.epcs:
        rows = [truth.epcs.index(epc) for epc in seen.epcs]
        path = truth.position_m[rows].astype(np.float32)
        identity, blob_m = _with_true_blobs(seen, path, ~truth.still[rows] & blobs)
        scores = _score(
            prepared(calibration, seen, settings),
            jnp.asarray(path),
            jnp.asarray(places),
            jnp.asarray(blob_m),
            jnp.asarray(identity),
        )
        score = dict(zip(seen.epcs, peak(scores).tolist(), strict=True))
    out = []
    for row, epc in enumerate(truth.epcs):
        kind: Kind = "still" if truth.still[row] else "leaves" if truth.leaves(row, settings.exit_x_m) else "stays"
        out.append(TagOutcome(seen.name, variant, epc, kind, score.get(epc, 0.0), -np.inf, epc in seen.epcs))
    return out


def _with_true_blobs(
    seen: Observations, path_m: Float[np.ndarray, "tag time 2"], wanted: Bool[np.ndarray, " tag"]
) -> tuple[Int[np.ndarray, "tag time slots"], Float[np.ndarray, "tag time slots 2"]]:
    """For each tag the seen blobs and one more slot: where `wanted` it holds a blob at the tag's very place."""
    num = len(path_m)
    identity = np.broadcast_to(seen.blobs.identity, (num, *seen.blobs.identity.shape)).copy()
    place = np.broadcast_to(seen.blobs.position_m, (num, *seen.blobs.position_m.shape))
    near = np.linalg.norm(place - path_m[:, :, None], axis=-1) < _NEAR_M
    identity[near & wanted[:, None, None]] = 0
    extra = np.broadcast_to(np.where(wanted, _NAME, 0)[:, None, None], (*identity.shape[:2], 1))
    every = np.concatenate([place, path_m[:, :, None]], axis=2)
    return np.concatenate([identity, extra], axis=2).astype(np.int32), every.astype(np.float32)


@eqx.filter_jit
def _score(
    given: Prepared,
    path_m: Float[Array, "tag time 2"],
    places: Bool[Array, ""],
    blob_m: Float[Array, "tag time slots 2"],
    identity: Int[Array, "tag time slots"],
) -> Float[Array, "tag time"]:
    def one(rssi, by, path, blob, names):
        where = locate(given.location, given.grid, given.time_s, rssi, by)
        step_s = jnp.diff(given.time_s)[:, None]
        speed = jnp.diff(path, axis=0) / jnp.where(step_s > 0, step_s, 1.0)
        speed = jnp.concatenate([jnp.zeros_like(path[:1]), speed])
        place, velocity = jnp.where(places, path, where.position_m), jnp.where(places, speed, where.velocity_m_s)
        held = associate(given.association, given.time_s, place, velocity, where.heard, blob, names)
        return exit_score(held.probability, blob, names, given.exit_x_m)

    return jax.vmap(one)(given.rssi_dbm, given.heard, path_m, blob_m, identity)
