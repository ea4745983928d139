"""Overlay pictures: masks, boxes and confidences drawn over the colour picture."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int8, Shaped, UInt8

from ..core.names import short_name
from ..metrics.boxes import label_box
from ..metrics.recordings import Picture
from ..recording import Recording
from ..tracing.status import Status

PALETTE_RGB = (
    (230, 159, 0),
    (86, 180, 233),
    (213, 94, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (0, 114, 178),
    (153, 153, 153),
)
"""Colours of tags in their order: Okabe and Ito (2008), which people with any kind of colour vision distinguish, and grey."""

_SIZE = 0.45
"""Font scale, as OpenCV counts it."""

_LINE = 14
"""Line spacing of text, pixels."""

_LUMA = (0.299, 0.587, 0.114)
_BRIGHT = 110.0
"""Brightness of a colour, 0 to 255, and from where on letters on it are black."""

MIN_WIDTH = 480
"""Smaller pictures are enlarged by an integer factor, so that outlines and names stay readable."""


def draw_overlay(
    colour: UInt8[np.ndarray, "height width 3"],
    names: Sequence[str],
    masks: Bool[np.ndarray, "tag height width"],
    boxes_px: Float[np.ndarray, "tag 4"],
    confidence: Float[np.ndarray, " tag"],
    detected: Bool[np.ndarray, " tag"],
    *,
    status: Int8[np.ndarray, " tag"] | None = None,
    true_boxes_px: Shaped[np.ndarray, "tag 4"] | None = None,
    caption: str = "",
) -> UInt8[np.ndarray, "picture_height picture_width 3"]:
    """RGB picture with the tint, outline, box, name and confidence of each detected object; true boxes thin and white.

    Tags that are not detected, and of which `status` gives the reason, are listed from the upper left corner down.
    """
    scale = -(-MIN_WIDTH // colour.shape[1])
    picture = _enlarged(colour, scale)
    boxes_px = scaled_boxes(boxes_px, float(scale))
    true_boxes_px = None if true_boxes_px is None else scaled_boxes(true_boxes_px, float(scale))
    labels: list[tuple[str, tuple[int, int, int, int], tuple[int, int, int]]] = []
    for tag, name in enumerate(names):
        shade = PALETTE_RGB[tag % len(PALETTE_RGB)]
        if true_boxes_px is not None and np.all(np.isfinite(true_boxes_px[tag])):
            x0, y0, x1, y1 = np.round(true_boxes_px[tag]).astype(int).tolist()
            cv2.rectangle(picture, (x0, y0), (x1, y1), (255, 255, 255), 1)
        if not detected[tag] or not np.all(np.isfinite(boxes_px[tag])):
            continue
        _tint(picture, _enlarged(masks[tag].astype(np.uint8), scale), shade)
        x0, y0, x1, y1 = np.round(boxes_px[tag]).astype(int).tolist()
        cv2.rectangle(picture, (x0, y0), (x1, y1), shade, 2)
        labels.append((f"{name} {confidence[tag]:.2f}", (x0, y0, x1, y1), shade))
    taken: list[tuple[int, int, int, int]] = []
    if caption:
        place = 6, picture.shape[0] - 8
        _text(picture, caption, place, (0, 0, 0))
        taken.append(_extent(caption, place))
    lines = range(_LINE, picture.shape[0] - 2 * _LINE, _LINE)  # as many as there is room for above the caption
    for y, (tag, text) in zip(lines, _missing(names, status), strict=False):
        _text(picture, text, (6, y), PALETTE_RGB[tag % len(PALETTE_RGB)])
        taken.append(_extent(text, (6, y)))
    for text, box, shade in labels:
        place = _free_place(text, box, taken, picture.shape[:2])
        _text(picture, text, place, shade)
        taken.append(_extent(text, place))
    return picture


def scaled_boxes(boxes_px: Shaped[np.ndarray, "tag 4"], scale: float) -> Float[np.ndarray, "tag 4"]:
    """Boxes (inclusive edges, pixel centres at integers) in a picture that is resized to `scale` times its size."""
    edges = np.array([-0.5, -0.5, 0.5, 0.5])
    return (boxes_px + edges + 0.5) * scale - 0.5 - edges


def _enlarged(picture: np.ndarray, scale: int) -> np.ndarray:
    """A copy in which each pixel is `scale` x `scale` large."""
    return np.ascontiguousarray(picture.repeat(scale, axis=0).repeat(scale, axis=1)) if scale > 1 else picture.copy()


def _tint(picture: np.ndarray, mask: UInt8[np.ndarray, "height width"], shade: tuple[int, int, int]) -> None:
    """Tint the mask and draw its outline, within the rectangle that it fills."""
    left, top, width, height = cv2.boundingRect(mask)
    part, own = picture[top : top + height, left : left + width], mask[top : top + height, left : left + width]
    if part.size:
        levels = 0.65 * np.arange(256, dtype=np.float32)[:, None] + 0.35 * np.array(shade, np.float32)
        np.copyto(part, cv2.LUT(part, levels.astype(np.uint8)[None]), where=own[..., None] > 0)
        outline, _ = cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(left, top))
        cv2.drawContours(picture, outline, -1, shade, 1)


def picture_overlay(recording: Recording, picture: Picture) -> UInt8[np.ndarray, "picture_height picture_width 3"]:
    """The overlay of a tracer's output at one frame of a recording, with the true boxes where they are known."""
    return draw_overlay(
        np.asarray(recording.colour[picture.frame]),
        [short_name(epc) for epc in picture.epcs],
        picture.masks,
        picture.boxes_px,
        picture.confidence,
        picture.detected,
        status=picture.status,
        true_boxes_px=true_boxes(recording, picture.frame, picture.epcs),
        caption=f"frame {picture.frame}",
    )


