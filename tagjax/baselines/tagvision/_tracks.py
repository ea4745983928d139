"""Blobs followed from frame to frame by mean shift on their colours (TagVision, III.A; Comaniciu and Meer, 2002)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ...core.assignment import hard_assignment
from ._blobs import Blob, filled

_BINS = 512  # 8 a channel
_RING_PX = 8
_SAME_SIZE = 1.6  # two things that touch make a blob of twice one's area
_YOUNG = 10
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1.0)


@dataclasses.dataclass(frozen=True)
class TrackSettings:
    """How blobs become tracks. Lengths are in sizes of the object itself (the root of its area)."""

    confirm_frames: int = 3  # in which a blob must have been seen before it counts
    patience_s: float = 1.0  # a track that nothing supports for this long ends
    reach: float = 1.0  # a blob this near to where mean shift ends is the track's
    learning: float = 0.05  # share of each frame in a track's colours
    least_mass: float = 0.35  # share of its own area whose colours must be there where no blob is
    velocity_share: float = 0.5  # of the last step in the velocity with which mean shift starts

    def __post_init__(self):
        if self.confirm_frames < 1 or not self.patience_s > 0 or not self.reach > 0:
            raise ValueError(
                f"confirm_frames {self.confirm_frames}, patience_s {self.patience_s}, reach {self.reach}; expected at "
                "least 1 frame and positive numbers."
            )
        for name in ("learning", "least_mass", "velocity_share"):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a share between 0 and 1.")


@dataclasses.dataclass(frozen=True)
class BlobTrack:
    """One object as it is followed. Numbers count up and are never used again."""

    number: int
    centre_px: Float[np.ndarray, " 2"]
    velocity_px_s: Float[np.ndarray, " 2"]
    mask: Bool[np.ndarray, "rows columns"]  # within its window
    left: int
    top: int
    area_px: float
    colours: Float[np.ndarray, " bins"]  # histogram, sum 1
    num_blobs: int  # frames in which a blob supported it
    born_s: float
    blob_s: float  # when a blob last did
    seen_s: float  # when a blob or its colours last did
    time_s: float

    def is_seen(self) -> bool:
        """Whether this frame supports it; otherwise its place is a guess."""
        return self.seen_s == self.time_s

    def full_mask(self, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        """The mask in the whole picture; empty where it is not seen."""
        out = np.zeros(shape, bool)
        if self.is_seen():
            rows, columns = self.mask.shape
            out[self.top : self.top + rows, self.left : self.left + columns] = self.mask
        return out


@dataclasses.dataclass(frozen=True)
class Tracks:
    """All tracks at one frame, oldest first, and the number that the next one gets."""

    tracks: tuple[BlobTrack, ...] = ()
    next_number: int = 0


def follow(
    state: Tracks,
    colour: UInt8[np.ndarray, "height width 3"],
    blobs: Sequence[Blob],
    time_s: float,
    settings: TrackSettings,
) -> Tracks:
    """One frame on: mean shift moves every track, blobs correct it, blobs of no track begin new ones.

    A blob near the end of a track's mean shift, of a size like its own, gives place and outline. Where blobs run
    together, or an object stands still and has none, mean shift alone does.
    """
    bins = colour_bins(colour)
    moved = [_shifted(track, state.tracks, bins, time_s, settings) for track in state.tracks]
    chosen, shared = _assign(moved, blobs, settings)
    tracks = []
    for before, track, index in zip(state.tracks, moved, chosen, strict=True):
        if index >= 0:
            tracks.append(_corrected(before, blobs[index], bins, time_s, settings))
        elif time_s - track.seen_s <= settings.patience_s and _inside(track, bins.shape):
            tracks.append(track)
    taken = {int(index) for index in chosen if index >= 0} | shared
    number = state.next_number
    for index, blob in enumerate(blobs):
        if index not in taken:
            tracks.append(_born(number, blob, bins, time_s))
            number += 1
    return Tracks(_without_doubles(tracks), number)


def colour_bins(colour: UInt8[np.ndarray, "height width 3"]) -> Int[np.ndarray, "height width"]:
    """The number of each pixel's colour among 8 x 8 x 8."""
    eighth = (colour >> 5).astype(np.int64)
    return eighth[..., 0] * 64 + eighth[..., 1] * 8 + eighth[..., 2]


def _histogram(bins: np.ndarray) -> np.ndarray:
    counts = np.bincount(bins, minlength=_BINS).astype(np.float64)
    return counts / max(counts.sum(), 1.0)


def _born(number: int, blob: Blob, bins: np.ndarray, time_s: float) -> BlobTrack:
    rows, columns = blob.mask.shape
    own = bins[blob.top : blob.top + rows, blob.left : blob.left + columns][blob.mask]
    return BlobTrack(
        number, blob.centre_px, np.zeros(2), blob.mask, blob.left, blob.top, float(blob.area_px), _histogram(own), 1,
        time_s, time_s, time_s, time_s,
    )  # fmt: skip


