"""SORT (Bewley et al., 2016; Tagview, III.B): a constant-velocity Kalman filter for each box, assignment by overlap."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Shaped

from ...core.assignment import hard_assignment
from ._boxes import overlap


@dataclasses.dataclass(frozen=True)
class SortSettings:
    """Times in frames, variances as in the authors' program."""

    least_overlap: float = 0.2  # of a detection with the box predicted
    most_missed: int = 3  # frames without a detection after which a track ends
    confirm_frames: int = 3  # detections in a row that make a track
    noise_px: float = 1.0  # standard deviation of a detected middle
    size_noise: float = 10.0  # variance of area (px^2) and aspect, in units of the middle's, as the authors'
    process_px: float = 1.0  # change of the middle in a frame that its velocity does not foresee

    def __post_init__(self):
        if not 0 <= self.least_overlap < 1:
            raise ValueError(f"least_overlap is {self.least_overlap}; expected 0 to below 1.")
        if self.most_missed < 0 or self.confirm_frames < 1:
            raise ValueError(
                f"most_missed {self.most_missed}, confirm_frames {self.confirm_frames}; expected at least 0 and 1."
            )
        if not (self.noise_px > 0 and self.process_px > 0 and self.size_noise > 0):
            raise ValueError("noise_px, process_px and size_noise are standard deviations; expected positive ones.")


@dataclasses.dataclass(frozen=True)
class BoxTrack:
    """One thing followed: the filter's state (x, y, area, aspect, and the rates of the first three; Eq. 1)."""

    number: int  # from 1, never used twice
    mean: Float[np.ndarray, " 7"]
    covariance: Float[np.ndarray, "7 7"]
    hits: int  # detections in all
    missed: int  # frames since the last one
    confirmed: bool

    @property
    def box_px(self) -> Float[np.ndarray, " 4"]:
        """The box that the state says."""
        return _to_box(self.mean)


@dataclasses.dataclass(frozen=True)
class BoxTracks:
    """All tracks that are alive, and the next free number."""

    tracks: tuple[BoxTrack, ...] = ()
    next_number: int = 1


_MOVE = np.eye(7)
_MOVE[[0, 1, 2], [4, 5, 6]] = 1.0
_SEE = np.eye(4, 7)


def track_boxes(state: BoxTracks, boxes_px: Shaped[np.ndarray, "boxes 4"], settings: SortSettings) -> BoxTracks:
    """The tracks after one more frame with these detections; the given state stays as it is.

    Each detection goes to at most one track, so that the total overlap is highest; one without a track begins a new
    one, whose number is taken only then. A track that is not yet confirmed ends at its first miss.
    """
    moved = [_predict(track, settings) for track in state.tracks]
    boxes_px = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    chosen = np.full(len(moved), -1)
    if len(moved) and len(boxes_px):
        shared = overlap(np.array([track.box_px for track in moved]), boxes_px)
        chosen = hard_assignment(np.where(shared > settings.least_overlap, shared, -np.inf), unmatched_score=0.0)
    after = []
    for track, box in zip(moved, chosen, strict=True):
        if box >= 0:
            after.append(_update(track, boxes_px[box], settings))
        elif track.confirmed and track.missed < settings.most_missed:
            after.append(dataclasses.replace(track, missed=track.missed + 1))
    number = state.next_number
    for box in sorted(set(range(len(boxes_px))) - set(chosen.tolist())):
        after.append(_begin(number, boxes_px[box], settings))
        number += 1
    return BoxTracks(tuple(after), number)


def _begin(number: int, box_px: np.ndarray, settings: SortSettings) -> BoxTrack:
    mean = np.concatenate([_measured(box_px), np.zeros(3)])
    # The middle and its size are as good as the detector, the rates are unknown (the authors' 10 and 10^4).
    covariance = settings.noise_px**2 * np.diag([10.0, 10.0, 10.0, 10.0, 1e4, 1e4, 1e4])
    return BoxTrack(number, mean, covariance, 1, 0, settings.confirm_frames <= 1)


def _predict(track: BoxTrack, settings: SortSettings) -> BoxTrack:
    mean = track.mean.copy()
    if mean[2] + mean[6] <= 0:
        mean[6] = 0.0  # an area does not shrink through 0
    noise = settings.process_px**2 * np.diag([1.0, 1.0, 1.0, 1e-2, 0.25, 0.25, 1e-2])
    covariance = _MOVE @ track.covariance @ _MOVE.T + noise
    return dataclasses.replace(track, mean=_MOVE @ mean, covariance=covariance)


def _update(track: BoxTrack, box_px: np.ndarray, settings: SortSettings) -> BoxTrack:
    noise = settings.noise_px**2 * np.diag([1.0, 1.0, settings.size_noise, settings.size_noise])
    gain = np.linalg.solve(_SEE @ track.covariance @ _SEE.T + noise, _SEE @ track.covariance).T
    mean = track.mean + gain @ (_measured(box_px) - _SEE @ track.mean)
    mean[2:4] = np.maximum(mean[2:4], 1e-3)
    kept = np.eye(7) - gain @ _SEE
    covariance = kept @ track.covariance @ kept.T + gain @ noise @ gain.T
    hits = track.hits + 1
    return BoxTrack(track.number, mean, covariance, hits, 0, track.confirmed or hits >= settings.confirm_frames)


def _measured(box_px: np.ndarray) -> np.ndarray:
    """Middle, area and aspect (width / height) of a box."""
    width, height = np.maximum(box_px[2:] - box_px[:2], 1e-3)
    return np.array([*(0.5 * (box_px[:2] + box_px[2:])), width * height, width / height])


def _to_box(mean: np.ndarray) -> np.ndarray:
    width = np.sqrt(np.maximum(mean[2], 1e-6) * np.maximum(mean[3], 1e-6))
    height = np.maximum(mean[2], 1e-6) / width
    half = 0.5 * np.array([width, height])
    return np.concatenate([mean[:2] - half, mean[:2] + half])