def true_boxes(recording: Recording, frame: int, epcs: Sequence[str]) -> Float[np.ndarray, "tag 4"]:
    """The true boxes of tags' objects at one frame; NaN where they are not known, or nothing is visible."""
    truth = recording.truth
    boxes = np.full((len(epcs), 4), np.nan)
    if truth is not None and truth.labels is not None:
        labels = np.asarray(truth.labels[frame])
        for tag, epc in enumerate(epcs):
            if epc in truth.tag_to_label:
                boxes[tag] = label_box(labels, truth.tag_to_label[epc])
    return boxes


def _missing(names: Sequence[str], status: Int8[np.ndarray, " tag"] | None) -> list[tuple[int, str]]:
    """The tags that are not detected, with the line that says why."""
    known = [] if status is None else [Status(code) for code in status.tolist()]
    shown = set(Status) - {Status.DETECTED, Status.UNKNOWN}
    return [(tag, f"{names[tag]}: {one.text}") for tag, one in enumerate(known) if one in shown]


def _extent(text: str, place: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, right and bottom of a text whose baseline begins at `place`."""
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, _SIZE, 1)
    return place[0], place[1] - _LINE + 3, place[0] + width, place[1] + 3


def _free_place(
    text: str, box: tuple[int, int, int, int], taken: Sequence[tuple[int, int, int, int]], shape: tuple[int, ...]
) -> tuple[int, int]:
    """A place for a box's label that covers no other label: the nearest line above the box, else below, else inside."""
    x0, y0, _, y1 = box
    left, _, right, _ = _extent(text, (0, 0))
    x = max(min(x0, shape[1] - (right - left) - 2), 2)
    above = range(max(y0 - 5, 12), 11, -_LINE)
    below = range(min(y1 + _LINE, shape[0] - 4), shape[0] - 3, _LINE)
    inside = range(above[-1] + _LINE, shape[0] - 3, _LINE)
    for y in (*above, *below, *inside):
        x_left, top, x_right, bottom = _extent(text, (x, y))
        if all(x_right <= a or x_left >= c or bottom <= b or top >= d for a, b, c, d in taken):
            return x, y
    return x, above[0]


def _text(picture: np.ndarray, text: str, place: tuple[int, int], shade: tuple[int, int, int]) -> None:
    """Black or white letters on a patch of the colour: video codecs blur colours, but not brightness."""
    left, top, right, bottom = _extent(text, place)
    cv2.rectangle(picture, (left - 2, top), (right, bottom), shade, cv2.FILLED)
    letters = (0, 0, 0) if float(np.dot(shade, _LUMA)) > _BRIGHT else (255, 255, 255)
    cv2.putText(picture, text, place, cv2.FONT_HERSHEY_SIMPLEX, _SIZE, letters, 1, cv2.LINE_AA)
