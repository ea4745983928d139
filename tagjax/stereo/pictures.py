"""The pictures of one camera, from a video or a folder, decoded one after the other."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from ..core.errors import RecordingError
from ..recording.computed_frames import ComputedFrames
from ..recording.image_files import natural_sorted, read_colour
from ..recording.importers.read_values import stamp_ns
from ..recording.importers.rows import RowError

PICTURES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")

_NOT_A_TIME = 10**7  # picture names up to here are numbers of frames


def open_pictures(path: str | Path, side: str, fps: float | None) -> tuple[ComputedFrames, np.ndarray]:
    """The pictures, uint8 RGB (frames, height, width, 3), and their times (frames,) int64 ns.

    A video has the times of its container, or with `fps` a constant rate. Pictures of a folder have the times of their names
    (seconds, or whole milli-, micro- or nanoseconds since 1970), or with `fps` a constant rate in natural order of their names.
    Raises `RecordingError`, which names the `side`, for what cannot be read.
    """
    path = Path(path)
    if path.is_dir():
        return _open_folder(path, side, fps)
    if not path.is_file():
        raise RecordingError(f"{side}={path}: no such file or folder. Check the path.")
    if path.suffix.lower() not in VIDEOS:
        raise RecordingError(
            f"{side}={path}: no known video; expected a file that ends in {', '.join(VIDEOS)}, or a folder of pictures."
        )
    return _open_video(path, side, fps)


def _open_folder(folder: Path, side: str, fps: float | None) -> tuple[ComputedFrames, np.ndarray]:
    files = natural_sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES and path.is_file())
    if not files:
        raise RecordingError(f"{side}={folder}: no picture; expected files that end in {', '.join(PICTURES)}.")
    times = _constant(len(files), fps) if fps is not None else _times_of_names(files, side)
    shape = read_colour(files[0]).shape

    def decode(frame: int) -> np.ndarray:
        picture = np.ascontiguousarray(read_colour(files[frame]))
        if picture.shape != shape:
            raise RecordingError(
                f"{files[frame]}: {picture.shape[1]} x {picture.shape[0]} pixels; expected {shape[1]} x {shape[0]} as in "
                f"{files[0].name}."
            )
        return picture

    return ComputedFrames((len(files), *shape), np.uint8, decode), times


def _times_of_names(files: list[Path], side: str) -> np.ndarray:
    stems = [path.stem for path in files]
    if all(stem.isdigit() and int(stem) < _NOT_A_TIME for stem in stems):
        raise RecordingError(
            f"{side}={files[0].parent}: names such as {files[0].name} are no times; give the frame rate: fps=30."
        )
    try:
        return np.array([stamp_ns(stem) for stem in stems], np.int64)
    except RowError as error:
        raise RecordingError(
            f"{side}={files[0].parent}: the names are no times ({error}); give the frame rate (fps=30), or name pictures by seconds "
            "since 1970."
        ) from error


def _constant(count: int, fps: float) -> np.ndarray:
    return np.rint(np.arange(count) * (1e9 / fps)).astype(np.int64)


class _Video:
    """A video read in order of its frames; going back opens it again."""

    def __init__(self, path: Path, side: str):
        self.path, self.side = path, side
        self._open()

    def _open(self) -> None:
        self.next = 0
        self.capture = cv2.VideoCapture(str(self.path.resolve()), cv2.CAP_FFMPEG)
        if not self.capture.isOpened():
            raise RecordingError(
                f"{self.side}={self.path}: no readable video ({self.path.stat().st_size} bytes); it is truncated, or its codec is "
                "unknown. Copy it again, or convert it."
            )

    def times_and_shape(self) -> tuple[np.ndarray, tuple[int, int, int]]:
        """The container's times of all frames that can be decoded, and the shape of a picture. Decodes the video once."""
        stated, times, shape = int(self.capture.get(cv2.CAP_PROP_FRAME_COUNT)), [], None
        while self.capture.grab():
            times.append(round(self.capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6))
        if not times:
            raise RecordingError(f"{self.side}={self.path}: no frame can be decoded. Copy the video again.")
        if len(times) < 0.98 * stated - 1:
            raise RecordingError(
                f"{self.side}={self.path}: {len(times)} of {stated} frames can be decoded; the video is truncated or damaged. Copy it "
                "again."
            )
        self._open()
        shape = self(0).shape
        return np.array(times, np.int64), (int(shape[0]), int(shape[1]), 3)

    def __call__(self, frame: int) -> np.ndarray:
        if frame < self.next:
            self.capture.release()
            self._open()
        decoded = True
        while decoded and self.next < frame:
            decoded = self.capture.grab()
            self.next += 1
        decoded, image = self.capture.read() if decoded else (False, None)
        if not decoded or image is None:
            raise RecordingError(f"{self.side}={self.path}: frame {frame} cannot be decoded. Copy the video again.")
        self.next += 1
        return np.ascontiguousarray(image[..., ::-1])


def _open_video(path: Path, side: str, fps: float | None) -> tuple[ComputedFrames, np.ndarray]:
    video = _Video(path, side)
    times, shape = video.times_and_shape()
    if fps is not None:
        times = _constant(len(times), fps)
    return ComputedFrames((len(times), *shape), np.uint8, video), times
