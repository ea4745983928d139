"""Alarms at the exit (Goller et al., IV): tags in blobs that enter the exit region, and the RFID-only rule beside it."""

from __future__ import annotations

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int


def exit_score(
    probability: Float[Array, "time states"],
    blob_m: Float[Array, "time slots 2"],
    identity: Int[Array, "time slots"],
    exit_x_m: Float[Array, ""],
) -> Float[Array, " time"]:
    """How sure it is at each frame that a tag is in the exit region: the most probable blob there that carries it.

    The exit region is x < `exit_x_m` in the room frame. Tags that are background never are in it: they do not move.
    """
    inside = (identity > 0) & (blob_m[..., 0] < exit_x_m)
    return jnp.max(jnp.where(inside, probability[:, 1:], 0.0), axis=1, initial=0.0)


def rssi_score(
    rssi_dbm: Float[Array, "time antennas"], heard: Bool[Array, "time antennas"], antenna: int = 1
) -> Float[Array, " time"]:
    """The RFID-only rule's score: the mean RSSI on the exit's antenna (counted from 1), -inf where it hears nothing."""
    return jnp.where(heard[:, antenna - 1], rssi_dbm[:, antenna - 1], -jnp.inf)


@dataclasses.dataclass(frozen=True)
class Roc:
    """Detection against false alarms as the threshold falls; alarms are scores at or above it."""

    threshold: Float[np.ndarray, " points"]
    detection: Float[np.ndarray, " points"]
    false_alarm: Float[np.ndarray, " points"]


def roc_curve(score: Float[np.ndarray, " tags"], moved: Bool[np.ndarray, " tags"]) -> Roc:
    """The curve over all thresholds that tell scores apart, from none alarmed (inf) to all.

    Raises `ValueError` where there is no tag that should be alarmed, or none that should not.
    """
    score, moved = np.asarray(score, np.float64), np.asarray(moved, bool)
    if moved.all() or not moved.any():
        raise ValueError(
            f"{int(moved.sum())} of {len(moved)} tags enter the exit; a curve needs tags that do and tags that do not."
        )
    threshold = np.concatenate([[np.inf], np.unique(score)[::-1]])
    alarmed = score[None] >= threshold[:, None]
    return Roc(threshold, alarmed[:, moved].mean(axis=1), alarmed[:, ~moved].mean(axis=1))


def best_threshold(roc: Roc) -> float:
    """The threshold of greatest P_D - P_FA (Youden), halfway down to the next score that would be alarmed too.

    The highest of equals. Never below a score of -inf: a tag that was never heard is not alarmed.
    """
    gain = np.where(np.isneginf(roc.threshold), -np.inf, roc.detection - roc.false_alarm)
    at = int(np.argmax(gain))
    below = roc.threshold[at + 1] if at + 1 < len(roc.threshold) else -np.inf
    here = roc.threshold[at]
    return float(0.5 * (here + below)) if np.isfinite(here) and np.isfinite(below) else float(here)


def operating_point(roc: Roc, false_alarm: float) -> tuple[float, float]:
    """Detection and false alarms of the lowest threshold whose false alarms are at most `false_alarm`.

    To compare with others who chose their threshold elsewhere. Never a threshold of -inf (`best_threshold`).
    """
    allowed = (roc.false_alarm <= false_alarm + 1e-9) & ~np.isneginf(roc.threshold)
    at = int(np.flatnonzero(allowed)[-1])
    return float(roc.detection[at]), float(roc.false_alarm[at])
