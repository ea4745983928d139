"""What the web page shows of a frame: the overlay as a JPEG picture, and all figures as JSON."""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import threading
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from ..core.names import short_name
from ..core.results import to_json_values
from ..report.overlay import draw_overlay, scaled_boxes
from ..tracing.status import Status
from .events import Event, Sighting

REASONS = {
    Status.UNKNOWN.word: "not detected",
    Status.DETECTED.word: "detected",
    Status.NOT_READ.word: "not read: few reads of late, or none",
    Status.OCCLUDED.word: "occluded: its body is out of view",
    Status.STATIONARY.word: "stationary: the tag stays in place",
    Status.NOT_FOUND.word: "not found: the reads fit no body in view",
}
"""The status of a tag for people, with the reason."""

_JPEG_QUALITY = 75


@dataclasses.dataclass(frozen=True)
class Overlay:
    """A frame and its masks, of which a picture is made where a browser asks for one."""

    colour: UInt8[np.ndarray, "height width 3"]
    labels: Int[
        np.ndarray, "rows columns"
    ]  # segment of each pixel of the working resolution; -1 = none, 0 = background
    stride: int  # of the working resolution
    membership: Float[np.ndarray, "tag segment"]  # one row for each of `tags`, in their order
    tags: Mapping[str, Sighting]

    def jpeg(self, width: int) -> bytes:
        """The overlay, at most `width` pixels wide."""
        rows, columns = self.colour.shape[:2]
        scale = min(1.0, width / columns)
        size = (round(columns * scale), round(rows * scale))
        colour = self.colour if scale == 1 else cv2.resize(self.colour, size, interpolation=cv2.INTER_AREA)
        masks, boxes = np.zeros((len(self.tags), *colour.shape[:2]), bool), np.full((len(self.tags), 4), np.nan)
        for place, tag in enumerate(self.tags.values()):
            if tag.detected and tag.box_px is not None:
                masks[place] = self._mask(place, scale, size)
                boxes[place] = tag.box_px
        picture = draw_overlay(
            colour,
            [short_name(epc) for epc in self.tags],
            masks,
            scaled_boxes(boxes, scale),
            np.array([tag.confidence for tag in self.tags.values()], np.float64),
            np.array([tag.detected for tag in self.tags.values()], bool),
        )
        coded = cv2.imencode(
            ".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
        )[1]
        return coded.tobytes()

    def _mask(self, place: int, scale: float, size: tuple[int, int]) -> Bool[np.ndarray, "height width"]:
        """A tag's mask in the picture of this scale and (width, height)."""
        member = self.membership[place] > 0.5
        member[0] = False
        small = (member[np.maximum(self.labels, 0)] & (self.labels > 0)).astype(np.float32)
        # Working pixel i is pixel i * stride of the whole picture.
        shift = 0.5 * scale - 0.5
        matrix = np.array([[self.stride * scale, 0, shift], [0, self.stride * scale, shift]], np.float64)
        return cv2.warpAffine(small, matrix, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE) > 0.5


class View:
    """A frame for the page. `body` makes the picture, once, in the thread of the browser that asks first."""

    def __init__(self, state: Mapping[str, Any], overlay: Overlay, width: int):
        self.number = int(state["number"])
        self._state, self._overlay, self._width = state, overlay, width
        self._lock = threading.Lock()

    def body(self) -> bytes:
        """Four bytes with the length of the JSON, the JSON, and the JPEG picture."""
        with self._lock:
            return self._body

    @functools.cached_property
    def _body(self) -> bytes:
        text = json.dumps(to_json_values(self._state), allow_nan=False).encode()
        return len(text).to_bytes(4, "big") + text + self._overlay.jpeg(self._width)


def tag_rows(tags: Mapping[str, Sighting], rates_hz: Mapping[str, float]) -> list[dict[str, Any]]:
    """A row a tag, in the order of EPCs: colour, status with its reason, confidence, distance to the camera, reads per second."""
    rows = [
        {
            "epc": epc,
            "colour": number % 8,
            "status": tag.status,
            "text": REASONS.get(tag.status, tag.status),
            "detected": tag.detected,
            "confidence": tag.confidence,
            "distance_m": None if tag.centre_m is None else round(math.hypot(*tag.centre_m), 2),
            "reads_hz": round(rates_hz.get(epc, 0.0), 1),
        }
        for number, (epc, tag) in enumerate(tags.items())
    ]
    return sorted(rows, key=lambda row: row["epc"])


def event_rows(events: Sequence[Event], first_ns: int) -> list[dict[str, Any]]:
    """A row an event, for people."""
    texts = {"detected": "detected", "lost": "lost", "alarm": "alarm: in {}", "left": "left through {}"}
    return [
        {
            "at_s": round(1e-9 * (event.time_ns - first_ns), 1),
            "epc": event.epc,
            "kind": event.kind,
            "text": texts[event.kind].format(event.region)
            + (f" ({REASONS.get(event.status, event.status)})" if event.kind == "lost" else ""),
        }
        for event in events
    ]
