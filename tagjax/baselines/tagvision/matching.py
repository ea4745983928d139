"""Which track carries which tag (TagVision, IV.B-C): reads are paired with positions and scored; the best score
wins.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from ...core.assignment import hard_assignment
from ...recording import TagReads
from ..reads import hop_slope_rad_hz, padded_size, range_phase_rad
from .pairing import Pairing, motion_direction, pair_interpolated, pair_nearest
from .phase_score import PHASE_NOISE_RAD, Reference, Snapshots, match_scores

_PAD_SNAPSHOTS = 256
_PAD_TRACKS = 8


@dataclasses.dataclass(frozen=True)
class MatchSettings:
    """The defaults are the paper's where it gives them; additions to the paper are marked ours and disabled by
    default.
    """

    reference: Reference = "first"
    num_snapshots: int = 30
    num_rounds: int = 100
    sigma_rad: float = PHASE_NOISE_RAD * 2**0.5
    pairing: Pairing = "nearest"  # ours: "interpolate" pairs each read with a position between frames
    hops: Literal["ignore", "affine"] = "ignore"  # ours: "affine" subtracts the reader's offset over channels
    angle_multiple: int = 1  # ours: 2 makes the score invariant to pi flips
    tag_offsets_m: tuple[float, ...] = (0.0,)  # ours: candidate positions of the tag ahead of its host's centre
    exclusive: bool = False  # ours: at most one tag per track, by the assignment of highest total score
    max_gap_s: float | None = None  # ours: between a read and its frame
    min_snapshots: int = 20  # a track with fewer is no candidate
    min_snapshot_fraction: float = 0.0  # ours: of the snapshots of the longest track; one with fewer is no candidate
    seed: int = 0

    def __post_init__(self):
        for name, low in (("num_snapshots", 2), ("num_rounds", 1), ("min_snapshots", 2)):
            if getattr(self, name) < low:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {low}.")
        if not self.sigma_rad > 0 or not 0 <= self.min_snapshot_fraction <= 1:
            raise ValueError(
                f"sigma_rad {self.sigma_rad}, min_snapshot_fraction {self.min_snapshot_fraction}; expected a positive "
                "number and a fraction."
            )
        if not self.tag_offsets_m:
            raise ValueError("tag_offsets_m is empty; expected at least one offset, 0 for the host's centre.")
        for name, allowed in (
            ("reference", ("first", "absolute")),
            ("pairing", ("nearest", "interpolate")),
            ("hops", ("ignore", "affine")),
            ("angle_multiple", (1, 2)),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected one of {', '.join(map(str, allowed))}.")


@dataclasses.dataclass(frozen=True)
class Match:
    """The match of one tag."""

    track: int  # number of the track, -1 = none
    score: float
    tag_offset_m: float  # of the tag ahead of its host's centre
    confidence: float  # best score / (best + second-best score): 0.5 for a tie, 1 for a single candidate
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

    Paths and antenna are in one frame whose z is up. A tag without reads, or without paths, has `NO_MATCH`. Of equal
    scores the lower number is chosen. Several tags may get the same path, unless `exclusive`: then those that gain
    least get none. A path may get no tag.
    """
    numbers = sorted(paths_m)
    if not numbers:
        return dict.fromkeys(epcs, NO_MATCH)
    scores = np.full((len(epcs), len(numbers)), -np.inf)
    offsets = np.zeros((len(epcs), len(numbers)))
    paths = np.stack([paths_m[number] for number in numbers])
    positions = _tag_positions(time_s, paths, settings.tag_offsets_m)
    for tag, epc in enumerate(epcs):
        own = reads.epc == epc
        if own.any():
            scores[tag], offsets[tag] = _scores(time_s, positions, reads[own], read_time_s[own], antenna_m, settings)
    return _choose(epcs, numbers, scores, offsets, settings.exclusive)


def _tag_positions(
    time_s: Float[np.ndarray, " frames"], paths_m: Float[np.ndarray, "tracks frames 3"], offsets_m: Sequence[float]
) -> Float[np.ndarray, "tracks offsets frames 3"]:
    """Candidate positions of a tag: ahead of its host's centre, in the direction of motion."""
    ahead = np.stack([_without_gaps(motion_direction(time_s, path)) for path in paths_m])
    return paths_m[:, None] + np.asarray(offsets_m)[None, :, None, None] * ahead[:, None]


def _without_gaps(direction: Float[np.ndarray, "frames 3"]) -> Float[np.ndarray, "frames 3"]:
    """The last direction of motion where an object stands still, or the first one to come; zero where it never
    moves.
    """
    known = np.flatnonzero(np.isfinite(direction[:, 0]))
    if not len(known):
        return np.zeros_like(direction)
    last = np.searchsorted(known, np.arange(len(direction)), side="right") - 1
    return direction[known[np.maximum(last, 0)]]


