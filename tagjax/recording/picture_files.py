"""Picture files, read strictly: OpenCV fills what is missing of one that was cut short, and says nothing."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from ..core.errors import RecordingError


def in_order(paths: Iterable[Path]) -> list[Path]:
    """Files of one folder by their names, the numbers in these by their value: frame2 before frame10."""
    return sorted(paths, key=lambda path: (_parts(path.stem), path.name))


def _parts(stem: str) -> list[str | int]:
    return [int(part) if number % 2 else part for number, part in enumerate(re.split(r"([0-9]+)", stem))]


def _jpeg_is_whole(data: bytes) -> bool:
    """Whether the end-of-image marker follows the pixels. A thumbnail in the header has an end of its own."""
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        kind = data[place + 1]
        if kind == 0xFF:  # padding
            place += 1
            continue
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        if kind == 0xDA:  # start of scan: from here FF is followed by 0 or a restart number, up to the end
            return data.find(b"\xff\xd9", place) >= 0
    return False


def _png_is_whole(data: bytes) -> bool:
    """Whether every block is there, up to IEND, with its checksum."""
    place = 8
    while place + 12 <= len(data):
        size = int.from_bytes(data[place : place + 4], "big")
        kind, end = data[place + 4 : place + 8], place + 8 + size
        if zlib.crc32(data[place + 4 : end]) != int.from_bytes(data[end : end + 4], "big") or end + 4 > len(data):
            return False
        if kind == b"IEND":
            return True
        place = end + 4
    return False


def read_picture(path: Path, flags: int) -> np.ndarray:
    """What OpenCV reads of a picture file with these flags. One that is cut short or damaged raises `RecordingError`."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error}). Is the folder complete?") from error
    # OpenCV fills what is missing of a picture with grey and says nothing.
    cut = (data[:2] == b"\xff\xd8" and not _jpeg_is_whole(data)) or (
        data[:8] == b"\x89PNG\r\n\x1a\n" and not _png_is_whole(data)
    )
    try:
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and not cut else None
    except cv2.error:
        picture = None
    if picture is None:
        found = "the picture is cut short or damaged" if cut else f"no readable picture ({len(data)} bytes)"
        raise RecordingError(f"{path}: {found}; expected a whole picture file. Copy it again.")
    return picture


def read_colour(path: Path) -> np.ndarray:
    """An RGB picture, uint8 (height, width, 3). One that is cut short raises `RecordingError`."""
    return read_picture(path, cv2.IMREAD_COLOR)[..., ::-1]


def read_labels(path: Path) -> np.ndarray:
    """A label picture, uint8 (height, width). One that is cut short raises `RecordingError`."""
    return read_picture(path, cv2.IMREAD_GRAYSCALE)
