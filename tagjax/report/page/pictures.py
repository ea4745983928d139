"""Pictures and videos within a page, as data."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ...core.progress import OnProgress, unobserved
from ..video import smaller_video
from .contents import Contents
from .html import Html, data_uri, element

VIDEO_BYTES = 3_000_000
"""Of all videos within a page, which base64 makes a third larger; a page has 6 MB at most."""

_SMALLEST = 400_000
"""A video gets at least as much, or is linked."""


def jpeg(image: UInt8[np.ndarray, "height width 3"], max_width: int) -> bytes:
    """An RGB picture as JPEG, made smaller where it is wider."""
    height, width = image.shape[:2]
    if width > max_width:
        size = (max_width, max(1, round(height * max_width / width)))
        image = cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA).astype(np.uint8)
    encoded, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, 78])
    assert encoded
    return data.tobytes()


@dataclasses.dataclass(frozen=True)
class PageVideo:
    """A video of the page: its content, or where it lies beside the page."""

    path: Path
    content: bytes | None

    def element(self, page: Path, num_frames: int) -> Html:
        """The player. A video that is not within the page is read from its file."""
        if self.content is not None:
            return _player(data_uri("video/webm", self.content), num_frames)
        beside = Path(os.path.relpath(self.path, page.parent)).as_posix()
        note = f"This video is not within the page, which would be too large: it is read from {beside} beside it."
        return element("div", _player(beside, num_frames), element("p", note, class_="note"))


def _player(source: str, num_frames: int) -> Html:
    return element(
        "video", src=source, data_frames=num_frames, controls=True, muted=True, playsinline=True, preload="auto"
    )


def page_videos(
    contents: Contents, recordings: Sequence[str], on_progress: OnProgress = unobserved
) -> dict[tuple[str, str], PageVideo]:
    """The videos by recording and tracer: within the page as many as it may hold, the first tracer's worst recordings first.

    The first one is made smaller where it is too large.
    """
    chosen: dict[tuple[str, str], PageVideo] = {}
    left = VIDEO_BYTES
    wanted = [(recording, tracer) for tracer in contents.tracers for recording in recordings]
    for number, (recording, tracer) in enumerate(wanted):
        on_progress("videos of the page", number, len(wanted), f"{tracer}: {recording}")
        path = contents.video(recording, tracer)
        if path is None:
            continue
        size = path.stat().st_size
        content = None
        if size <= left:
            content = path.read_bytes()
        elif not chosen or left >= _SMALLEST:
            content = smaller_video(path, left)
        left -= 0 if content is None else len(content)
        chosen[recording, tracer] = PageVideo(path, content)
    on_progress("videos of the page", len(wanted), len(wanted))
    return chosen
