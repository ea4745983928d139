"""Video files, decoded by OpenCV's FFmpeg: opened, timed by their container, and checked for an early end."""

from __future__ import annotations

from pathlib import Path

import cv2

from ..core.errors import RecordingError

VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Endings of video files."""

_MIN_DECODED = 0.98  # of the frames that the container counts; editing may hide some of the first


def opened_video(path: Path, where: str) -> cv2.VideoCapture:
    """The video. Raises `RecordingError`, which begins with `where`, for one that cannot be read."""
    video = cv2.VideoCapture(str(path.resolve()), cv2.CAP_FFMPEG)
    if not video.isOpened():
        raise RecordingError(
            f"{where}: no readable video ({path.stat().st_size} bytes); it is truncated, or its codec is unknown. Copy it again, "
            "or convert it: ffmpeg -i <video> -c:v libx264 <new>.mp4"
        )
    return video


def num_stated_frames(video: cv2.VideoCapture) -> int:
    """The number of frames that the container states."""
    return int(video.get(cv2.CAP_PROP_FRAME_COUNT))


def frame_time_ns(video: cv2.VideoCapture) -> int:
    """The container's time of the frame that was grabbed last."""
    return round(video.get(cv2.CAP_PROP_POS_MSEC) * 1e6)


def check_whole(where: str, num_decoded: int, num_stated: int) -> None:
    """Raise `RecordingError` for a video of which frames are missing."""
    if num_decoded < max(_MIN_DECODED * num_stated - 1, 1):
        raise RecordingError(
            f"{where}: {num_decoded} of {num_stated} frames can be decoded; the video is truncated or damaged. Copy it again."
        )
