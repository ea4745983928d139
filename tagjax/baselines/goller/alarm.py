"""Alarms at the exit (Goller et al., IV): tags carried by blobs in the exit region, and the RFID-only rule."""

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
    """The highest probability, at each frame, that a blob in the exit region carries the tag.

    The exit region is x < `exit_x_m` in the room frame. A tag in the background state never is in it: it does not move.
    """
    inside = (identity > 0) & (blob_m[..., 0] < exit_x_m)
    return jnp.max(jnp.where(inside, probability[:, 1:], 0.0), axis=1, initial=0.0)


def rssi_score(
    rssi_dbm: Float[Array, "time antennas"], received: Bool[Array, "time antennas"], antenna: int = 1
) -> Float[Array, " time"]:
    """The RFID-only rule's score: the mean RSSI at the exit's antenna (counted from 1), -inf without a read there."""
    return jnp.where(received[:, antenna - 1], rssi_dbm[:, antenna - 1], -jnp.inf)


@dataclasses.dataclass(frozen=True)
class Roc:
    """Detection rate against false alarm rate as the threshold falls; a tag is alarmed at scores at or above it."""

    threshold: Float[np.ndarray, " points"]
    detection: Float[np.ndarray, " points"]
    false_alarm: Float[np.ndarray, " points"]


def roc_curve(score: Float[np.ndarray, " tags"], moved: Bool[np.ndarray, " tags"]) -> Roc:
    """The curve over all thresholds that separate scores, from no alarm (inf) to all.

    Raises `ValueError` where there is no tag that should be alarmed, or none that should not.
    """
    score, moved = np.asarray(score, np.float64), np.asarray(moved, bool)
    if moved.all() or not moved.any():
        raise ValueError(
            f"Found {int(moved.sum())} of {len(moved)} tags that enter the exit, expected some that do and some that do "
            "not. Add recordings of the other kind."
        )
    threshold = np.concatenate([[np.inf], np.unique(score)[::-1]])
    alarmed = score[None] >= threshold[:, None]
    return Roc(threshold, alarmed[:, moved].mean(axis=1), alarmed[:, ~moved].mean(axis=1))


def best_threshold(roc: Roc) -> float:
    """The threshold of greatest P_D - P_FA (Youden), halfway to the next lower score; the highest of equal ones.

    Never below a score of -inf: a tag that was never received is not alarmed.
    """
    gain = np.where(np.isneginf(roc.threshold), -np.inf, roc.detection - roc.false_alarm)
    best = int(np.argmax(gain))
    lower = roc.threshold[best + 1] if best + 1 < len(roc.threshold) else -np.inf
    chosen = roc.threshold[best]
    return float(0.5 * (chosen + lower)) if np.isfinite(chosen) and np.isfinite(lower) else float(chosen)


def operating_point(roc: Roc, max_false_alarm: float) -> tuple[float, float]:
    """Detection and false alarm rate at the lowest threshold with at most `max_false_alarm` false alarms.

    For a comparison with figures whose threshold was chosen elsewhere. Never a threshold of -inf (`best_threshold`).
    """
    allowed = (roc.false_alarm <= max_false_alarm + 1e-9) & ~np.isneginf(roc.threshold)
    last = int(np.flatnonzero(allowed)[-1])
    return float(roc.detection[last]), float(roc.false_alarm[last])
