"""Tracking of blobs by mean shift on intensity histograms (Goller et al., III.B), with a limit on speed."""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ...recording import Intrinsics
from ..boxes import box_area_px, box_centre_px, intersection_px
from ..opencv import grey, mean_shift
from .blob_location import BlobLocator
from .detection import BlobDetector, BlobSettings, Component, column_overlap, find_components
from .room import RoomFrame

_MIN_COLUMN_OVERLAP = 0.5
_HEIGHTS_M = (1.0, 2.2)  # range of the estimated height of a person
_HEIGHT_RATE = 0.2


@dataclasses.dataclass(frozen=True)
class Blob:
    """One blob in one frame."""

    identity: int  # from 1, never used twice
    box_px: Int[np.ndarray, " 4"]
    position_m: Float[np.ndarray, " 2"]  # room frame


@dataclasses.dataclass
class _Track:
    identity: int
    box_px: np.ndarray
    histogram: np.ndarray
    position_m: np.ndarray
    first_m: np.ndarray
    drift_px: np.ndarray
    height_m: float
    travelled: bool = False
    missed: int = 0
    merged: int = 0


class BlobTracker:
    """Detects and tracks blobs frame by frame; holds OpenCV's background model, so one tracker serves one video."""

    def __init__(self, settings: BlobSettings, room: RoomFrame, intrinsics: Intrinsics):
        self.settings = settings
        self.locator = BlobLocator(settings, room, intrinsics)
        self._detector = BlobDetector(settings)
        self._tracks: list[_Track] = []
        self._last_s: float | None = None
        self._num_identities = 0

    def warm_up(self, empty: UInt8[np.ndarray, "height width 3"]) -> None:
        """Train the background model on the empty scene before the first frame."""
        self._detector.warm_up(empty)

    def step(
        self, colour: UInt8[np.ndarray, "height width 3"], depth_m: Float[np.ndarray, "height width"], time_s: float
    ) -> tuple[list[Blob], Int[np.ndarray, "height width"]]:
        """The blobs of the next frame, and for each pixel the identity of its blob, 0 for none."""
        elapsed_s = 0.0 if self._last_s is None else time_s - self._last_s
        self._last_s = time_s
        solid = self._detector.foreground(colour)
        intensity = grey(colour)
        components = find_components(solid)
        boxes = np.array([one.box_px for one in components]).reshape(-1, 4)
        candidates: list[list[_Track]] = [[] for _ in components]
        for track in self._tracks:
            self._shift(track, intensity, solid)
            shared = intersection_px(track.box_px[None], boxes)[0]
            if shared.max(initial=0) > 0:
                candidates[int(np.argmax(shared))].append(track)
                track.missed = 0
            else:
                track.missed += 1
        identity = np.zeros(solid.shape, np.int32)
        for component, tracks in zip(components, candidates, strict=True):
            kept = self._without_fragments(tracks)
            if not kept:
                self._begin(component, intensity, depth_m)
                continue
            if len(kept) == 1:
                self._update(kept[0], component, intensity)
                identity[component.mask] = kept[0].identity
            else:
                _divide(component.mask, kept, identity)
            for track in kept:
                self._move(track, identity == track.identity, depth_m, elapsed_s)
        self._tracks = [track for track in self._tracks if track.missed <= self.settings.max_missed]
        reported = [track for track in self._tracks if track.travelled]
        identity[~np.isin(identity, [track.identity for track in reported])] = 0
        return [Blob(track.identity, track.box_px, track.position_m.copy()) for track in reported], identity

    def _without_fragments(self, tracks: list[_Track]) -> list[_Track]:
        """The tracks that remain of those that share one component.

        Parts of one body may become blobs before they grow together. Of two blobs in one column of the picture the one
        that has travelled remains, or the larger; if both have travelled, they are people who pass each other, for at
        most `max_merged` frames.
        """
        kept: list[_Track] = []
        for track in sorted(tracks, key=_priority):
            above = any(column_overlap(track.box_px, other.box_px) >= _MIN_COLUMN_OVERLAP for other in kept)
            track.merged = track.merged + 1 if above else 0
            if above and (not track.travelled or track.merged > self.settings.max_merged):
                self._tracks.remove(track)
            else:
                kept.append(track)
        return kept

    def _shift(
        self, track: _Track, intensity: UInt8[np.ndarray, "height width"], solid: Bool[np.ndarray, "height width"]
    ) -> None:
        """Mean shift (Comaniciu et al., 2000) on foreground of the blob's intensities, from its predicted position."""
        height, width = intensity.shape
        columns, rows = track.box_px[2:] - track.box_px[:2] + 1
        x, y = np.rint(track.box_px[:2] + track.drift_px).astype(int)
        x, y = int(np.clip(x, 1 - columns, width - 1)), int(np.clip(y, 1 - rows, height - 1))
        weight = cv2.calcBackProject([intensity], [0], track.histogram, [0, 256], 1.0)
        weight[~solid] = 0
        # OpenCV needs the start within the picture.
        left, top = max(x, 0), max(y, 0)
        start = (left, top, int(min(x + columns, width)) - left, int(min(y + rows, height)) - top)
        before = box_centre_px(track.box_px)
        track.box_px = mean_shift(np.asarray(weight), start)
        track.drift_px = 0.5 * track.drift_px + 0.5 * (box_centre_px(track.box_px) - before)

    def _histogram(
        self, intensity: UInt8[np.ndarray, "height width"], mask: Bool[np.ndarray, "height width"]
    ) -> np.ndarray:
        bins = self.settings.num_bins
        histogram = cv2.calcHist([intensity], [0], mask.astype(np.uint8), [bins], [0, 256])
        return histogram * (255.0 / max(float(histogram.max()), 1.0))

    def _update(self, track: _Track, component: Component, intensity: UInt8[np.ndarray, "height width"]) -> None:
        before, rate = box_centre_px(track.box_px), self.settings.histogram_rate
        track.drift_px = track.drift_px + 0.5 * (box_centre_px(component.box_px) - before)
        track.box_px = component.box_px
        seen = self._histogram(intensity, component.mask)
        track.histogram = ((1 - rate) * track.histogram + rate * seen).astype(np.float32)

    def _begin(
        self,
        component: Component,
        intensity: UInt8[np.ndarray, "height width"],
        depth_m: Float[np.ndarray, "height width"],
    ) -> None:
        """A new blob, if its size is in range and no track covers half of it already."""
        box_px = component.box_px
        covered = [intersection_px(track.box_px[None], box_px[None])[0, 0] for track in self._tracks]
        if any(area > 0.5 * box_area_px(box_px) for area in covered):
            return
        position = self.locator.position(box_px, component.mask, depth_m)
        if position is None:
            return
        visible_m2 = self.locator.visible_area_m2(component.area_px, position)
        if not self.settings.area_m2[0] <= visible_m2 <= self.settings.area_m2[1]:
            return
        self._num_identities += 1
        histogram = self._histogram(intensity, component.mask)
        tall = self.settings.person_height_m
        self._tracks.append(_Track(self._num_identities, box_px, histogram, position, position, np.zeros(2), tall))

    def _move(
        self,
        track: _Track,
        mask: Bool[np.ndarray, "height width"],
        depth_m: Float[np.ndarray, "height width"],
        elapsed_s: float,
    ) -> None:
        """Move the track to its measured position, no faster than the limit."""
        position = self.locator.position(track.box_px, mask, depth_m, track.height_m)
        if position is None:
            return
        if self.settings.position == "foot" and self.locator.shows_whole(track.box_px):
            seen = float(np.clip(self.locator.height_m(track.box_px, position), *_HEIGHTS_M))
            track.height_m += _HEIGHT_RATE * (seen - track.height_m)
        step = position - track.position_m
        length = float(np.linalg.norm(step))
        allowed = self.settings.max_speed_m_s * elapsed_s
        track.position_m = track.position_m + step * min(1.0, allowed / max(length, 1e-9))
        distance = float(np.linalg.norm(track.position_m - track.first_m))
        track.travelled = track.travelled or distance >= self.settings.min_travel_m


def _priority(track: _Track) -> tuple[bool, int]:
    """Sorts tracks: travelled ones first by age, then the others by size."""
    return not track.travelled, track.identity if track.travelled else -int(box_area_px(track.box_px))


def _divide(
    mask: Bool[np.ndarray, "height width"], tracks: list[_Track], identity: Int[np.ndarray, "height width"]
) -> None:
    """Write into `identity` the nearest of several tracks for each pixel of a component."""
    rows, columns = np.nonzero(mask)
    pixels = np.stack([columns, rows])
    distance = [np.hypot(*(pixels - box_centre_px(track.box_px)[:, None])) for track in tracks]
    identities = np.array([track.identity for track in tracks])
    identity[rows, columns] = identities[np.argmin(distance, axis=0)]
