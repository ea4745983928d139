"""Tracking of blobs by mean shift on colour histograms (TagVision, III.A; Comaniciu and Meer, 2002)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ...core.assignment import hard_assignment
from ..opencv import mean_shift, place_in_picture
from .detection import Blob, fill_holes

_NUM_BINS = 512  # 8 per channel
_MARGIN_PX = 8
_MAX_AREA_RATIO = 1.6  # two objects that touch make a blob of twice the area of one
_YOUNG_BLOBS = 10  # a track of fewer blobs may still grow


@dataclasses.dataclass(frozen=True)
class TrackSettings:
    """Settings of the tracker. The size of an object is the square root of its area."""

    confirm_frames: int = 3  # blobs of a track before it is a candidate
    max_unseen_s: float = 1.0  # a track without support for longer ends
    max_distance: float = 1.0  # of a blob to the end of mean shift, in sizes of the object
    histogram_rate: float = 0.05  # weight of one frame in a track's histogram
    min_support: float = 0.35  # pixels of its colours, as a fraction of its area, for a track without a blob
    velocity_rate: float = 0.5  # weight of the last step in the velocity that predicts the start of mean shift

    def __post_init__(self):
        if self.confirm_frames < 1 or not self.max_unseen_s > 0 or not self.max_distance > 0:
            raise ValueError(
                f"confirm_frames {self.confirm_frames}, max_unseen_s {self.max_unseen_s}, max_distance {self.max_distance}; "
                "expected at least 1 frame and positive numbers."
            )
        for name in ("histogram_rate", "min_support", "velocity_rate"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a fraction between 0 and 1.")


@dataclasses.dataclass(frozen=True)
class BlobTrack:
    """One tracked object. Numbers count up and are never used twice."""

    number: int
    centre_px: Float[np.ndarray, " 2"]
    velocity_px_s: Float[np.ndarray, " 2"]
    mask: Bool[np.ndarray, "rows columns"]  # within its window
    left: int
    top: int
    area_px: float
    colours: Float[np.ndarray, " bins"]  # histogram, sum 1
    num_blobs: int  # frames with a blob
    born_s: float
    blob_s: float  # time of the last blob
    seen_s: float  # time of the last support by a blob or by its colours
    time_s: float

    def is_seen(self) -> bool:
        """Whether this frame supports it; otherwise its position is a prediction."""
        return self.seen_s == self.time_s

    def full_mask(self, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        """The mask in the whole picture; empty where the object is not seen."""
        if not self.is_seen():
            return np.zeros(shape, bool)
        return place_in_picture(self.mask, self.left, self.top, shape)


@dataclasses.dataclass(frozen=True)
class Tracks:
    """All tracks at one frame, oldest first, and the number of the next new one."""

    tracks: tuple[BlobTrack, ...] = ()
    next_number: int = 0


def track_blobs(
    state: Tracks,
    colour: UInt8[np.ndarray, "height width 3"],
    blobs: Sequence[Blob],
    time_s: float,
    settings: TrackSettings,
) -> Tracks:
    """The tracks at the next frame: mean shift moves every track, blobs correct it, blobs without a track begin new
    ones.

    A blob near the end of a track's mean shift, of similar size, gives position and outline. Where blobs merge, or an
    object stands still and has none, mean shift alone gives them.
    """
    bins = colour_bins(colour)
    moved = [_shifted(track, state.tracks, bins, time_s, settings) for track in state.tracks]
    chosen, shared = _assign(moved, blobs, settings)
    tracks = []
    for before, track, index in zip(state.tracks, moved, chosen, strict=True):
        if index >= 0:
            tracks.append(_corrected(before, blobs[index], bins, time_s, settings))
        elif time_s - track.seen_s <= settings.max_unseen_s and _inside(track, bins.shape):
            tracks.append(track)
    used = {int(index) for index in chosen if index >= 0} | shared
    number = state.next_number
    for index, blob in enumerate(blobs):
        if index not in used:
            tracks.append(_born(number, blob, bins, time_s))
            number += 1
    return Tracks(_without_duplicates(tracks), number)


def colour_bins(colour: UInt8[np.ndarray, "height width 3"]) -> Int[np.ndarray, "height width"]:
    """The bin of each pixel's colour among 8 x 8 x 8."""
    eighth = (colour >> 5).astype(np.int64)
    return eighth[..., 0] * 64 + eighth[..., 1] * 8 + eighth[..., 2]


