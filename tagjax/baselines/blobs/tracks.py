"""Tracks of blobs: a Kalman filter of constant velocity for each, and the best assignment of blobs to tracks."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ...core.assignment import hard_assignment
from .detection import Blob
from .settings import BlobSettings

_START_SPEED_M_S = 1.0  # standard deviation of a new track's velocity


@dataclasses.dataclass(frozen=True)
class Track:
    """A blob over time. The covariance is the same for the three axes: of position and velocity."""

    number: int
    born_s: float
    seen_s: float  # the last time that it had a blob
    position_m: Float[np.ndarray, " 3"]
    velocity_m_s: Float[np.ndarray, " 3"]
    covariance: Float[np.ndarray, "2 2"]
    blob: Blob | None  # of this frame
    part: bool = False  # of a part of a body, not of a whole one

    def predicted(self, elapsed_s: float, acceleration_m2_s3: float) -> Track:
        """The track after some time without a measurement, with white acceleration of this spectral density."""
        move = np.array([[1.0, elapsed_s], [0.0, 1.0]])
        push = np.array([[elapsed_s**3 / 3, elapsed_s**2 / 2], [elapsed_s**2 / 2, elapsed_s]]) * acceleration_m2_s3
        return dataclasses.replace(
            self,
            position_m=self.position_m + elapsed_s * self.velocity_m_s,
            covariance=move @ self.covariance @ move.T + push,
            blob=None,
        )

    def measured(self, blob: Blob, time_s: float, position_m: float) -> Track:
        """The track with a blob's centre measured, of standard deviation `position_m`."""
        gain = self.covariance[:, 0] / (self.covariance[0, 0] + position_m**2)
        off = blob.centre_m - self.position_m
        return dataclasses.replace(
            self,
            seen_s=time_s,
            position_m=self.position_m + gain[0] * off,
            velocity_m_s=self.velocity_m_s + gain[1] * off,
            covariance=self.covariance - np.outer(gain, self.covariance[0]),
            blob=blob,
        )


def follow(
    tracks: Sequence[Track],
    blobs: Sequence[Blob],
    time_s: float,
    elapsed_s: float,
    next_number: int,
    settings: BlobSettings,
    *,
    part: bool = False,
) -> tuple[tuple[Track, ...], int]:
    """The tracks after a frame, and the number that the next new one gets. New tracks are of parts if `part` is true."""
    ahead = [track.predicted(elapsed_s, settings.acceleration_m2_s3) for track in tracks]
    away = np.array([[np.linalg.norm(t.position_m - blob.centre_m) for blob in blobs] for t in ahead])
    away = away.reshape(len(ahead), len(blobs))
    chosen = hard_assignment(np.where(away <= settings.gate_m, -away, -np.inf))
    after = [
        track if blob < 0 else track.measured(blobs[blob], time_s, settings.position_m)
        for track, blob in zip(ahead, chosen, strict=True)
    ]
    kept = [track for track in after if time_s - track.seen_s <= settings.max_unseen_s]
    start = np.diag([settings.position_m**2, _START_SPEED_M_S**2])
    for number, blob in enumerate(blobs):
        if number not in chosen:
            kept.append(Track(next_number, time_s, time_s, blob.centre_m, np.zeros(3), start, blob, part))
            next_number += 1
    return tuple(kept), next_number
