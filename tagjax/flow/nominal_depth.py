"""Recordings without depth: what moves is put on one plane, the background on another.

A tracer on segments uses depth for two things: how far a tag moves, and which pixels belong together. Where nothing measures
depth the second is still needed, and the two planes stand for it. Their depths are nominal: they say what is in front of what,
and not where it is. Imports cv2; runs on the host, in order of time.
"""

from __future__ import annotations

import dataclasses

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8, UInt16

from ..core.camera import working_stride
from ..core.parameters import check_positive
from ..recording import Recording
from ..recording.computed_frames import ComputedFrames
from .opencv import DISFlow

_KEPT = 64  # frames that are kept, for clips that overlap
_KERNEL = np.ones((3, 3), np.uint8)


@dataclasses.dataclass(frozen=True)
class NominalDepth:
    """Settings of the two planes. Times are in seconds, lengths of motion in pixels of pictures some 256 pixels wide.

    A pixel is in front where it moves, and for `pause_s` after it did; not where it has the colour of the background, or of a
    shadow or light on it (Horprasert et al., A statistical approach for real-time robust background subtraction, 1999).
    """

    near_m: float = 2.5  # plane of what moves
    far_m: float = 5.0  # plane of the background
    moving_px_s: float = 8.0  # apparent speed above which a pixel moves
    pause_s: float = 0.7
    rest_s: float = 0.2  # a pixel that has been at rest for so long shows the background
    sure_s: float = 0.3  # a surface that was in front for so long stays there while it moves, whatever its colour
    learn_s: float = 0.3  # within which the background takes its colour
    levels: float = 12.0  # differences of colour up to this are noise
    shadow: float = 0.55  # brightness of a shadow, of the background's
    lighter: float = 1.25

    def __post_init__(self) -> None:
        check_positive(**vars(self))
        if not self.near_m < self.far_m:
            raise ValueError(f"near_m is {self.near_m}, far_m {self.far_m}; expected near_m below far_m.")
        if not self.shadow < 1.0 < self.lighter:
            raise ValueError(f"shadow is {self.shadow}, lighter {self.lighter}; expected shadow < 1 < lighter.")


def without_depth(recording: Recording, settings: NominalDepth | None = None) -> Recording:
    """The recording with the two planes in place of its depth, computed when it is read, from the colours up to each frame.

    Positions in it (of antennas, of the truth) stay what they are. A recording without any depth may be given.
    """
    settings = settings or NominalDepth()
    planes = _Planes(recording, settings)
    depth = ComputedFrames((recording.num_frames, *recording.image_shape), np.uint16, planes.depth_mm)
    return dataclasses.replace(recording, depth=depth, depth_kind="depth", store=None)


@dataclasses.dataclass(frozen=True)
class Front:
    """What is in front at a frame, and what is remembered for the next."""

    colour: Float[np.ndarray, "height width 3"]
    near: Bool[np.ndarray, "height width"]
    paused_s: Float[np.ndarray, "height width"]  # time since the surface at the pixel moved
    front_s: Float[np.ndarray, "height width"]  # time for which that surface was in front by its colour
    background: Float[np.ndarray, "height width 3"]
    rest_s: Float[np.ndarray, "height width"]  # time since anything moved at the pixel

    @staticmethod
    def first(colour: UInt8[np.ndarray, "height width 3"]) -> Front:
        """Of the first frame: all of it is background."""
        own, none = colour.astype(np.float32), np.zeros(colour.shape[:2], np.float32)
        return Front(own, none > 0, none, none, own, none)


