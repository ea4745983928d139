"""Detection of moving blobs by optical flow (TagVision, III.A): dense or Lucas-Kanade, with limits on size and
speed.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from ..opencv import place_in_picture
from .plane import PlaneCamera

FlowName = Literal["farneback", "dis", "lucas_kanade"]

FLOWS: tuple[str, ...] = ("farneback", "dis", "lucas_kanade")

_CORNER_RADIUS_PX = 5  # pixels around a Lucas-Kanade corner that take its flow
_CORNERS = {"maxCorners": 800, "qualityLevel": 0.01, "minDistance": 4}
_RING_PX = 9  # width of the ring around a region that shows its ground
_BRIDGE_PX = 1
_CHANGE_REACH_PX = 25  # the inside of a uniform object does not change: flow this near to a change is accepted
_SHADOW = (0.5, 1.1)  # range of a shadow's brightness relative to the ground's (1.1: the ground itself, with noise)
_MAX_HUE_CHANGE = 0.06  # largest difference of a colour channel's ratio to the ground from the mean ratio


@dataclasses.dataclass(frozen=True)
class BlobSettings:
    """Limits of a moving blob. Sizes and speeds are on the plane in which objects move."""

    flow: FlowName = "farneback"
    flow_interval_s: float = 0.0625  # between the two pictures of the flow; the paper records 16 frames/s
    min_flow_px: float = 1.0  # over the interval; less is noise
    min_change: float = 12.0  # grey levels; flow is unreliable where the picture does not change
    min_speed_m_s: float = 0.05
    max_speed_m_s: float = 3.0
    min_area_m2: float = 0.004
    max_area_m2: float = 0.12
    remove_shadows: bool = True  # remove regions that only darken the ground; the paper does not say

    def __post_init__(self):
        if self.flow not in FLOWS:
            raise ValueError(f"flow is {self.flow!r}; expected one of {', '.join(FLOWS)}.")
        if not self.flow_interval_s > 0 or self.min_flow_px <= 0:
            raise ValueError(
                f"flow_interval_s {self.flow_interval_s}, min_flow_px {self.min_flow_px}; expected positive numbers."
            )
        for name, low, high in (
            ("speed_m_s", self.min_speed_m_s, self.max_speed_m_s),
            ("area_m2", self.min_area_m2, self.max_area_m2),
        ):
            if not 0 <= low < high:
                raise ValueError(f"min_{name} {low}, max_{name} {high}; expected 0 <= min < max.")


@dataclasses.dataclass(frozen=True)
class Blob:
    """A moving region of one picture."""

    mask: Bool[np.ndarray, "rows columns"]  # within its window
    left: int  # of the window
    top: int
    centre_px: Float[np.ndarray, " 2"]  # x y
    flow_px: Float[np.ndarray, " 2"]  # median displacement over the interval

    @property
    def area_px(self) -> int:
        return int(np.sum(self.mask))

    def full_mask(self, shape: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        """The mask in the whole picture."""
        return place_in_picture(self.mask, self.left, self.top, shape)


def backward_flow(
    now: UInt8[np.ndarray, "height width"], before: UInt8[np.ndarray, "height width"], flow: FlowName = "farneback"
) -> Float[np.ndarray, "height width 2"]:
    """The displacement of each pixel of `now` since `before` (I(x, t) = I(x + a, t + dt), Eq. 1): forward in time,
    pixels.

    "farneback" and "dis" are dense; "lucas_kanade" tracks corners, whose flow the pixels around them take (0
    elsewhere).
    """
    if flow == "lucas_kanade":
        return _corner_flow(now, before)
    if flow == "dis":
        found = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(now, before, None)  # type: ignore[call-overload]
        return -np.asarray(found, np.float32)
    # Polynomial expansion at half the size is four times as fast; outlines come from the colours anyway.
    height, width = now.shape
    half = [
        cv2.resize(one, ((width + 1) // 2, (height + 1) // 2), interpolation=cv2.INTER_AREA) for one in (now, before)
    ]
    found = cv2.calcOpticalFlowFarneback(*half, None, 0.5, 3, 9, 3, 5, 1.1, 0)  # type: ignore[call-overload]
    return -2.0 * cv2.resize(found, (width, height), interpolation=cv2.INTER_LINEAR)


def _corner_flow(now: np.ndarray, before: np.ndarray) -> np.ndarray:
    out = np.zeros((*now.shape, 2), np.float32)
    corners = cv2.goodFeaturesToTrack(now, **_CORNERS)
    if corners is None:
        return out
    settings = {"winSize": (11, 11), "maxLevel": 3}
    back, found, _ = cv2.calcOpticalFlowPyrLK(now, before, corners, None, **settings)  # type: ignore[call-overload]
    forth, refound, _ = cv2.calcOpticalFlowPyrLK(before, now, back, None, **settings)  # type: ignore[call-overload]
    # A corner that is not tracked back to itself was lost.
    sure = (found.ravel() > 0) & (refound.ravel() > 0) & (np.linalg.norm(forth - corners, axis=-1).ravel() < 0.7)
    step = (corners - back).reshape(-1, 2)
    order = np.argsort(np.linalg.norm(step, axis=1))  # moving corners are drawn over stationary ones
    for x, y, dx, dy in np.concatenate([corners.reshape(-1, 2), step], axis=1)[order][sure[order]]:
        cv2.circle(out, (round(float(x)), round(float(y))), _CORNER_RADIUS_PX, (float(dx), float(dy)), -1)
    return out


def find_blobs(
    colour: UInt8[np.ndarray, "height width 3"],
    flow_px: Float[np.ndarray, "height width 2"],
    change: UInt8[np.ndarray, "height width"],
    elapsed_s: float,
    camera: PlaneCamera,
    height_m: float,
    settings: BlobSettings,
) -> list[Blob]:
    """Connected regions that move, within the limits on size and speed, largest first.

    `change` is the absolute difference of the two grey pictures: regions without change are ignored.
    """
    changed = cv2.blur(change, (3, 3)) > settings.min_change
    near = cv2.dilate(changed.astype(np.uint8), np.ones((_CHANGE_REACH_PX, _CHANGE_REACH_PX), np.uint8)).astype(bool)
    moving = near & (np.linalg.norm(flow_px, axis=-1) > settings.min_flow_px)
    opened = cv2.morphologyEx(moving.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(opened)
    found = []
    for number in range(1, count):
        x, y, width, height, _ = (int(v) for v in stats[number])
        window = _window(x, y, width, height, colour.shape[:2], _RING_PX + 1)
        region = labels[window] == number
        for mask in foreground_pieces(colour[window], region) if settings.remove_shadows else [region]:
            rows, columns = np.nonzero(mask)
            left, top = window[1].start, window[0].start
            centre = np.array([left + columns.mean(), top + rows.mean()])
            scale_m = float(camera.metres_per_pixel(centre[None], height_m)[0])
            # Comparisons with NaN are false, which excludes regions beyond the horizon.
            if not settings.min_area_m2 <= len(rows) * scale_m**2 <= settings.max_area_m2:
                continue
            step_px = np.median(flow_px[window][mask], axis=0).astype(np.float64)
            speed_m_s = float(np.linalg.norm(step_px)) * scale_m / elapsed_s
            if settings.min_speed_m_s <= speed_m_s <= settings.max_speed_m_s:
                found.append(Blob(mask, left, top, centre, step_px))
    return sorted(found, key=lambda blob: -blob.area_px)


def foreground_pieces(
    colour: UInt8[np.ndarray, "rows columns 3"], mask: Bool[np.ndarray, "rows columns"]
) -> list[Bool[np.ndarray, "rows columns"]]:
    """The pieces of a mask that do not look like the ground around it, lit or in shadow, with holes filled.

    Flow extends beyond outlines and joins objects that pass each other, and shadows move too. The unchanged mask where
    less than a tenth of it would remain.
    """
    ring = cv2.dilate(mask.astype(np.uint8), _disc(_RING_PX)).astype(bool) & ~mask
    if np.sum(ring) < 10:
        return [mask]
    kept = mask & ~np.any([_like_ground(colour, ground) for ground in _grounds(colour[ring])], axis=0)
    clean = cv2.morphologyEx(kept.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
    if np.sum(clean) < 0.1 * np.sum(mask):
        return [mask]
    # Gaps by a pattern in the ground's colour are bridged.
    count, labels = cv2.connectedComponents(cv2.morphologyEx(clean, cv2.MORPH_CLOSE, _disc(_BRIDGE_PX)))
    pieces = [(labels == number) & (clean > 0) for number in range(1, count)]
    # At the picture's edge closing may create an empty piece.
    return [fill_holes(piece) for piece in pieces if piece.any()]


def _disc(radius_px: int) -> np.ndarray:
    size = 2 * radius_px + 1
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))


def fill_holes(mask: Bool[np.ndarray, "rows columns"]) -> Bool[np.ndarray, "rows columns"]:
    """The mask with its holes closed: patterns in the ground's colour belong to the object."""
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    canvas = np.zeros(mask.shape, np.uint8)
    cv2.drawContours(canvas, outlines, -1, 1, -1)
    return canvas.astype(bool)


def _grounds(pixels: np.ndarray) -> list[np.ndarray]:
    """Median colours of the dark, middle and bright third of the ground, for a ground with a pattern."""
    order = np.argsort(pixels.sum(axis=-1), kind="stable")
    return [np.maximum(np.median(pixels[part], axis=0), 1.0) for part in np.array_split(order, 3)]


def _like_ground(colour: np.ndarray, ground: Shaped[np.ndarray, " 3"]) -> np.ndarray:
    ratio = colour.astype(np.float32) / ground.astype(np.float32)
    brightness = ratio.mean(axis=-1)
    hue_change = np.abs(ratio - brightness[..., None]).max(axis=-1)
    in_range = (brightness > _SHADOW[0]) & (brightness < _SHADOW[1])
    return in_range & (hue_change < _MAX_HUE_CHANGE * np.maximum(brightness, 0.5))


def _window(x: int, y: int, width: int, height: int, shape: tuple[int, ...], margin: int) -> tuple[slice, slice]:
    return (
        slice(max(0, y - margin), min(shape[0], y + height + margin)),
        slice(max(0, x - margin), min(shape[1], x + width + margin)),
    )
