"""A video file (.mp4, .mov, .avi) of colour with a folder of depth pictures and a camera file beside it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from ....core.names import valid_name
from ...checks import FIRST_DATE_NS
from ...video_files import check_whole, frame_time_ns, num_stated_frames, opened_video
from .camera_file import read_camera_file, required_camera_file
from .picture_folder import by_time, depth_folder, files_as_pictures
from .source import Picture, RgbdSource
from .times import check_counts, picture_files, start_time_ns, timed_files

ENDINGS = (".mp4", ".mov", ".avi", ".m4v")


def open_video(path: Path, camera_file: Path | None = None, start: str | float | None = None) -> RgbdSource:
    """A video with depth pictures in the folder depth/, <video>_depth/ or `depth_folder` beside it.

    The camera file is <video>.json, <video>.yaml or camera.json beside the video. Frame times are the container's. `start`
    (ISO, or seconds since 1970; else the camera file's) is the time of the first frame. Times of depth are of the same clock,
    or, where they begin within a day of 0, since the first frame. Raises `RecordingError` for files that are missing or cannot be
    used, and, while it is read, for a video that is cut short.
    """
    own = (f"{path.stem}{end}" for end in (".json", ".yaml", ".yml"))
    found = camera_file or required_camera_file(path.parent, *own)
    camera = read_camera_file(found)
    folder = depth_folder(path.parent, camera, f"{path.stem}_depth")
    start_ns = start_time_ns(camera.start if start is None else start)
    num_frames = _count(path)
    if camera.times == "frames" and camera.fps is None:
        files = picture_files(folder)
        check_counts(str(folder), files, num_frames, "depth pictures")
    else:
        files = None
    timed = None if files is not None else _on_clock(timed_files(folder, path.parent, camera), start_ns)

    def pictures() -> Iterator[Picture]:
        frames = _frames(path, num_frames, start_ns)
        if files is not None:
            return _side_by_side(frames, files)
        return by_time(frames, files_as_pictures(timed or [], "depth"))

    return RgbdSource(
        name=valid_name(path.stem),
        description=f"video {path.name} of {num_frames} frames and depth pictures in {folder.name}/",
        rig=camera.rig(str(found)),
        pictures=pictures,
        max_gap_s=camera.max_gap_s,
    )


def _on_clock(timed: list[tuple[int, Path]], start_ns: int | None) -> list[tuple[int, Path]]:
    """Times since the first frame, on the clock of `start_ns`; times of day as they are."""
    if start_ns is None or start_ns < FIRST_DATE_NS or timed[0][0] >= FIRST_DATE_NS:
        return timed
    return [(start_ns + time_ns, path) for time_ns, path in timed]


def _count(path: Path) -> int:
    """The number of frames that the container states."""
    video = opened_video(path, str(path))
    try:
        return num_stated_frames(video)
    finally:
        video.release()


def _frames(path: Path, num_frames: int, start_ns: int | None) -> Iterator[Picture]:
    """The frames of a video with the container's times, one after the other: each is decoded when it is its turn."""
    video = opened_video(path, str(path))
    number, first_ns = 0, 0
    try:
        while True:
            decoded, image = video.read()
            if not decoded:
                break
            time_ns = frame_time_ns(video)
            if start_ns is not None:
                first_ns = time_ns if number == 0 else first_ns
                time_ns += start_ns - first_ns
            yield _picture(path, number, time_ns, cv2.cvtColor(image, cv2.COLOR_BGR2RGB))
            number += 1
    finally:
        video.release()
    check_whole(str(path), number, num_frames)


def _picture(path: Path, number: int, time_ns: int, image: np.ndarray) -> Picture:
    return Picture("colour", time_ns, f"{path}: frame {number}", lambda: image)


def _side_by_side(frames: Iterator[Picture], files: list[Path]) -> Iterator[Picture]:
    """Each frame with the depth picture of its number, at its time."""
    for picture, path in zip(frames, files, strict=False):
        yield picture
        yield from files_as_pictures([(picture.time_ns, path)], "depth")