def _histogram(bins: np.ndarray) -> np.ndarray:
    counts = np.bincount(bins, minlength=_NUM_BINS).astype(np.float64)
    return counts / max(counts.sum(), 1.0)


def _born(number: int, blob: Blob, bins: np.ndarray, time_s: float) -> BlobTrack:
    rows, columns = blob.mask.shape
    own = bins[blob.top : blob.top + rows, blob.left : blob.left + columns][blob.mask]
    return BlobTrack(
        number, blob.centre_px, np.zeros(2), blob.mask, blob.left, blob.top, float(blob.area_px), _histogram(own), 1,
        time_s, time_s, time_s, time_s,
    )  # fmt: skip


def _corrected(before: BlobTrack, blob: Blob, bins: np.ndarray, time_s: float, settings: TrackSettings) -> BlobTrack:
    """The previous frame's track, updated by its blob."""
    born, mix = _born(before.number, blob, bins, time_s), settings.histogram_rate
    return dataclasses.replace(
        born,
        velocity_px_s=_velocity(before, blob.centre_px, time_s, settings),
        area_px=0.8 * before.area_px + 0.2 * born.area_px,
        colours=(1 - mix) * before.colours + mix * born.colours,
        num_blobs=before.num_blobs + 1,
        born_s=before.born_s,
    )


def _velocity(before: BlobTrack, centre_px: np.ndarray, time_s: float, settings: TrackSettings) -> np.ndarray:
    step = (centre_px - before.centre_px) / max(time_s - before.time_s, 1e-6)
    return (1 - settings.velocity_rate) * before.velocity_px_s + settings.velocity_rate * step


def _shifted(
    track: BlobTrack, tracks: Sequence[BlobTrack], bins: np.ndarray, time_s: float, settings: TrackSettings
) -> BlobTrack:
    """Mean shift from the predicted position, on the probability that each pixel's colour is the track's."""
    expected = track.centre_px + track.velocity_px_s * (time_s - track.time_s)
    rows, columns = track.mask.shape
    margin = round(float(np.sqrt(track.area_px))) + _MARGIN_PX
    left, top = (round(float(v)) for v in expected - np.array([columns, rows]) / 2 - margin)
    window = (
        slice(max(0, top), max(0, min(bins.shape[0], top + rows + 2 * margin))),
        slice(max(0, left), max(0, min(bins.shape[1], left + columns + 2 * margin))),
    )
    lost = dataclasses.replace(track, centre_px=expected, time_s=time_s)
    part = bins[window]
    if min(part.shape) < 4:
        return lost
    own = _colour_probability(track, tracks, part, window)
    weight = np.rint(255 * own).astype(np.uint8)
    # The kernel is a little larger than the object; the window has a margin around it.
    size = max(5, round(1.25 * float(np.sqrt(track.area_px))))
    x, y = np.clip(np.rint(expected - [window[1].start, window[0].start] - size / 2), 0, None).astype(int)
    start = (int(min(x, part.shape[1] - 1)), int(min(y, part.shape[0] - 1)), size, size)
    x0, y0, x1, y1 = mean_shift(weight, start)
    inside = own[y0 : y1 + 1, x0 : x1 + 1]
    # Colours that the ground has as well are no support.
    support = float(np.maximum(2 * inside - 1, 0).sum())
    # A shadow on patterned ground has colours too: no track lives on colours for longer than it had blobs.
    stale = time_s - track.blob_s > track.blob_s - track.born_s + settings.max_unseen_s
    if stale or support < max(1.0, settings.min_support * track.area_px):
        return lost
    mask = np.zeros(part.shape, bool)
    mask[y0 : y1 + 1, x0 : x1 + 1] = inside > 0.5
    mask = fill_holes(_largest_component(mask))
    rows_in, columns_in = np.nonzero(mask)
    centre = np.array([columns_in.mean() + window[1].start, rows_in.mean() + window[0].start])
    return dataclasses.replace(
        track,
        centre_px=centre,
        velocity_px_s=_velocity(track, centre, time_s, settings),
        mask=mask,
        left=window[1].start,
        top=window[0].start,
        seen_s=time_s,
        time_s=time_s,
    )


