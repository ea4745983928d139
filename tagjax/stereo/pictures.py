"""The pictures of one camera, from a video or a folder, decoded one after the other."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ..core.errors import RecordingError
from ..recording.computed_frames import ComputedFrames
from ..recording.image_files import read_colour
from ..recording.importers.rgbd.times import PICTURES, picture_files, times_of_names
from ..recording.video_files import VIDEOS, check_whole, frame_time_ns, num_stated_frames, opened_video

_COLOUR = tuple(ending for ending in PICTURES if ending != ".npy")


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
    where = f"{side}={folder}"
    files = picture_files(folder, where, _COLOUR)
    if fps is not None:
        times = _constant(len(files), fps)
    else:
        advice = "Otherwise give the frame rate: fps=30."
        times = np.array(times_of_names(files, where, advice=advice), np.int64)
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


def _constant(count: int, fps: float) -> np.ndarray:
    return np.rint(np.arange(count) * (1e9 / fps)).astype(np.int64)


class _Video:
    """A video read in order of its frames; going back opens it again."""

    def __init__(self, path: Path, side: str):
        self.path, self.side = path, side
        self._open()

    def _open(self) -> None:
        self.next = 0
        self.capture = opened_video(self.path, f"{self.side}={self.path}")

    def times_and_shape(self) -> tuple[np.ndarray, tuple[int, int, int]]:
        """The container's times of all frames that can be decoded, and the shape of a picture. Decodes the video once."""
        stated, times = num_stated_frames(self.capture), []
        while self.capture.grab():
            times.append(frame_time_ns(self.capture))
        check_whole(f"{self.side}={self.path}", len(times), stated)
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
