"""Overlay videos as WebM, which browsers play: written frame by frame, read back, and made smaller."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from ..core.files import atomic_path
from ..metrics.recordings import Picture
from ..recording import Recording
from .overlay import picture_overlay

VIDEO = "overlay.webm"
"""File name of a video, in the folder of its recording and tracer."""

_MAX_WIDTH = 640
"""Wider pictures are written smaller, pixels: a report is looked at in a browser."""

_DEFAULT_HZ = 10.0
"""Frame rate of a recording with a single frame."""

Image = UInt8[np.ndarray, "height width 3"]


@contextlib.contextmanager
def video_writer(path: Path, rate_hz: float) -> Iterator[Callable[[Image], None]]:
    """A function that appends an RGB picture to a new VP8 video; all have one size. The file appears at the end, whole.

    Raises `ValueError` where OpenCV has no encoder for VP8.
    """
    with atomic_path(path) as partial, tempfile.TemporaryDirectory(dir=partial.parent, prefix=".video") as folder:
        file = Path(folder) / "video.webm"  # OpenCV chooses the container by the suffix
        writer: cv2.VideoWriter | None = None

        def write(image: Image) -> None:
            nonlocal writer
            if writer is None:
                size = (image.shape[1], image.shape[0])
                with _without_tag_message():
                    writer = cv2.VideoWriter(str(file), cv2.VideoWriter_fourcc(*"VP80"), rate_hz, size)  # type: ignore[attr-defined]
                if not writer.isOpened():
                    raise ValueError(f"{path}: this build of OpenCV writes no VP8 video; set scores.video=false.")
            writer.write(np.ascontiguousarray(image[..., ::-1]))

        try:
            yield write
        finally:
            if writer is not None:
                writer.release()
        if writer is not None:
            os.replace(file, partial)
        else:
            partial.touch()


@contextlib.contextmanager
def overlay_video(folder: Path, recording: Recording) -> Iterator[Callable[[Picture], None]]:
    """A function that draws each picture of a tracer over its recording and appends it to the video in `folder`."""
    rate_hz = recording.frame_rate_hz
    with video_writer(folder / VIDEO, rate_hz if np.isfinite(rate_hz) else _DEFAULT_HZ) as write:
        yield lambda picture: write(_shrunk(picture_overlay(recording, picture), _MAX_WIDTH))


def read_video(path: Path) -> Iterator[Image]:
    """The RGB pictures of a video, in order. Raises `ValueError` for a file that holds none."""
    reader = cv2.VideoCapture(str(path))
    try:
        there, image = reader.read()
        if not there:
            raise ValueError(f"{path}: found no video; expected a WebM file of a report. Evaluate again.")
        while there:
            yield image[..., ::-1]
            there, image = reader.read()
    finally:
        reader.release()


def smaller_video(path: Path, max_bytes: int) -> bytes:
    """A video of at most `max_bytes`: the file itself if it is small enough, else with smaller pictures."""
    if path.stat().st_size <= max_bytes:
        return path.read_bytes()
    rate_hz = _rate_hz(path)
    width = next(read_video(path)).shape[1]
    content = path.read_bytes()
    while len(content) > max_bytes and width > 64:
        width = int(width * min(0.9, 0.9 * (max_bytes / len(content)) ** 0.5))
        with tempfile.TemporaryDirectory() as folder:
            small = Path(folder) / VIDEO
            with video_writer(small, rate_hz) as write:
                for image in read_video(path):
                    write(_shrunk(image, width))
            content = small.read_bytes()
    return content


def _rate_hz(path: Path) -> float:
    reader = cv2.VideoCapture(str(path))
    try:
        return float(reader.get(cv2.CAP_PROP_FPS)) or _DEFAULT_HZ
    finally:
        reader.release()


def _shrunk(image: Image, max_width: int) -> UInt8[np.ndarray, "rows columns 3"]:
    """The picture itself, or resized to this width."""
    height, width = image.shape[:2]
    if width <= max_width:
        return image
    size = (max_width, max(1, round(height * max_width / width)))
    return cv2.resize(np.ascontiguousarray(image), size, interpolation=cv2.INTER_AREA).astype(np.uint8)


@contextlib.contextmanager
def _without_tag_message() -> Iterator[None]:
    """Keeps OpenCV's remark from standard error that WebM files have no tag for VP8: it is printed for each file."""
    sys.stderr.flush()
    kept = os.dup(2)
    with tempfile.TemporaryFile() as file:
        os.dup2(file.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            file.seek(0)
            for line in file.read().splitlines(keepends=True):
                if b"FFMPEG: tag" not in line:
                    os.write(2, line)