def next_front(
    last: Front,
    colour: UInt8[np.ndarray, "height width 3"],
    backward_px: Float[np.ndarray, "height width 2"],
    dt_s: float,
    settings: NominalDepth,
) -> Front:
    """What is in front at the frame `dt_s` after the last; the flow points from its pixels to those of the last one."""
    own = colour.astype(np.float32)
    height, width = own.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    source = x + backward_px[..., 0], y + backward_px[..., 1]
    moving = np.hypot(backward_px[..., 0], backward_px[..., 1]) > settings.moving_px_s * dt_s

    def carried(values: np.ndarray, how: int) -> np.ndarray:
        return cv2.remap(values, *source, how, borderMode=cv2.BORDER_CONSTANT, borderValue=(0.0, 0.0, 0.0, 0.0))

    # Where the surface at the flow's end has another colour, it is another one.
    same = np.abs(own - carried(last.colour, cv2.INTER_LINEAR)).max(axis=-1) < 3.0 * settings.levels
    was_near = carried(last.near.astype(np.uint8), cv2.INTER_NEAREST) > 0
    paused_s = np.where(moving, 0.0, np.where(was_near, carried(last.paused_s, cv2.INTER_NEAREST) + dt_s, np.inf))
    front_s = np.where(was_near, carried(last.front_s, cv2.INTER_NEAREST), 0.0)
    other = differs(own, last.background, settings)
    sure = (front_s > settings.sure_s) & (paused_s < settings.rest_s)
    candidate = same & (paused_s < settings.pause_s) & (other | sure)
    near = cv2.morphologyEx(candidate.astype(np.uint8), cv2.MORPH_CLOSE, _KERNEL)
    near = cv2.morphologyEx(near, cv2.MORPH_OPEN, _KERNEL) > 0
    rest_s = np.where(moving | near, 0.0, last.rest_s + dt_s)
    part = np.where(rest_s > settings.rest_s, min(dt_s / settings.learn_s, 1.0), 0.0)[..., None]
    background = last.background + part * (own - last.background)
    paused_s = np.where(near, np.minimum(paused_s, settings.pause_s), 0.0)
    front_s = np.where(near, front_s + np.where(other, dt_s, 0.0), 0.0).astype(np.float32)
    return Front(
        own, near, paused_s.astype(np.float32), front_s, background.astype(np.float32), rest_s.astype(np.float32)
    )


def differs(
    colour: Float[np.ndarray, "height width 3"],
    background: Float[np.ndarray, "height width 3"],
    settings: NominalDepth,
) -> Bool[np.ndarray, "height width"]:
    """Pixels that have neither the background's colour nor that of a shadow or light on it."""
    bright = np.sum(background * background, axis=-1)
    ratio = np.sum(colour * background, axis=-1) / np.maximum(bright, 1.0)
    apart = np.sqrt(np.sum(np.square(colour - ratio[..., None] * background), axis=-1))
    brighter = np.abs(ratio - 1.0) * np.sqrt(bright) > settings.levels * np.sqrt(3.0)
    return (apart > settings.levels) | (brighter & ((ratio < settings.shadow) | (ratio > settings.lighter)))


class _Planes:
    """The fronts of a recording, computed in order of time; an earlier frame than those kept begins anew."""

    def __init__(self, recording: Recording, settings: NominalDepth) -> None:
        self._recording, self._settings, self._flow = recording, settings, DISFlow()
        self._stride, self._time_s = working_stride(recording.intrinsics.width), recording.frame_time_s()
        self._last: tuple[int, Front, np.ndarray] | None = None
        self._near: dict[int, np.ndarray] = {}

    def depth_mm(self, frame: int) -> UInt16[np.ndarray, "height width"]:
        while frame not in self._near:
            self._advance(frame)
        height, width = self._recording.image_shape
        near = self._near[frame].repeat(self._stride, axis=0).repeat(self._stride, axis=1)[:height, :width]
        planes_mm = (np.uint16(1000 * one) for one in (self._settings.near_m, self._settings.far_m))
        return np.where(near, *planes_mm)

    def _advance(self, frame: int) -> None:
        """Compute the next frame, or the first one where `frame` is behind those that are kept."""
        number = 0 if self._last is None or frame <= self._last[0] else self._last[0] + 1
        full = np.asarray(self._recording.colour[number])
        height, width = (-(-size // self._stride) for size in full.shape[:2])
        small = full if self._stride == 1 else cv2.resize(full, (width, height), interpolation=cv2.INTER_AREA)
        if number == 0 or self._last is None:
            front = Front.first(small)
        else:
            backward = self._flow(small, self._last[2])
            dt_s = float(self._time_s[number] - self._time_s[number - 1])
            front = next_front(self._last[1], small, backward, dt_s, self._settings)
        self._last = number, front, small
        self._near[number] = front.near
        self._near.pop(number - _KEPT, None)
