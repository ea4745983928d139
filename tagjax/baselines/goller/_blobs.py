"""Motion blobs (Goller et al., III.B): background subtraction, shadows, size and speed limits, mean-shift tracking."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, Integer, UInt8

from ...core.geometry import pixel_rays
from ...recording import Intrinsics
from ._site import Site

Box = tuple[int, int, int, int]
"""x, y, width, height in pixels, as OpenCV has windows."""

_WARM_UPS = 20  # times that the empty scene is shown: the mixture is then sure of it
_BORDER_PX = 2
_HEIGHTS_M = (1.0, 2.2)  # what a person seen whole is taken for
_HEIGHT_RATE = 0.2
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1.0)


@dataclasses.dataclass(frozen=True)
class BlobSettings:
    """What counts as a blob, and how it is followed. The paper names the parts and gives no values."""

    history: int = 200  # frames of the background model
    learning_rate: float = 0.002  # share of a frame that enters it
    match: float = 16.0  # squared distance, in variances, up to which a pixel is background
    shadow: float = 0.5  # darkest shadow, as a share of the background's brightness
    warm_up: Literal["empty", "online"] = "empty"  # the background model is shown the empty scene first, or nothing
    area_m2: tuple[float, float] = (0.08, 2.5)  # seen area, least and most, when a blob is born
    max_speed_m_s: float = 3.0
    min_travel_m: float = 0.3  # from where it was first seen, before a blob counts
    max_missed: int = 3  # frames without foreground before a blob is gone
    max_shared: int = 10  # frames for which two blobs may be one above the other in one piece of foreground
    num_bins: int = 32  # of the intensity histogram
    histogram_rate: float = 0.1
    position: Literal["centre", "foot", "depth"] = "foot"  # see `BlobTracker.place`
    person_height_m: float = 1.7

    def __post_init__(self) -> None:
        if not 0 < self.area_m2[0] < self.area_m2[1]:
            raise ValueError(f"area_m2 is {self.area_m2}; expected 0 < least < most.")
        for name in ("history", "match", "max_speed_m_s", "num_bins"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number.")


@dataclasses.dataclass(frozen=True)
class Blob:
    """One blob in one frame."""

    identity: int  # from 1, never given twice
    box: Box
    position_m: Float[np.ndarray, " 2"]  # room frame


@dataclasses.dataclass
class _Track:
    identity: int
    window: Box
    histogram: np.ndarray
    position_m: np.ndarray
    first_m: np.ndarray
    drift_px: np.ndarray
    height_m: float
    travelled: bool = False
    missed: int = 0
    shared: int = 0


def centre(box: Box) -> Float[np.ndarray, " 2"]:
    """Middle of a window, pixel centres at integers."""
    return np.array([box[0] + 0.5 * (box[2] - 1), box[1] + 0.5 * (box[3] - 1)])


def overlap(a: Box, b: Box) -> int:
    """Pixels that two windows share."""
    wide = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
    tall = min(a[1] + a[3], b[1] + b[3]) - max(a[1], b[1])
    return max(wide, 0) * max(tall, 0)


def _join(boxes: list[Box], areas: list[int], labels: np.ndarray) -> tuple[list[Box], list[int], np.ndarray]:
    """Parts of one body are one: those above each other with a small gap. `labels` counts components from 1."""
    parent = list(range(len(boxes)))

    def root(i: int) -> int:
        while parent[i] != i:
            i = parent[i]
        return i

    for i, a in enumerate(boxes):
        for j in range(i):
            b = boxes[j]
            shared = min(a[0] + a[2], b[0] + b[2]) - max(a[0], b[0])
            gap = max(a[1], b[1]) - min(a[1] + a[3], b[1] + b[3])
            if shared >= 0.5 * min(a[2], b[2]) and gap <= 0.15 * max(a[3], b[3]):
                parent[root(i)] = root(j)
    groups = sorted({root(i) for i in range(len(boxes))})
    lookup = np.zeros(len(boxes) + 1, np.int32)
    joined, sizes = [], []
    for number, group in enumerate(groups, start=1):
        members = [i for i in range(len(boxes)) if root(i) == group]
        lookup[np.array(members) + 1] = number
        x0, y0 = min(boxes[i][0] for i in members), min(boxes[i][1] for i in members)
        x1, y1 = max(boxes[i][0] + boxes[i][2] for i in members), max(boxes[i][1] + boxes[i][3] for i in members)
        joined.append((x0, y0, x1 - x0, y1 - y0))
        sizes.append(sum(areas[i] for i in members))
    return joined, sizes, lookup[labels]


class BlobTracker:
    """Detects and follows blobs frame by frame; holds OpenCV's background model, so one serves one video."""

    def __init__(self, settings: BlobSettings, site: Site, intrinsics: Intrinsics):
        self.settings, self._site, self._intrinsics = settings, site, intrinsics
        self._model = cv2.createBackgroundSubtractorMOG2(settings.history, settings.match, True)
        self._model.setShadowThreshold(settings.shadow)
        self._rays = pixel_rays(intrinsics)
        self._tracks: list[_Track] = []
        self._last_s: float | None = None
        self._born = 0

    def warm_up(self, empty: UInt8[np.ndarray, "height width 3"]) -> None:
        """Show the background model the empty scene before the first frame."""
        for number in range(_WARM_UPS):
            self._model.apply(empty, learningRate=-1 if number else 1)

    def foreground(self, colour: UInt8[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
        """Pixels that are neither background nor its shadow; the background model learns from the frame."""
        mask = self._model.apply(colour, learningRate=self.settings.learning_rate)
        solid = cv2.morphologyEx((mask == 255).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return cv2.morphologyEx(solid, cv2.MORPH_CLOSE, np.ones((7, 3), np.uint8)) > 0

    def step(
        self, colour: UInt8[np.ndarray, "height width 3"], depth_m: Float[np.ndarray, "height width"], time_s: float
    ) -> tuple[list[Blob], Int[np.ndarray, "height width"]]:
        """The blobs of the next frame, and for each pixel the identity of its blob, 0 for none."""
        settings = self.settings
        elapsed = 0.0 if self._last_s is None else time_s - self._last_s
        self._last_s = time_s
        solid = self.foreground(colour)
        grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(solid.astype(np.uint8), connectivity=8)
        boxes: list[Box] = [tuple(int(v) for v in row[:4]) for row in stats[1:count]]  # type: ignore[misc]
        boxes, areas, labels = _join(boxes, [int(row[4]) for row in stats[1:count]], labels)
        owners: list[list[_Track]] = [[] for _ in boxes]
        for track in self._tracks:
            self._shift(track, grey, solid)
            shared = [overlap(track.window, box) for box in boxes]
            if shared and max(shared) > 0:
                owners[int(np.argmax(shared))].append(track)
                track.missed = 0
            else:
                track.missed += 1
        identity = np.zeros(solid.shape, np.int32)
        for number, (box, area, claims) in enumerate(zip(boxes, areas, owners, strict=True), start=1):
            part = (labels == number) & solid
            tracks = self._settle(claims)
            if not tracks:
                self._begin(box, area, part, grey, depth_m)
                continue
            if len(tracks) == 1:
                self._refresh(tracks[0], box, part, grey)
                identity[part] = tracks[0].identity
            else:
                rows, columns = np.nonzero(part)
                apart = [np.hypot(*(np.stack([columns, rows]) - centre(t.window)[:, None])) for t in tracks]
                names = np.array([t.identity for t in tracks])
                identity[rows, columns] = names[np.argmin(apart, axis=0)]
            for track in tracks:
                self._move(track, identity == track.identity, depth_m, elapsed)
        self._tracks = [track for track in self._tracks if track.missed <= settings.max_missed]
        counted = [track for track in self._tracks if track.travelled]
        identity[~np.isin(identity, [track.identity for track in counted])] = 0
        return [Blob(track.identity, track.window, track.position_m.copy()) for track in counted], identity

    def _settle(self, claims: list[_Track]) -> list[_Track]:
        """Whose foreground it is: pieces of one body that became blobs before they grew together are one blob.

        Of two in one column of the picture the one that has travelled stays, or the larger; if both have, they are people
        who pass each other, unless it lasts.
        """
        kept: list[_Track] = []
        for track in sorted(
            claims, key=lambda t: (not t.travelled, t.identity if t.travelled else -t.window[2] * t.window[3])
        ):
            column = [
                min(track.window[0] + track.window[2], other.window[0] + other.window[2])
                - max(track.window[0], other.window[0])
                >= 0.5 * min(track.window[2], other.window[2])
                for other in kept
            ]
            track.shared = track.shared + 1 if any(column) else 0
            if any(column) and (not track.travelled or track.shared > self.settings.max_shared):
                self._tracks.remove(track)
            else:
                kept.append(track)
        return kept

    def _shift(self, track: _Track, grey: np.ndarray, solid: np.ndarray) -> None:
        """Mean shift (Comaniciu et al., 2000) from where the blob's drift puts it, on likely foreground."""
        height, width = grey.shape
        x, y, wide, tall = track.window
        x, y = np.rint(np.array([x, y]) + track.drift_px).astype(int)
        x, y = int(np.clip(x, 1 - wide, width - 1)), int(np.clip(y, 1 - tall, height - 1))
        likely = cv2.calcBackProject([grey], [0], track.histogram, [0, 256], 1.0)
        likely[~solid] = 0
        # The window may hang over the edge: mean shift wants it inside.
        left, top = max(x, 0), max(y, 0)
        inside = (left, top, min(x + wide, width) - left, min(y + tall, height) - top)
        _, found = cv2.meanShift(likely, inside, _STOP)
        before = centre(track.window)
        track.window = tuple(int(v) for v in found)  # type: ignore[assignment]
        track.drift_px = 0.5 * track.drift_px + 0.5 * (centre(track.window) - before)

    def _histogram(self, grey: np.ndarray, part: np.ndarray) -> np.ndarray:
        bins = self.settings.num_bins
        histogram = cv2.calcHist([grey], [0], part.astype(np.uint8), [bins], [0, 256])
        return histogram * (255.0 / max(float(histogram.max()), 1.0))

    def _refresh(self, track: _Track, box: Box, part: np.ndarray, grey: np.ndarray) -> None:
        before, rate = centre(track.window), self.settings.histogram_rate
        track.drift_px = track.drift_px + 0.5 * (centre(box) - before)
        track.window = box
        track.histogram = ((1 - rate) * track.histogram + rate * self._histogram(grey, part)).astype(np.float32)

    def _begin(self, box: Box, area: int, part: np.ndarray, grey: np.ndarray, depth_m: np.ndarray) -> None:
        """A new blob, if its size fits and no other blob is there already."""
        if any(overlap(track.window, box) > 0.5 * box[2] * box[3] for track in self._tracks):
            return
        place = self.place(box, part, depth_m)
        if place is None:
            return
        camera = -self._site.axes @ self._site.origin_m
        far = float(np.linalg.norm(np.append(place, 0.5 * self.settings.person_height_m) - camera))
        seen_m2 = area * far**2 / (self._intrinsics.fx_px * self._intrinsics.fy_px)
        if not self.settings.area_m2[0] <= seen_m2 <= self.settings.area_m2[1]:
            return
        self._born += 1
        tall = self.settings.person_height_m
        self._tracks.append(_Track(self._born, box, self._histogram(grey, part), place, place, np.zeros(2), tall))

    def _move(self, track: _Track, part: np.ndarray, depth_m: np.ndarray, elapsed_s: float) -> None:
        """Follow the measured place, no faster than the speed limit."""
        place = self.place(track.window, part, depth_m, track.height_m)
        if place is None:
            return
        if (
            self.settings.position == "foot"
            and track.window[1] > _BORDER_PX
            and not self._cut(track.window, part.shape)
        ):
            seen = float(np.clip(self._height(track.window, place), *_HEIGHTS_M))
            track.height_m += _HEIGHT_RATE * (seen - track.height_m)
        step = place - track.position_m
        length = float(np.linalg.norm(step))
        allowed = self.settings.max_speed_m_s * elapsed_s
        track.position_m = track.position_m + step * min(1.0, allowed / max(length, 1e-9))
        far = float(np.linalg.norm(track.position_m - track.first_m))
        track.travelled = track.travelled or far >= self.settings.min_travel_m

    def place(
        self,
        box: Box,
        part: Bool[np.ndarray, "height width"],
        depth_m: Float[np.ndarray, "height width"],
        tall_m: float | None = None,
    ) -> Float[np.ndarray, " 2"] | None:
        """Where a blob stands on the floor, room frame, or None where that cannot be said.

        "centre", for a camera that looks down, as the paper's: the ray through the box's middle meets the plane half a
        person high. "foot", for one that looks along the room: the ray through the lowest pixels meets the floor; where
        the picture cuts the feet off, the ray through the highest meets the height of the head, `tall_m`, which was seen
        while the feet were. "depth": the median of the depth camera's points, which the paper does not have.
        """
        if self.settings.position == "depth":
            points = (self._rays * depth_m[..., None])[part & (depth_m > 0)]
            return np.median(self._site.to_room(points.astype(np.float64))[:, :2], axis=0) if len(points) else None
        tall = self.settings.person_height_m if tall_m is None else tall_m
        if self.settings.position == "centre":
            row, height = centre(box)[1], 0.5 * tall
        elif self._cut(box, part.shape):
            row, height = box[1], tall
        else:
            row, height = box[1] + box[3] - 1, 0.0
        pixel = np.array([[centre(box)[0], float(row)]])
        place = self._site.pixel_on_plane(pixel, self._intrinsics, height)[0]
        return place if np.all(np.isfinite(place)) else None

    def _cut(self, box: Box, shape: tuple[int, ...]) -> bool:
        """Whether the picture's lower edge cuts a box off."""
        return box[1] + box[3] >= shape[0] - _BORDER_PX

    def _height(self, box: Box, place: np.ndarray) -> float:
        """How high over a place on the floor the ray through a box's upper edge passes."""
        pixel = np.array([[centre(box)[0], float(box[1])]])
        ground, one = (self._site.pixel_on_plane(pixel, self._intrinsics, height)[0] for height in (0.0, 1.0))
        # A ray that never meets the floor says nothing here.
        if not np.isfinite([ground, one]).all():
            return self.settings.person_height_m
        return float(np.linalg.norm(ground - place) / max(float(np.linalg.norm(ground - one)), 1e-6))


@dataclasses.dataclass(frozen=True)
class BlobTracks:
    """The blobs of a whole video in a fixed number of slots, as the filter wants them."""

    identity: Int[np.ndarray, "time slot"]  # 0 = empty slot
    position_m: Float[np.ndarray, "time slot 2"]  # room frame; 0 where empty
    box_px: Float[np.ndarray, "time slot 4"]  # x0 y0 x1 y1, both ends within; NaN where empty
    num_dropped: int  # times that a blob found no free slot in a frame
    labels: Integer[np.ndarray, "time height width"] | None = None  # identity of each pixel's blob, 0 = none


def in_slots(
    frames: Sequence[Sequence[Blob]],
    num_slots: int,
    *,
    labels: Integer[np.ndarray, "time height width"] | None = None,
    before: tuple[int, ...] | None = None,
) -> BlobTracks:
    """Give every blob the first free slot for as long as it lives; those that find none are left out and counted.

    `before` names who was in the slots before the first frame.
    """
    if num_slots < 1:
        raise ValueError(f"num_slots is {num_slots}; expected at least 1.")
    shape = (len(frames), num_slots)
    identity, position = np.zeros(shape, np.int32), np.zeros((*shape, 2), np.float32)
    box = np.full((*shape, 4), np.nan, np.float32)
    held = [0] * num_slots if before is None else list(before)
    dropped = 0
    for time, blobs in enumerate(frames):
        alive = {blob.identity for blob in blobs}
        held = [name if name in alive else 0 for name in held]
        for blob in blobs:
            if blob.identity not in held:
                if 0 not in held:
                    dropped += 1
                    continue
                held[held.index(0)] = blob.identity
            slot = held.index(blob.identity)
            identity[time, slot], position[time, slot] = blob.identity, blob.position_m
            x, y, wide, tall = blob.box
            box[time, slot] = (x, y, x + wide - 1, y + tall - 1)
    return BlobTracks(identity, position, box, dropped, labels)
