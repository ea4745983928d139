"""The formats of RGB-D recordings, chosen by what a path holds."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

from ....core.errors import RecordingError
from .azure_kinect import open_azure_kinect
from .bag_reader import BAG_ENDINGS
from .bags import Topics, open_bag
from .camera_file import find_camera_file
from .picture_folder import has_picture_folders, open_picture_folder
from .source import RgbdSource
from .video_file import ENDINGS, open_video

FORMATS = ("tum", "jpg_mat", "pictures", "video", "bag", "azure_kinect")
"""Names of the formats, for `video_format`."""

SUPPORTED = (
    "a folder of colour/ and depth/ pictures with camera.json or camera.yaml (pictures)",
    f"{', '.join(ENDINGS)} with a folder of depth pictures and a camera file beside it (video)",
    "RealSense and ROS bags: .bag, .mcap, .db3, or a ROS 2 folder with metadata.yaml (bag)",
    "Azure Kinect and Orbbec .mkv (azure_kinect)",
    "a TUM RGB-D folder with rgb.txt and depth.txt (tum)",
    "a folder of .jpg and .mat with calibration=<file.mat> (jpg_mat)",
)
"""What can be imported, for messages."""


_FILES = {".mkv": "azure_kinect", **dict.fromkeys(ENDINGS, "video"), **dict.fromkeys(BAG_ENDINGS, "bag")}


@dataclasses.dataclass(frozen=True)
class SourceOptions:
    """What the user states beside the path."""

    camera: str | None = None
    start: Any = None
    topics: Topics = dataclasses.field(default_factory=Topics)


def recognise(path: Path, camera: str | None = None) -> str:
    """The format of what a path holds. Raises `RecordingError`, which lists what is supported."""
    if not path.exists():
        raise RecordingError(f"video={path}: no such file or folder. Check the path.")
    found = _folder_format(path, camera) if path.is_dir() else _FILES.get(path.suffix.lower())
    if found is None:
        inside = sorted(one.name for one in path.iterdir() if one.suffix.lower() in _FILES) if path.is_dir() else []
        hint = f" It holds {', '.join(inside[:3])}: give the path of that file." if inside else ""
        raise RecordingError(f"video={path}: no known recording.{hint} {supported()}")
    return found


def _folder_format(path: Path, camera: str | None) -> str | None:
    if (path / "metadata.yaml").is_file():
        return "bag"
    if (path / "rgb.txt").is_file() and camera is None:
        return "tum"
    if camera is not None or find_camera_file(path) is not None or has_picture_folders(path):
        return "pictures"
    return "jpg_mat" if any(path.glob("*.jpg")) else None


def supported() -> str:
    """The supported formats as a sentence."""
    return f"Expected {'; '.join(SUPPORTED[:-1])}; or {SUPPORTED[-1]}. docs/importing.md describes each."


def open_source(path: Path, chosen: str, options: SourceOptions) -> RgbdSource:
    """A recording of a format that `recognise` returned, except tum and jpg_mat. Errors as of the format's function."""
    camera = None if options.camera is None else Path(options.camera)
    if chosen == "pictures":
        return open_picture_folder(path, camera)
    if chosen == "video":
        return open_video(path, camera, options.start)
    if chosen == "bag":
        return open_bag(path, options.topics, camera)
    if chosen == "azure_kinect":
        return open_azure_kinect(path, camera)
    raise RecordingError(f"video_format={chosen}: expected auto, {', '.join(FORMATS)}.")
