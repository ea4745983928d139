"""How the association follows a tag from person to person (Goller et al., Fig. 7): probabilities by role, and
delays.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from jaxtyping import Float, Int, Shaped

from ..slots import BlobTracks

_MAX_DISTANCE_M = 1.0  # of a moving tag to a blob that may carry it
_MIN_SPEED_M_S = 0.2


@dataclasses.dataclass(frozen=True)
class Handover:
    """One recording; the last axis of `probability` is background, giver, taker."""

    time_s: Shaped[np.ndarray, " time"]
    probability: Float[np.ndarray, "time 3"]
    handover_s: float  # when the tag changes hands
    stop_s: float  # from when on it is still
    taker_delay_s: float  # from the hand-over until the taker is more probable than the giver; NaN if never
    stop_delay_s: float  # from the stop until the background has more than half of the probability; NaN if never


def find_handover(
    time_s: Shaped[np.ndarray, " time"],
    path_m: Float[np.ndarray, "time 2"],
    probability: Shaped[np.ndarray, "time states"],
    blobs: BlobTracks,
) -> Handover | None:
    """The hand-over in a recording in which one person carries a tag, then another, then nobody.

    The blob nearest to the moving tag carries it. Every blob belongs to the role that it has in most frames, as a
    person may be more than one blob in turn. None where no two blobs carry the tag.
    """
    times = np.asarray(time_s, np.float64)
    speed = np.linalg.norm(np.gradient(np.asarray(path_m, np.float64), times, axis=0), axis=1)
    moving = np.flatnonzero(speed > _MIN_SPEED_M_S)
    distance = np.where(blobs.identity > 0, np.linalg.norm(blobs.position_m - path_m[:, None], axis=-1), np.inf)
    nearest = np.take_along_axis(blobs.identity, np.argmin(distance, axis=1)[:, None], axis=1)[:, 0]
    carried = np.flatnonzero((speed > _MIN_SPEED_M_S) & (distance.min(axis=1) < _MAX_DISTANCE_M))
    if len(moving) == 0 or len(carried) == 0 or len(set(nearest[carried].tolist())) < 2:
        return None
    # The tag is slowest where it changes hands, between the first and the last fifth of its way.
    way = np.cumsum(speed * np.gradient(times))
    middle = np.flatnonzero((way > 0.2 * way[-1]) & (way < 0.8 * way[-1]))
    change = int(middle[np.argmin(speed[middle])])
    roles = np.stack([probability[:, 0], np.zeros(len(times)), np.zeros(len(times))], axis=-1).astype(np.float64)
    for identity in set(blobs.identity[blobs.identity > 0].tolist()):
        role = _role(identity, nearest, carried, change, blobs.identity)
        roles[:, role] += np.sum(np.where(blobs.identity == identity, probability[:, 1:], 0.0), axis=1)
    stop = int(moving[-1])
    return Handover(
        times,
        roles,
        float(times[change]),
        float(times[stop]),
        _delay_s(times, change, roles[:, 2] > roles[:, 1]),
        _delay_s(times, stop, roles[:, 0] > 0.5),
    )


def _delay_s(time_s: Float[np.ndarray, " time"], start: int, holds: Shaped[np.ndarray, " time"]) -> float:
    """Time from a frame until a condition holds; NaN if it never does."""
    found = np.flatnonzero((np.arange(len(time_s)) >= start) & holds)
    return float(time_s[found[0]] - time_s[start]) if len(found) else float("nan")


def _role(
    identity: int,
    nearest: Int[np.ndarray, " time"],
    carried: Int[np.ndarray, " frames"],
    change: int,
    identities: Int[np.ndarray, "time slots"],
) -> int:
    """1 for a blob of the giver, 2 for one of the taker."""
    before = np.sum(nearest[carried[carried < change]] == identity)
    after = np.sum(nearest[carried[carried >= change]] == identity)
    if before != after:
        return 1 if before > after else 2
    # It never carries the tag: it is the person who does not have it at that time.
    first = np.flatnonzero(np.any(identities == identity, axis=1))[0]
    return 2 if first < change else 1


def mean_curve(found: list[Handover], step_s: float = 0.1, span_s: tuple[float, float] = (-5.0, 9.0)) -> tuple[
    Float[np.ndarray, " steps"], Float[np.ndarray, "steps 3"], Float[np.ndarray, "steps 3"]
]:  # fmt: skip
    """Times from the hand-over, mean probabilities of the roles, and standard deviations over the recordings."""
    times = np.arange(span_s[0], span_s[1] + 0.5 * step_s, step_s)
    curves = np.stack(
        [
            np.stack([np.interp(times, one.time_s - one.handover_s, one.probability[:, k]) for k in range(3)], axis=-1)
            for one in found
        ]
    )
    return times, curves.mean(axis=0), curves.std(axis=0)


def summarise_handovers(found: list[Handover], num_recordings: int) -> dict[str, Any]:
    """Peaks and delays of all hand-overs, as plain values; None for a delay that never ends."""
    if not found:
        return {"num_recordings": num_recordings, "num_followed": 0}
    before = [one.time_s <= one.handover_s for one in found]
    pairs = list(zip(found, before, strict=True))
    delays = {
        "taker_delay_s": [one.taker_delay_s for one in found],
        "stop_delay_s": [one.stop_delay_s for one in found],
    }
    return {
        "num_recordings": num_recordings,
        "num_followed": len(found),
        "giver_peak_before": [float(one.probability[early, 1].max()) for one, early in pairs],
        "taker_peak_before": [float(one.probability[early, 2].max()) for one, early in pairs],
        "taker_peak_after": [float(one.probability[~early, 2].max()) for one, early in pairs],
        "background_at_end": [float(one.probability[-1, 0]) for one in found],
        **{name: [value if np.isfinite(value) else None for value in values] for name, values in delays.items()},
    }