def _scores(
    time_s: Float[np.ndarray, " frames"],
    positions_m: Float[np.ndarray, "tracks offsets frames 3"],
    reads: TagReads,
    read_time_s: Float[np.ndarray, " reads"],
    antenna_m: Float[np.ndarray, " 3"],
    settings: MatchSettings,
) -> tuple[Float[np.ndarray, " tracks"], Float[np.ndarray, " tracks"]]:
    """Score and best tag offset of every track for one tag; -inf for tracks with too few snapshots."""
    pair = pair_nearest if settings.pairing == "nearest" else pair_interpolated
    gap_s = float("inf") if settings.max_gap_s is None else settings.max_gap_s
    num_tracks, num_offsets = positions_m.shape[:2]
    flat = positions_m.reshape(num_tracks * num_offsets, *positions_m.shape[2:])
    paired = [pair(time_s, position, read_time_s, max_gap_s=gap_s) for position in flat]
    index = paired[0][0]  # the same for all candidates: it depends on times only
    valid = np.stack([counted for _, _, counted in paired])
    distance_m = np.stack([np.linalg.norm(position - antenna_m, axis=1) for _, position, _ in paired])
    phase_rad, carrier_hz = range_phase_rad(reads), np.asarray(reads.carrier_hz, np.float64)
    snapshots = _padded(phase_rad[index], carrier_hz[index], distance_m, valid, _PAD_TRACKS * num_offsets)
    affine = settings.hops == "affine"
    slope = hop_slope_rad_hz(phase_rad, read_time_s, carrier_hz) if affine else float("nan")
    found = match_scores(
        snapshots,
        key=jax.random.key(settings.seed),
        num_snapshots=settings.num_snapshots,
        num_rounds=settings.num_rounds,
        sigma_rad=settings.sigma_rad,
        reference=settings.reference,
        angle_multiple=settings.angle_multiple,
        hop_slope_rad_hz=jnp.asarray(slope, jnp.float32),
    )
    score = np.asarray(found, np.float64)[: len(flat)].reshape(num_tracks, num_offsets)
    known = valid.sum(axis=1).reshape(num_tracks, num_offsets)
    # Few snapshots fit any path: a shadow tracked for one second would score above its object tracked for ten.
    enough = (known >= settings.min_snapshots) & (known >= settings.min_snapshot_fraction * known.max())
    score = np.where(enough, score, -np.inf)
    best = np.argmax(score, axis=1)
    return score[np.arange(num_tracks), best], np.asarray(settings.tag_offsets_m)[best]


def _padded(
    phase_rad: Float[np.ndarray, " snapshots"],
    carrier_hz: Float[np.ndarray, " snapshots"],
    distance_m: Float[np.ndarray, "candidates snapshots"],
    valid: Bool[np.ndarray, "candidates snapshots"],
    row_step: int,
) -> Snapshots:
    """Snapshots in buffers of a few sizes, so that few programs are compiled."""
    rows = padded_size(valid.shape[0], row_step) - valid.shape[0]
    columns = padded_size(valid.shape[1], _PAD_SNAPSHOTS) - valid.shape[1]
    shape = ((0, rows), (0, columns))
    return Snapshots(
        jnp.asarray(np.pad(phase_rad, (0, columns)), jnp.float32),
        jnp.asarray(np.pad(carrier_hz, (0, columns), constant_values=9e8), jnp.float32),
        jnp.asarray(np.pad(np.where(valid, distance_m, 0.0), shape), jnp.float32),
        jnp.asarray(np.pad(valid, shape)),
    )


def _choose(
    epcs: Sequence[str],
    numbers: Sequence[int],
    scores: Float[np.ndarray, "tags tracks"],
    offsets_m: Float[np.ndarray, "tags tracks"],
    exclusive: bool,
) -> dict[str, Match]:
    if exclusive:
        chosen = np.asarray(hard_assignment(scores))
    else:
        chosen = np.where(np.isfinite(scores).any(axis=1), np.argmax(scores, axis=1), -1)
    matches = {}
    for tag, epc in enumerate(epcs):
        column, row = int(chosen[tag]), scores[tag]
        candidates = {number: float(row[i]) for i, number in enumerate(numbers) if np.isfinite(row[i])}
        if column < 0:
            matches[epc] = dataclasses.replace(NO_MATCH, scores=candidates)
            continue
        score = float(row[column])
        other = float(np.max(np.delete(row, column), initial=0.0))
        confidence = score / (score + other) if score + other > 0 else 0.0
        matches[epc] = Match(numbers[column], score, float(offsets_m[tag, column]), confidence, candidates)
    return matches
