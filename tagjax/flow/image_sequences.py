"""Sequences of RGB images for flow training and evaluation: recordings, video files, folders of images; read lazily."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import zarr

from ..core.array_cache import cached_array
from ..core.progress import progress_lines, tracked
from ..core.types import LazyArray
from ..recording import RecordingError
from ..recording.image_files import natural_sorted, read_colour
from ..recording.store import open_recording
from .flying_chairs import is_flying_chairs

VIDEO_ENDINGS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg")
IMAGE_ENDINGS = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".ppm", ".webp")

_LONGEST_SIDE = 640
"""Longest side of a decoded video, pixels; crops for training are far smaller."""

_VERSION = 2
"""To be raised when the same video gives other frames: older copies are then not read."""

_PROGRESS_FROM, _MAX_LISTED = 200, 5
"""Number of images from which a progress bar is shown; highest number of bad images that a message lists."""


class ImageFolder:
    """The images of a folder in order of their names (frame2 before frame10) as RGB, read when indexed.

    All are read once when the folder is opened. Raises `RecordingError` that lists the images which cannot be read or
    differ in size from most.
    """

    def __init__(self, folder: Path):
        self._files = natural_sorted(p for p in folder.iterdir() if p.suffix.lower() in IMAGE_ENDINGS)
        if len(self._files) < 2:
            raise RecordingError(
                f"{folder} holds {len(self._files)} images ({', '.join(IMAGE_ENDINGS)}); a flow needs at least two."
            )
        self.shape = (len(self._files), *_common_shape(folder, self._files))
        self.dtype = np.dtype(np.uint8)

    def __getitem__(self, index: Any) -> np.ndarray:
        """The image, uint8 (height, width, 3); grey becomes RGB, 16 bits become 8."""
        path = self._files[int(index)]
        image = np.ascontiguousarray(read_colour(path))
        if image.shape != self.shape[1:]:
            raise RecordingError(
                f"{path} has {_size(image.shape)} pixels now; all images had {_size(self.shape[1:])} when the folder was "
                "opened. Do not change the folder during a run."
            )
        return image


def _common_shape(folder: Path, files: Sequence[Path]) -> tuple[int, ...]:
    """The shape (height, width, 3) of all images. Raises `RecordingError` that lists those which differ from most."""
    shapes, bad = {}, {}
    with ThreadPoolExecutor() as pool:
        # Decoding releases the interpreter lock.
        read = pool.map(_shape_or_error, files)
        for path, found in zip(
            files,
            tracked(read, f"check {folder.name}", len(files), shown=len(files) >= _PROGRESS_FROM),
            strict=True,
        ):
            (bad if isinstance(found, RecordingError) else shapes)[path] = found
    if not shapes:
        raise RecordingError(f"{folder}: none of {len(files)} images can be read. First: {next(iter(bad.values()))}")
    common, _ = Counter(shapes.values()).most_common(1)[0]
    bad |= {path: f"{path}: {_size(shape)} pixels." for path, shape in shapes.items() if shape != common}
    if bad:
        messages = [str(bad[path]) for path in files if path in bad]
        listed = " ".join(f"({n}) {message}" for n, message in enumerate(messages[:_MAX_LISTED], 1))
        more = f" And {len(messages) - _MAX_LISTED} more." if len(messages) > _MAX_LISTED else ""
        raise RecordingError(
            f"{folder}: {len(messages)} of {len(files)} images cannot be used; expected complete images of {_size(common)} "
            f"pixels, as most are. {listed}{more} Remove or replace them; images of another camera belong in another folder."
        )
    return common


def _shape_or_error(path: Path) -> tuple[int, ...] | RecordingError:
    try:
        return read_colour(path).shape
    except RecordingError as error:
        return error


def _size(shape: Sequence[int]) -> str:
    return f"{shape[1]} x {shape[0]}"


def open_sequence(path: str, cache: Path) -> LazyArray:
    """Images (frame, height, width, 3), uint8, of a recording (.zarr), a video file or a folder of images.

    A video is decoded once, into `cache`. Raises `RecordingError` for anything else, for fewer than two images, and for
    the pairs of FlyingChairs, which are no sequence.
    """
    location = Path(path)
    if is_flying_chairs(location):
        raise RecordingError(
            f"{path}: found the pairs of FlyingChairs; expected a sequence, whose successive images belong together. Name "
            "it in data.sequences of train_flow or in folders of evaluate_flow, which take its pairs."
        )
    if location.suffix == ".zarr" or path.startswith(("http://", "https://")):
        sequence: LazyArray = open_recording(path).colour
    elif location.is_dir():
        sequence = ImageFolder(location)
    elif location.suffix.lower() in VIDEO_ENDINGS and location.is_file():
        sequence = _decoded(location, cache)
    else:
        found = "a file" if location.is_file() else "nothing"
        raise RecordingError(
            f"{path}: found {found}; expected a recording (.zarr), a folder of images ({', '.join(IMAGE_ENDINGS)}) "
            f"or a video ({', '.join(VIDEO_ENDINGS)})."
        )
    if sequence.shape[0] < 2:
        raise RecordingError(f"{path} holds {sequence.shape[0]} image; a flow needs at least two.")
    return sequence


def _decoded(video: Path, cache: Path) -> LazyArray:
    """The frames of a video, decoded into the cache on the first call."""
    stamp = f"{_VERSION} {video.resolve()} {video.stat().st_size} {video.stat().st_mtime_ns}"
    target = cache / f"{video.stem}-{hashlib.sha256(stamp.encode()).hexdigest()[:12]}.zarr"
    return cached_array(target, lambda path: _decode(video, path))


def _decode(video: Path, path: Path) -> None:
    """Write the frames (frame, height, width, 3) of a video. Raises `RecordingError` for fewer than two."""
    capture = cv2.VideoCapture(str(video))
    try:
        ok, image = capture.read()
        if not ok:
            raise RecordingError(
                f"{video} cannot be decoded; expected a complete video whose codec OpenCV has. Convert it, or copy it again."
            )
        factor = min(1.0, _LONGEST_SIDE / max(image.shape[:2]))
        size = (round(image.shape[1] * factor), round(image.shape[0] * factor))
        # Streamed videos state no count or a wrong one: it is used for the progress bar only.
        stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        shape = (0, size[1], size[0], 3)
        array = zarr.create_array(str(path), shape=shape, dtype="uint8", chunks=(1, *shape[1:]))
        total = round(stated) if 0 < stated < math.inf else 0
        with progress_lines(kept=False) as report:
            while ok:
                report(f"decode {video.name}", array.shape[0], total)
                small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)[..., ::-1]
                array.append(np.ascontiguousarray(small)[None])
                ok, image = capture.read()
        if array.shape[0] < 2:
            raise RecordingError(
                f"{video} holds {array.shape[0]} image that can be decoded; a flow needs at least two."
            )
    finally:
        capture.release()