def _corrected(before: BlobTrack, blob: Blob, bins: np.ndarray, time_s: float, settings: TrackSettings) -> BlobTrack:
    """The track of the frame before, moved to its blob."""
    born, mix = _born(before.number, blob, bins, time_s), settings.learning
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
    return (1 - settings.velocity_share) * before.velocity_px_s + settings.velocity_share * step


def _shifted(
    track: BlobTrack, tracks: Sequence[BlobTrack], bins: np.ndarray, time_s: float, settings: TrackSettings
) -> BlobTrack:
    """Mean shift from where the track should be by now, over the share of each pixel's colour that is its own."""
    expected = track.centre_px + track.velocity_px_s * (time_s - track.time_s)
    rows, columns = track.mask.shape
    margin = round(float(np.sqrt(track.area_px))) + _RING_PX
    left, top = (round(float(v)) for v in expected - np.array([columns, rows]) / 2 - margin)
    window = (
        slice(max(0, top), max(0, min(bins.shape[0], top + rows + 2 * margin))),
        slice(max(0, left), max(0, min(bins.shape[1], left + columns + 2 * margin))),
    )
    lost = dataclasses.replace(track, centre_px=expected, time_s=time_s)
    part = bins[window]
    if min(part.shape) < 4:
        return lost
    own = _own_share(track, tracks, part, window)
    weight = np.rint(255 * own).astype(np.uint8)
    # The kernel is a little larger than the object, whose mask's window has room around it already.
    size = max(5, round(1.25 * float(np.sqrt(track.area_px))))
    x, y = np.clip(np.rint(expected - [window[1].start, window[0].start] - size / 2), 0, None).astype(int)
    start = (int(min(x, part.shape[1] - 1)), int(min(y, part.shape[0] - 1)), size, size)
    _, (x, y, width, height) = cv2.meanShift(weight, start, _STOP)
    inside = own[y : y + height, x : x + width]
    # Colours that the ground has as well support nothing.
    support = float(np.maximum(2 * inside - 1, 0).sum())
    # A shadow on patterned ground has colours too: nothing lives on them for longer than it was seen to move.
    stale = time_s - track.blob_s > track.blob_s - track.born_s + settings.patience_s
    if stale or support < max(1.0, settings.least_mass * track.area_px):
        return lost
    mask = np.zeros(part.shape, bool)
    mask[y : y + height, x : x + width] = inside > 0.5
    mask = filled(_largest(mask))
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


def _own_share(
    track: BlobTrack, tracks: Sequence[BlobTrack], part: np.ndarray, window: tuple[slice, slice]
) -> np.ndarray:
    """p(colour | track) over the sum of that and what the ground and the other tracks near by make of it."""
    known = np.zeros(part.shape, bool)
    others = np.zeros(_BINS)
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
    grown = cv2.dilate(known.astype(np.uint8), np.ones((_RING_PX, _RING_PX), np.uint8)).astype(bool)
    ground = _histogram(part[~grown]) if np.any(~grown) else np.full(_BINS, 1.0 / _BINS)
    total = track.colours + ground + others
    share = np.divide(track.colours, total, out=np.zeros(_BINS), where=total > 0)
    return share[part]


def _assign(moved: Sequence[BlobTrack], blobs: Sequence[Blob], settings: TrackSettings) -> tuple[np.ndarray, set[int]]:
    """The blob of each track (-1 for none), and the blobs that lie on tracks without being one's own."""
    if not moved or not blobs:
        return np.full(len(moved), -1), set()
    score = np.full((len(moved), len(blobs)), -np.inf)
    touched: set[int] = set()
    for i, track in enumerate(moved):
        size = np.sqrt(track.area_px)
        for j, blob in enumerate(blobs):
            away = float(np.linalg.norm(blob.centre_px - track.centre_px)) / size
            same_size = 1 / _SAME_SIZE < blob.area_px / track.area_px < _SAME_SIZE
            # What only begins to move shows in part; what mean shift has lost has no better place.
            if away < settings.reach and (same_size or track.num_blobs < _YOUNG or not track.is_seen()):
                score[i, j] = -away
            if away < settings.reach or _covers(blob, track.centre_px):
                touched.add(j)
    return np.asarray(hard_assignment(score, unmatched_score=-10.0)), touched


def _covers(blob: Blob, place_px: np.ndarray) -> bool:
    x, y = np.rint(place_px).astype(int) - [blob.left, blob.top]
    rows, columns = blob.mask.shape
    return bool(0 <= x < columns and 0 <= y < rows and blob.mask[y, x])


def _without_doubles(tracks: Sequence[BlobTrack]) -> tuple[BlobTrack, ...]:
    """Of two tracks that lie on each other the younger goes."""
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


def _largest(mask: np.ndarray) -> np.ndarray:
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    return mask if count < 2 else labels == 1 + int(np.argmax(stats[1:, cv2.CC_STAT_AREA]))
