"""Image files, read and written strictly.

OpenCV itself fills the missing part of a truncated file without an error, and leaves half a file on a full disk.
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np

from ..core.errors import RecordingError
from ..core.files import write_atomic


def natural_sorted(paths: Iterable[Path]) -> list[Path]:
    """Paths in natural order of their names: frame2 before frame10."""
    return sorted(paths, key=lambda path: (_parts(path.stem), path.name))


def _parts(stem: str) -> list[str | int]:
    return [int(part) if number % 2 else part for number, part in enumerate(re.split(r"([0-9]+)", stem))]


def _jpeg_is_complete(data: bytes) -> bool:
    """Whether the end-of-image marker follows the pixels. (A thumbnail in the header has its own end marker.)"""
    place = 2
    while place + 4 <= len(data) and data[place] == 0xFF:
        kind = data[place + 1]
        if kind == 0xFF:  # padding
            place += 1
            continue
        place += 2 + int.from_bytes(data[place + 2 : place + 4], "big")
        if kind == 0xDA:  # start of scan: up to the end marker, FF is followed by 0 or a restart number
            return data.find(b"\xff\xd9", place) >= 0
    return False


def _png_is_complete(data: bytes) -> bool:
    """Whether every chunk up to IEND is there, with its checksum."""
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


def read_image(path: Path, flags: int) -> np.ndarray:
    """An image file decoded by OpenCV with these flags (cv2.IMREAD_...). Raises `RecordingError` for a truncated or
    damaged file.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read ({error}). Is the folder complete?") from error
    truncated = (data[:2] == b"\xff\xd8" and not _jpeg_is_complete(data)) or (
        data[:8] == b"\x89PNG\r\n\x1a\n" and not _png_is_complete(data)
    )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data and not truncated else None
    except cv2.error:
        image = None
    if image is None:
        found = "the image is truncated or damaged" if truncated else f"no readable image ({len(data)} bytes)"
        raise RecordingError(f"{path}: {found}; expected a complete image file. Copy it again.")
    return image


def read_colour(path: Path) -> np.ndarray:
    """An RGB image, uint8 (height, width, 3). Raises `RecordingError` for a truncated or damaged file."""
    return read_image(path, cv2.IMREAD_COLOR)[..., ::-1]


def read_labels(path: Path) -> np.ndarray:
    """A label image, uint8 (height, width). Raises `RecordingError` for a truncated or damaged file."""
    return read_image(path, cv2.IMREAD_GRAYSCALE)


def write_image(path: Path, image: np.ndarray, *, jpeg_quality: int = 95) -> None:
    """Write an RGB image (height, width, 3), uint8, as the kind of file that the suffix of `path` names (.png, .jpg).

    The file appears whole or not at all. Raises `WriteError` where the file system refuses to write.
    """
    parameters = [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality] if path.suffix == ".jpg" else []
    encoded, data = cv2.imencode(path.suffix, np.ascontiguousarray(image[..., ::-1]), parameters)
    assert encoded
    write_atomic(path, data.tobytes())
