"""Scores of several tracks at once: HOTA (Luiten et al., IJCV 2021), MOTA (CLEAR MOT) and IDF1 (Ristani et al., 2016).

A frame is given as the identities of the true objects and of the detections, and the overlap of each pair of them. State
-> merge -> result; sequences are merged as TrackEval merges them: counts are added.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy  # `scipy.optimize` is imported at its first use: it takes a quarter of a second
from jaxtyping import Float, Int

LEVELS = np.arange(0.05, 0.99, 0.05)
"""Overlaps from which a pair counts as a match, over which HOTA is averaged."""

MATCH = 0.5
"""The overlap of a match for MOTA and IDF1."""

_EPSILON = np.finfo(np.float64).eps


@dataclasses.dataclass(frozen=True)
class MatchFrame:
    """One frame: whole numbers that identify the true objects and the detections, and their overlaps."""

    true_ids: Int[np.ndarray, " true"]
    found_ids: Int[np.ndarray, " found"]
    overlap: Float[np.ndarray, "true found"]  # 0 to 1

    def without_ignored(self, ignored: Int[np.ndarray, " ignored"]) -> MatchFrame:
        """The frame without the true objects `ignored`, and without the detections that match one of them best."""
        ignore = np.isin(self.true_ids, ignored)
        drop = np.zeros(len(self.found_ids), dtype=bool)
        rows, columns = scipy.optimize.linear_sum_assignment(-np.where(self.overlap >= MATCH, self.overlap, 0.0))
        matched = self.overlap[rows, columns] >= MATCH
        drop[columns[matched & ignore[rows]]] = True
        return MatchFrame(self.true_ids[~ignore], self.found_ids[~drop], self.overlap[~ignore][:, ~drop])


def _zeros() -> Float[np.ndarray, " level"]:
    return np.zeros(len(LEVELS))


@dataclasses.dataclass(frozen=True)
class MultiObjectScores:
    """Accumulated counts of any number of sequences; the arrays have one element for each of `LEVELS`."""

    true_positives: Float[np.ndarray, " level"] = dataclasses.field(default_factory=_zeros)
    misses: Float[np.ndarray, " level"] = dataclasses.field(default_factory=_zeros)
    false_positives: Float[np.ndarray, " level"] = dataclasses.field(default_factory=_zeros)
    association: Float[np.ndarray, " level"] = dataclasses.field(default_factory=_zeros)  # summed over true positives
    clear_matches: int = 0
    clear_misses: int = 0
    clear_false: int = 0
    switches: int = 0
    identity_matches: int = 0
    identity_misses: int = 0
    identity_false: int = 0

    @classmethod
    def of(cls, frames: Sequence[MatchFrame]) -> MultiObjectScores:
        """The state of one sequence."""
        true_ids = np.unique(np.concatenate([frame.true_ids for frame in frames] or [np.zeros(0, int)]))
        found_ids = np.unique(np.concatenate([frame.found_ids for frame in frames] or [np.zeros(0, int)]))
        rows = [
            (np.searchsorted(true_ids, frame.true_ids), np.searchsorted(found_ids, frame.found_ids), frame.overlap)
            for frame in frames
        ]
        return cls(
            *_hota(rows, len(true_ids), len(found_ids)),
            *_clear(rows, len(true_ids)),
            *_identity(rows, len(true_ids), len(found_ids)),
        )

    def merge(self, other: MultiObjectScores) -> MultiObjectScores:
        return MultiObjectScores(
            **{
                field.name: getattr(self, field.name) + getattr(other, field.name)
                for field in dataclasses.fields(MultiObjectScores)
            }
        )

    def result(self) -> dict[str, float | int | None]:
        """hota, deta, assa (means over the levels), idf1, mota, id_switches; None without a true object."""
        num_true = self.clear_matches + self.clear_misses
        if not num_true:
            return dict.fromkeys(("hota", "deta", "assa", "idf1", "mota", "id_switches"))
        detection = self.true_positives / (self.true_positives + self.misses + self.false_positives)
        association = self.association / np.maximum(self.true_positives, 1.0)
        identity = self.identity_matches + 0.5 * (self.identity_misses + self.identity_false)
        return {
            "hota": float(np.mean(np.sqrt(detection * association))),
            "deta": float(np.mean(detection)),
            "assa": float(np.mean(association)),
            "idf1": self.identity_matches / identity,
            "mota": (self.clear_matches - self.clear_false - self.switches) / num_true,
            "id_switches": self.switches,
        }


Rows = Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]


def _counts(rows: Rows, num_true: int, num_found: int) -> tuple[np.ndarray, np.ndarray]:
    """In how many frames each true object, and each track, is present."""
    true = np.concatenate([true for true, _, _ in rows] or [np.zeros(0, int)])
    found = np.concatenate([found for _, found, _ in rows] or [np.zeros(0, int)])
    return np.bincount(true, minlength=num_true), np.bincount(found, minlength=num_found)


def _hota(rows: Rows, num_true: int, num_found: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """True positives, misses, false positives and the sum of association scores at each level.

    Detections are matched so that tracks which overlap over the whole sequence are preferred (HOTA, Eqs. 5-10).
    """
    true_count, found_count = _counts(rows, num_true, num_found)
    together = np.zeros((num_true, num_found))
    for true, found, overlap in rows:
        union = overlap.sum(axis=0, keepdims=True) + overlap.sum(axis=1, keepdims=True) - overlap
        together[np.ix_(true, found)] += np.divide(overlap, union, out=np.zeros_like(overlap), where=union > _EPSILON)
    jaccard = together / np.maximum(true_count[:, None] + found_count[None] - together, _EPSILON)
    hits, misses, false = _zeros(), _zeros(), _zeros()
    matches = np.zeros((len(LEVELS), num_true, num_found))
    for true, found, overlap in rows:
        row, column = scipy.optimize.linear_sum_assignment(-jaccard[np.ix_(true, found)] * overlap)
        matched = overlap[row, column] >= LEVELS[:, None] - _EPSILON
        number = matched.sum(axis=1)
        hits, misses, false = hits + number, misses + len(true) - number, false + len(found) - number
        matches[:, true[row], found[column]] += matched
    together_count = true_count[:, None] + found_count[None] - matches
    association = np.sum(matches * matches / np.maximum(together_count, 1.0), axis=(1, 2))
    return hits, misses, false, association


def _clear(rows: Rows, num_true: int) -> tuple[int, int, int, int]:
    """Matches, misses, false detections and switches of identity.

    Matches of the last frame are kept where they still overlap (Bernardin and Stiefelhagen, 2008).
    """
    last = np.full(num_true, -1)  # the track that an object had when it was matched last
    previous = np.full(num_true, -1)  # the track that it had in the last frame
    matches = misses = false = switches = 0
    for true, found, overlap in rows:
        if not len(true) or not len(found):
            misses, false = misses + len(true), false + len(found)
            continue
        score = np.where(overlap >= MATCH - _EPSILON, overlap + 1000.0 * (found[None] == previous[true][:, None]), 0.0)
        row, column = scipy.optimize.linear_sum_assignment(-score)
        kept = score[row, column] > _EPSILON
        row, column = true[row[kept]], found[column[kept]]
        switches += int(np.sum((last[row] >= 0) & (last[row] != column)))
        last[row] = column
        previous[:] = -1
        previous[row] = column
        matches, misses, false = matches + len(row), misses + len(true) - len(row), false + len(found) - len(row)
    return matches, misses, false, switches


def _identity(rows: Rows, num_true: int, num_found: int) -> tuple[int, int, int]:
    """Matches, misses and false detections.

    One track for each object over the whole sequence, so that as many detections as possible are right.
    """
    true_count, found_count = _counts(rows, num_true, num_found)
    together = np.zeros((num_true, num_found), dtype=int)
    for true, found, overlap in rows:
        together[np.ix_(true, found)] += overlap >= MATCH - _EPSILON
    row, column = scipy.optimize.linear_sum_assignment(
        -together
    )  # a pair that never overlaps costs as much as two alone
    matches = int(together[row, column].sum())
    return matches, int(true_count.sum()) - matches, int(found_count.sum()) - matches