def _colour_probability(
    track: BlobTrack, tracks: Sequence[BlobTrack], part: np.ndarray, window: tuple[slice, slice]
) -> np.ndarray:
    """p(colour | track) / (p(colour | track) + p(colour | ground) + sum of p(colour | other track near by))."""
    known = np.zeros(part.shape, bool)
    others = np.zeros(_NUM_BINS)
    for other in tracks:
        rows, columns = other.mask.shape
        y0, x0 = other.top - window[0].start, other.left - window[1].start
        ys = slice(max(0, y0), max(0, min(part.shape[0], y0 + rows)))
        xs = slice(max(0, x0), max(0, min(part.shape[1], x0 + columns)))
        if ys.stop <= ys.start or xs.stop <= xs.start:
            continue
        known[ys, xs] |= other.mask[ys.start - y0 : ys.stop - y0, xs.start - x0 : xs.stop - x0]
        if other.number != track.number:
            others += other.colours
    grown = cv2.dilate(known.astype(np.uint8), np.ones((_MARGIN_PX, _MARGIN_PX), np.uint8)).astype(bool)
    ground = _histogram(part[~grown]) if np.any(~grown) else np.full(_NUM_BINS, 1.0 / _NUM_BINS)
    total = track.colours + ground + others
    return np.divide(track.colours, total, out=np.zeros(_NUM_BINS), where=total > 0)[part]


def _assign(moved: Sequence[BlobTrack], blobs: Sequence[Blob], settings: TrackSettings) -> tuple[np.ndarray, set[int]]:
    """The blob of each track (-1 for none), and the blobs that lie on tracks without belonging to one."""
    if not moved or not blobs:
        return np.full(len(moved), -1), set()
    score = np.full((len(moved), len(blobs)), -np.inf)
    covered: set[int] = set()
    for i, track in enumerate(moved):
        size = np.sqrt(track.area_px)
        for j, blob in enumerate(blobs):
            distance = float(np.linalg.norm(blob.centre_px - track.centre_px)) / size
            same_size = 1 / _MAX_AREA_RATIO < blob.area_px / track.area_px < _MAX_AREA_RATIO
            # An object that begins to move is detected in part; a lost track has no better position.
            if distance < settings.max_distance and (
                same_size or track.num_blobs < _YOUNG_BLOBS or not track.is_seen()
            ):
                score[i, j] = -distance
            if distance < settings.max_distance or _covers(blob, track.centre_px):
                covered.add(j)
    return np.asarray(hard_assignment(score, unmatched_score=-10.0)), covered


def _covers(blob: Blob, place_px: np.ndarray) -> bool:
    x, y = np.rint(place_px).astype(int) - [blob.left, blob.top]
    rows, columns = blob.mask.shape
    return bool(0 <= x < columns and 0 <= y < rows and blob.mask[y, x])


def _without_duplicates(tracks: Sequence[BlobTrack]) -> tuple[BlobTrack, ...]:
    """The tracks without those that lie on an older one."""
    kept: list[BlobTrack] = []
    for track in sorted(tracks, key=lambda one: one.number):
        near = any(
            np.linalg.norm(track.centre_px - older.centre_px) < 0.2 * np.sqrt(min(track.area_px, older.area_px))
            for older in kept
        )
        if not near:
            kept.append(track)
    return tuple(kept)


def _inside(track: BlobTrack, shape: tuple[int, int]) -> bool:
    x, y = track.centre_px
    return bool(0 <= x < shape[1] and 0 <= y < shape[0])


def _largest_component(mask: np.ndarray) -> np.ndarray:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return mask if count < 2 else labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
