"""A folder of colour and depth pictures with a camera file."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np

from ....core.errors import RecordingError
from ....core.names import valid_name
from ...image_files import read_colour, read_image
from .camera_file import CameraFile, read_camera_file, required_camera_file
from .source import Picture, RgbdSource
from .times import start_time_ns, subfolder, timed_files

_COLOUR_FOLDERS = ("colour", "color", "rgb", "image")
_DEPTH_FOLDERS = ("depth",)


def open_picture_folder(path: Path, camera_file: Path | None = None) -> RgbdSource:
    """A folder of colour and depth pictures (colour/ and depth/, or as the camera file names them).

    Depth is 16-bit PNG or TIFF, float32 TIFF (metres) or .npy. Raises `RecordingError` for a missing camera file, folders
    or times that cannot be used, and names that lead out of the folder; for damaged pictures when they are decoded.
    """
    found = camera_file or required_camera_file(path)
    camera = read_camera_file(found)
    colour = timed_files(stream_folder(path, camera.colour_folder, _COLOUR_FOLDERS, "colour_folder"), path, camera)
    depth = timed_files(depth_folder(path, camera), path, camera)

    def pictures() -> Iterator[Picture]:
        return by_time(files_as_pictures(colour, "colour"), files_as_pictures(depth, "depth"))

    return RgbdSource(
        name=valid_name(path.resolve().name),
        description=f"folder of {len(colour)} colour and {len(depth)} depth pictures {path.name}",
        rig=camera.rig(str(found)),
        pictures=pictures,
        max_gap_s=camera.max_gap_s,
        start_ns=start_time_ns(camera.start),
    )


def has_picture_folders(path: Path) -> bool:
    """Whether a folder holds colour and depth in folders of the usual names."""
    return all(any((path / name).is_dir() for name in names) for names in (_COLOUR_FOLDERS, _DEPTH_FOLDERS))


def depth_folder(base: Path, camera: CameraFile, *more: str) -> Path:
    """The folder of depth pictures inside of `base`. Raises `RecordingError` where there is none."""
    return stream_folder(base, camera.depth_folder, (*more, *_DEPTH_FOLDERS), "depth_folder")


def stream_folder(base: Path, given: str | None, usual: tuple[str, ...], key: str) -> Path:
    """The folder `given` by the camera file, or the first of the `usual` names that is there."""
    if given is not None:
        return subfolder(base, given, key)
    for name in usual:
        if (base / name).is_dir():
            return base / name
    raise RecordingError(f"{base}: no folder {' or '.join(usual)}; expected one, or {key}: <name> in the camera file.")


def files_as_pictures(timed: Iterable[tuple[int, Path]], stream: Literal["colour", "depth"]) -> Iterator[Picture]:
    """Pictures of files, in the given order."""
    read = colour_image if stream == "colour" else depth_image
    return (Picture(stream, time_ns, str(path), partial(read, path)) for time_ns, path in timed)


def by_time(*streams: Iterator[Picture]) -> Iterator[Picture]:
    """Streams that are in order of time as one."""
    return heapq.merge(*streams, key=lambda picture: picture.time_ns)


def colour_image(path: Path) -> np.ndarray:
    """A colour picture, uint8 RGB (height, width, 3). Raises `RecordingError` for a damaged file."""
    return np.ascontiguousarray(read_colour(path))


def depth_image(path: Path) -> np.ndarray:
    """A depth picture as it is stored, (height, width); .npy of float64 becomes float32. Raises `RecordingError`."""
    if path.suffix.lower() != ".npy":
        return read_image(path, cv2.IMREAD_UNCHANGED)
    try:
        values = np.load(path, allow_pickle=False)
    except Exception as error:  # of a damaged file NumPy raises various errors
        raise RecordingError(
            f"{path}: no readable .npy file ({type(error).__name__}: {error}). Copy it again."
        ) from error
    return values.astype(np.float32) if values.dtype == np.float64 else values
