"""How the association follows a tag from hand to hand (Goller et al., Fig. 7): probabilities by role, and delays."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Int, Shaped

from ...baselines.goller import BlobTracks

_CARRIED_M = 1.0  # a blob this close to a tag that moves may carry it
_MOVES_M_S = 0.2


@dataclasses.dataclass(frozen=True)
class Handover:
    """One recording; the last axis of `probability` is background, who brings the tag, who takes it."""

    time_s: Shaped[np.ndarray, " time"]
    probability: Float[np.ndarray, "time 3"]
    taken_s: float  # when the tag goes from one to the other
    rest_s: float  # from when on it rests
    delay_s: float  # from then until the taker's share is the greater of the two; NaN if it never is
    rest_delay_s: float  # until the background has more than half


def follow(
    time_s: Shaped[np.ndarray, " time"],
    path_m: Float[np.ndarray, "time 2"],
    probability: Shaped[np.ndarray, "time states"],
    blobs: BlobTracks,
) -> Handover | None:
    """The roles of a recording in which one tag is carried by one blob, then by another, then rests.

    Who is nearer to the tag while it moves carries it; every blob belongs to the role that it was in most often, as a
    person may be more than one blob in turn. None where no two people carried it in sight.
    """
    times = np.asarray(time_s, np.float64)
    speed = np.linalg.norm(np.gradient(np.asarray(path_m, np.float64), times, axis=0), axis=1)
    moves = np.flatnonzero(speed > _MOVES_M_S)
    apart = np.where(blobs.identity > 0, np.linalg.norm(blobs.position_m - path_m[:, None], axis=-1), np.inf)
    nearest = np.take_along_axis(blobs.identity, np.argmin(apart, axis=1)[:, None], axis=1)[:, 0]
    held = np.flatnonzero((speed > _MOVES_M_S) & (apart.min(axis=1) < _CARRIED_M))
    if len(moves) == 0 or len(held) == 0 or len(set(nearest[held].tolist())) < 2:
        return None
    # The tag slows down where it changes hands: the slowest moment between the first and the last fifth of its way.
    way = np.cumsum(speed * np.gradient(times))
    middle = np.flatnonzero((way > 0.2 * way[-1]) & (way < 0.8 * way[-1]))
    taken = int(middle[np.argmin(speed[middle])])
    share = np.stack([probability[:, 0], np.zeros(len(times)), np.zeros(len(times))], axis=-1).astype(np.float64)
    for name in set(blobs.identity[blobs.identity > 0].tolist()):
        role = _role(name, nearest, held, taken, apart, blobs.identity)
        mine = blobs.identity == name
        share[:, role] += np.sum(np.where(mine, probability[:, 1:], 0.0), axis=1)
    rest = int(moves[-1])
    later = np.arange(len(times)) >= taken
    takes = np.flatnonzero(later & (share[:, 2] > share[:, 1]))
    rests = np.flatnonzero((np.arange(len(times)) >= rest) & (share[:, 0] > 0.5))
    return Handover(
        times,
        share,
        float(times[taken]),
        float(times[rest]),
        float(times[takes[0]] - times[taken]) if len(takes) else float("nan"),
        float(times[rests[0]] - times[rest]) if len(rests) else float("nan"),
    )


def _role(
    name: int,
    nearest: Int[np.ndarray, " time"],
    held: Int[np.ndarray, " frames"],
    taken: int,
    apart: Float[np.ndarray, "time slots"],
    identity: Int[np.ndarray, "time slots"],
) -> int:
    """1 for a blob of who brings the tag, 2 for one of who takes it."""
    before, after = np.sum(nearest[held[held < taken]] == name), np.sum(nearest[held[held >= taken]] == name)
    if before != after:
        return 1 if before > after else 2
    # Carries it at no time: the one who has it is somebody else.
    frame = np.flatnonzero(np.any(identity == name, axis=1))[0]
    return 2 if frame < taken else 1


def mean_curve(found: list[Handover], step_s: float = 0.1, span_s: tuple[float, float] = (-5.0, 9.0)) -> tuple[
    Float[np.ndarray, " steps"], Float[np.ndarray, "steps 3"], Float[np.ndarray, "steps 3"]
]:  # fmt: skip
    """Times from the hand-over, the roles' mean probabilities, and their deviations over the recordings."""
    times = np.arange(span_s[0], span_s[1] + 0.5 * step_s, step_s)
    curves = np.stack(
        [
            np.stack([np.interp(times, one.time_s - one.taken_s, one.probability[:, k]) for k in range(3)], axis=-1)
            for one in found
        ]
    )
    return times, curves.mean(axis=0), curves.std(axis=0)
