"""Tracking by SORT (Bewley et al., 2016; Tagview, III.B): a Kalman filter for each box, assignment by IoU."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float, Shaped

from ...core.assignment import hard_assignment
from ..boxes import box_centre_px, box_iou, box_size_px


@dataclasses.dataclass(frozen=True)
class SortSettings:
    """Times are in frames, variances as in the authors' program."""

    min_iou: float = 0.2  # of a detection with the predicted box
    max_missed: int = 3  # frames without a detection before a track ends
    confirm_frames: int = 3  # consecutive detections that confirm a track
    noise_px: float = 1.0  # standard deviation of a detected centre
    size_noise: float = 10.0  # variance of area (px^2) and aspect, in units of the centre's
    process_noise_px: float = 1.0  # standard deviation of the centre's change in a frame beside its velocity

    def __post_init__(self):
        if not 0 <= self.min_iou < 1:
            raise ValueError(f"min_iou is {self.min_iou}; expected 0 to below 1.")
        if self.max_missed < 0 or self.confirm_frames < 1:
            raise ValueError(
                f"max_missed {self.max_missed}, confirm_frames {self.confirm_frames}; expected at least 0 and 1."
            )
        if not (self.noise_px > 0 and self.process_noise_px > 0 and self.size_noise > 0):
            raise ValueError(
                f"noise_px {self.noise_px}, process_noise_px {self.process_noise_px}, size_noise {self.size_noise}; expected "
                "positive numbers."
            )


@dataclasses.dataclass(frozen=True)
class BoxTrack:
    """One tracked object: the filter's state (x, y, area, aspect, and the rates of the first three; Eq. 1)."""

    number: int  # from 1, never used twice
    mean: Float[np.ndarray, " 7"]
    covariance: Float[np.ndarray, "7 7"]
    hits: int  # number of detections
    missed: int  # frames since the last one
    confirmed: bool

    @property
    def box_px(self) -> Float[np.ndarray, " 4"]:
        """The box of the filter's state: x0 y0 x1 y1, first and last pixel."""
        return _to_box(self.mean)


@dataclasses.dataclass(frozen=True)
class BoxTracks:
    """All current tracks, and the next free number."""

    tracks: tuple[BoxTrack, ...] = ()
    next_number: int = 1


_TRANSITION = np.eye(7)
_TRANSITION[[0, 1, 2], [4, 5, 6]] = 1.0
_OBSERVATION = np.eye(4, 7)


def track_boxes(state: BoxTracks, boxes_px: Shaped[np.ndarray, "boxes 4"], settings: SortSettings) -> BoxTracks:
    """The tracks after one more frame with these detections; the given state is not modified.

    Detections are assigned to tracks one to one with the highest total IoU; a detection without a track begins a new
    one. A track that is not yet confirmed ends at its first miss.
    """
    predicted = [_predict(track, settings) for track in state.tracks]
    boxes_px = np.asarray(boxes_px, np.float64).reshape(-1, 4)
    chosen = np.full(len(predicted), -1)
    if len(predicted) and len(boxes_px):
        iou = box_iou(np.array([track.box_px for track in predicted]), boxes_px)
        chosen = hard_assignment(np.where(iou > settings.min_iou, iou, -np.inf), unmatched_score=0.0)
    after = []
    for track, box in zip(predicted, chosen, strict=True):
        if box >= 0:
            after.append(_update(track, boxes_px[box], settings))
        elif track.confirmed and track.missed < settings.max_missed:
            after.append(dataclasses.replace(track, missed=track.missed + 1))
    number = state.next_number
    for box in sorted(set(range(len(boxes_px))) - set(chosen.tolist())):
        after.append(_begin(number, boxes_px[box], settings))
        number += 1
    return BoxTracks(tuple(after), number)


def _begin(number: int, box_px: np.ndarray, settings: SortSettings) -> BoxTrack:
    mean = np.concatenate([_measured(box_px), np.zeros(3)])
    # Centre and size are as accurate as the detector, the rates are unknown (the authors' 10 and 10^4).
    covariance = settings.noise_px**2 * np.diag([10.0, 10.0, 10.0, 10.0, 1e4, 1e4, 1e4])
    return BoxTrack(number, mean, covariance, 1, 0, settings.confirm_frames <= 1)


def _predict(track: BoxTrack, settings: SortSettings) -> BoxTrack:
    mean = track.mean.copy()
    if mean[2] + mean[6] <= 0:
        mean[6] = 0.0  # an area stays positive
    noise = settings.process_noise_px**2 * np.diag([1.0, 1.0, 1.0, 1e-2, 0.25, 0.25, 1e-2])
    covariance = _TRANSITION @ track.covariance @ _TRANSITION.T + noise
    return dataclasses.replace(track, mean=_TRANSITION @ mean, covariance=covariance)


def _update(track: BoxTrack, box_px: np.ndarray, settings: SortSettings) -> BoxTrack:
    noise = settings.noise_px**2 * np.diag([1.0, 1.0, settings.size_noise, settings.size_noise])
    gain = np.linalg.solve(_OBSERVATION @ track.covariance @ _OBSERVATION.T + noise, _OBSERVATION @ track.covariance).T
    mean = track.mean + gain @ (_measured(box_px) - _OBSERVATION @ track.mean)
    mean[2:4] = np.maximum(mean[2:4], 1e-3)
    kept = np.eye(7) - gain @ _OBSERVATION
    covariance = kept @ track.covariance @ kept.T + gain @ noise @ gain.T
    hits = track.hits + 1
    return BoxTrack(track.number, mean, covariance, hits, 0, track.confirmed or hits >= settings.confirm_frames)


def _measured(box_px: np.ndarray) -> np.ndarray:
    """Centre, area and aspect (width / height) of a box."""
    width, height = np.maximum(box_size_px(box_px), 1e-3)
    return np.array([*box_centre_px(box_px), width * height, width / height])


def _to_box(mean: np.ndarray) -> np.ndarray:
    width = np.sqrt(np.maximum(mean[2], 1e-6) * np.maximum(mean[3], 1e-6))
    height = np.maximum(mean[2], 1e-6) / width
    half = 0.5 * (np.array([width, height]) - 1)
    return np.concatenate([mean[:2] - half, mean[:2] + half])
