"""Frames for the live page: three tags, one of them with an EPC that would be markup, in closed form."""

from __future__ import annotations

import numpy as np

from tagjax.live.events import Event, Sighting
from tagjax.live.view import Overlay, View, event_rows, tag_rows

HOSTILE = '<img src=x onerror="document.title=1">'
TAGS = {
    "E28011700000020A7B4C1D01": Sighting("detected", True, 0.93, (160.0, 120.0, 319.0, 399.0), (0.3, 0.2, 2.4)),
    HOSTILE: Sighting("detected", True, 0.61, (400.0, 100.0, 559.0, 299.0), (-0.5, 0.1, 3.1)),
    "E28011700000020A7B4C1D03": Sighting("not_read"),
    "E28011700000020A7B4C1D04": Sighting("stationary", False, 0.12),
}


def overlay(number: int = 1) -> Overlay:
    """480 x 640, working resolution a quarter of it; segment 1 is the first tag's box, 2 the second's."""
    colour = np.full((480, 640, 3), 40 + 10 * (number % 10), np.uint8)
    labels = np.zeros((120, 160), np.int32)
    labels[30:100, 40:80], labels[25:75, 100:140] = 1, 2
    membership = np.zeros((len(TAGS), 4), np.float32)
    membership[0, 1] = membership[1, 2] = membership[3, 1] = 1.0  # the last tag is not detected
    return Overlay(colour, labels, 4, membership, TAGS)


def view(number: int, *, num_tags: int = 4, notes: tuple[str, ...] = ()) -> View:
    """A frame of a stream with 30 frames a second."""
    tags = dict(list(TAGS.items())[:num_tags])
    first = next(iter(TAGS))
    events = [
        Event("alarm", first, 4_500_000_000, 4_200_000_000, "detected", 0.9, region="exit <b>"),
        Event("lost", HOSTILE, 3_100_000_000, 1_000_000_000, "occluded", 0.7),
        Event("detected", first, 500_000_000, 0, "detected", 0.8),
    ]
    state = {
        "number": number,
        "time_s": number / 30,
        "frames_per_s": 29.97,
        "latency_ms": 24.3 if number > 1 else float("nan"),
        "dropped_frames": 3,
        "reads_hz": 131.0,
        "tags": tag_rows(tags, {first: 45.2, HOSTILE: 61.0}),
        "events": event_rows(events, 0),
        "notes": list(notes),
    }
    return View(state, overlay(number), 640)
