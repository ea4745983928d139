"""Which track carries which tag (TagVision, IV.B-C): reads and places paired, scored, and the highest score taken."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from ...core.assignment import hard_assignment
from ...recording import TagReads
from ._score import PHASE_NOISE_RAD, Reference, Snapshots, match_scores
from ._snapshots import Pairing, heading, hop_slope, pair_interpolated, pair_nearest, unsigned_phase

_PAD_SNAPSHOTS = 256
_PAD_TRACKS = 8


@dataclasses.dataclass(frozen=True)
class MatchSettings:
    """The defaults are the paper's, where it says; what goes beyond it is marked ours and off."""

    reference: Reference = "first"
    num_snapshots: int = 30
    num_rounds: int = 100
    sigma_rad: float = PHASE_NOISE_RAD * 2**0.5
    pairing: Pairing = "nearest"  # ours: "interpolate" places each read between two frames
    hops: Literal["ignore", "affine"] = "ignore"  # ours: "affine" takes the reader's offset over channels off
    multiple: int = 1  # ours: 2 leaves pi flips alone
    leads_m: tuple[float, ...] = (0.0,)  # ours: how far ahead of its host's middle the tag may sit; the best one counts
    exclusive: bool = False  # ours: no two tags on one track, by the assignment of highest total score
    max_gap_s: float | None = None  # ours: between a read and its frame
    least_snapshots: int = 20  # a track with fewer is no candidate
    least_share: float = 0.0  # ours: nor one with less than this share of the snapshots of the longest seen
    seed: int = 0

    def __post_init__(self):
        for name, least in (("num_snapshots", 2), ("num_rounds", 1), ("least_snapshots", 2)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {least}.")
        if not self.sigma_rad > 0 or not 0 <= self.least_share <= 1:
            raise ValueError(
                f"sigma_rad {self.sigma_rad}, least_share {self.least_share}; expected a positive number and a share."
            )
        if not self.leads_m:
            raise ValueError("leads_m is empty; expected at least one place, 0 for the host's middle.")
        for name, known in (
            ("reference", ("first", "absolute")),
            ("pairing", ("nearest", "interpolate")),
            ("hops", ("ignore", "affine")),
            ("multiple", (1, 2)),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected one of {', '.join(map(str, known))}.")


@dataclasses.dataclass(frozen=True)
class Match:
    """What the scores say of one tag."""

    track: int  # number of the track, -1 = none
    score: float
    lead_m: float  # of the tag ahead of its host's middle
    confidence: float  # the best score's share of itself and the runner-up: 0.5 for a tie, 1 for a lone candidate
    scores: Mapping[int, float]  # of every candidate, by track


NO_MATCH = Match(-1, 0.0, 0.0, 0.0, {})


def match_tags(
    epcs: Sequence[str],
    time_s: Float[np.ndarray, " frames"],
    paths_m: Mapping[int, Float[np.ndarray, "frames 3"]],
    reads: TagReads,
    read_time_s: Float[np.ndarray, " reads"],
    antenna_m: Float[np.ndarray, " 3"],
    settings: MatchSettings,
) -> dict[str, Match]:
    """Score every tag against the paths (NaN where not seen) and choose for each the highest, m = argmax s_i.

    Paths and antenna share a frame whose z is up. No path, or no reads: `NO_MATCH`. Equal scores: the lower number.
    More tags than paths: several get the same one, unless `exclusive`, where those that gain least get none. Paths
    without a tag stay unnamed.
    """
    numbers = sorted(paths_m)
    if not numbers:
        return dict.fromkeys(epcs, NO_MATCH)
    scores = np.full((len(epcs), len(numbers)), -np.inf)
    leads = np.zeros((len(epcs), len(numbers)))
    paths = np.stack([paths_m[number] for number in numbers])
    places = _places(time_s, paths, settings.leads_m)
    for tag, epc in enumerate(epcs):
        own = reads.epc == epc
        if own.any():
            scores[tag], leads[tag] = _scores(time_s, places, reads[own], read_time_s[own], antenna_m, settings)
    return _choose(epcs, numbers, scores, leads, settings.exclusive)


def _places(time_s: np.ndarray, paths_m: np.ndarray, leads_m: Sequence[float]) -> np.ndarray:
    """Where a tag would be (tracks, leads, frames, 3): ahead of the middle, along the way its host goes."""
    ahead = np.stack([_held(heading(time_s, path)) for path in paths_m])
    return paths_m[:, None] + np.asarray(leads_m)[None, :, None, None] * ahead[:, None]


def _held(direction: np.ndarray) -> np.ndarray:
    """Who stands still points where it last went, or will go first; zero where it never goes."""
    known = np.flatnonzero(np.isfinite(direction[:, 0]))
    if not len(known):
        return np.zeros_like(direction)
    last = np.searchsorted(known, np.arange(len(direction)), side="right") - 1
    return direction[known[np.maximum(last, 0)]]


def _scores(
    time_s: np.ndarray,
    places_m: np.ndarray,
    reads: TagReads,
    read_time_s: np.ndarray,
    antenna_m: np.ndarray,
    settings: MatchSettings,
) -> tuple[np.ndarray, np.ndarray]:
    """Score and best lead of every track for one tag; -inf for tracks with too few snapshots."""
    pair = pair_nearest if settings.pairing == "nearest" else pair_interpolated
    gap_s = float("inf") if settings.max_gap_s is None else settings.max_gap_s
    num_tracks, num_leads = places_m.shape[:2]
    flat = places_m.reshape(num_tracks * num_leads, *places_m.shape[2:])
    paired = [pair(time_s, place, read_time_s, max_gap_s=gap_s) for place in flat]
    index = paired[0][0]  # the same for all: it goes by the times
    valid = np.stack([counted for _, _, counted in paired])
    away = np.stack([np.linalg.norm(where - antenna_m, axis=1) for _, where, _ in paired])
    snapshots = _padded(unsigned_phase(reads)[index], reads.carrier_hz[index], away, valid, _PAD_TRACKS * num_leads)
    slope = hop_slope(reads, read_time_s) if settings.hops == "affine" else float("nan")
    found = match_scores(
        snapshots,
        key=jax.random.key(settings.seed),
        num_snapshots=settings.num_snapshots,
        num_rounds=settings.num_rounds,
        sigma_rad=settings.sigma_rad,
        reference=settings.reference,
        multiple=settings.multiple,
        hop_slope_rad_hz=jnp.asarray(slope, jnp.float32),
    )
    score = np.asarray(found, np.float64)[: len(flat)].reshape(num_tracks, num_leads)
    known = valid.sum(axis=1).reshape(num_tracks, num_leads)
    # Few snapshots fit anything: a shadow followed for a second would outdo its owner followed for ten.
    enough = (known >= settings.least_snapshots) & (known >= settings.least_share * known.max())
    score = np.where(enough, score, -np.inf)
    best = np.argmax(score, axis=1)
    return score[np.arange(num_tracks), best], np.asarray(settings.leads_m)[best]


def _padded(
    phase_rad: np.ndarray, carrier_hz: np.ndarray, distance_m: np.ndarray, valid: np.ndarray, step: int
) -> Snapshots:
    """Snapshots in buffers of a few sizes, so that few are ever compiled."""
    candidates, count = valid.shape
    rows, length = -(-candidates // step) * step, -(-count // _PAD_SNAPSHOTS) * _PAD_SNAPSHOTS
    phase, carrier = np.zeros(length, np.float32), np.full(length, 9e8, np.float32)
    away, counted = np.zeros((rows, length), np.float32), np.zeros((rows, length), bool)
    phase[:count], carrier[:count] = phase_rad, carrier_hz
    away[:candidates, :count], counted[:candidates, :count] = np.where(valid, distance_m, 0.0), valid
    return Snapshots(jnp.asarray(phase), jnp.asarray(carrier), jnp.asarray(away), jnp.asarray(counted))


def _choose(
    epcs: Sequence[str], numbers: Sequence[int], scores: np.ndarray, leads: np.ndarray, exclusive: bool
) -> dict[str, Match]:
    if exclusive:
        chosen = np.asarray(hard_assignment(scores))
    else:
        chosen = np.where(np.isfinite(scores).any(axis=1), np.argmax(scores, axis=1), -1)
    matches = {}
    for tag, epc in enumerate(epcs):
        column, row = int(chosen[tag]), scores[tag]
        said = {number: float(row[i]) for i, number in enumerate(numbers) if np.isfinite(row[i])}
        if column < 0:
            matches[epc] = dataclasses.replace(NO_MATCH, scores=said)
            continue
        score = float(row[column])
        other = float(np.max(np.delete(row, column), initial=0.0))
        share = score / (score + other) if score + other > 0 else 0.0
        matches[epc] = Match(numbers[column], score, float(leads[tag, column]), share, said)
    return matches
