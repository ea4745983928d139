"""Recordings whose depth comes from two colour cameras, as `experiments.stereo` makes them."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import RecordingError
from ..core.names import MAX_NAME, valid_name
from ..core.settings import ConfigError
from ..core.types import LazyArray
from ..recording.computed_frames import ComputedFrames
from ..recording.importers.rgbd.times import start_time_ns
from ..recording.importers.tables import import_table
from ..recording.reads import TagReads
from ..recording.recording import Recording
from ..recording.store import open_recording, save_recording
from .matching import MatchSettings, depth_of_pair
from .pair_check import check_pairs
from .pictures import open_pictures
from .rectification import Rectification, rectify
from .rig import StereoRig, read_rig
from .steady import MAX_FRAMES, SteadyPictures

_NAME_ENDING = "-stereo"
_MAX_APART = 0.25  # of a frame, between the two cameras' times
_PLACES_M = (1.0, 2.0, 4.0)  # for which the report states the resolution of depth


@dataclasses.dataclass(frozen=True)
class StereoSettings:
    """Two videos or folders with a camera file, or a recording that has a second camera; reads; and the new recording."""

    left: str | None = None
    right: str | None = None
    camera: str | None = None  # JSON, as experiments.calibrate_stereo writes it
    recording: str | None = None  # in place of left, right, camera and reads
    fps: float | None = None  # frame rate, where videos or names of pictures have no times
    start: Any = None  # time of the first frame (ISO, or seconds since 1970); null: the times stay as they are
    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)
    average_s: float = (
        0.27  # time over which what does not change is averaged before matching, at most 10 frames; 0: none
    )
    reads: str | None = None
    format: str = "auto"
    hop_table_hz: tuple[float, ...] | None = None
    carrier_hz: float | None = None
    clock: Any = "auto"
    antennas_m: tuple[tuple[float, float, float], ...] = ((0.0, 0.0, 0.0),)  # in the left camera's frame
    out: str | None = None

    def __post_init__(self) -> None:
        videos = {"left": self.left, "right": self.right, "camera": self.camera}
        given = [name for name, value in videos.items() if value is not None]
        if self.recording is not None and (given or self.reads is not None):
            raise ConfigError(
                f"found recording and {', '.join([*given, *(['reads'] if self.reads is not None else [])])}; expected recording=<a "
                "recording with a second camera> by itself, or left, right and camera."
            )
        if self.recording is None and len(given) < 3:
            raise ConfigError(
                f"found {', '.join(given) or 'no pictures'}; expected left=<video or folder> right=<video or folder> camera=<file>, or "
                "recording=<a recording with a second camera>."
            )
        if not 0 <= self.average_s <= 60:
            raise ConfigError(f"average_s is {self.average_s}; expected 0 (no average) to 60 s.")
        if self.fps is not None and not 0 < self.fps <= 1000:
            raise ConfigError(f"fps is {self.fps}; expected a frame rate above 0 and at most 1000.")


def stereo_recording(settings: StereoSettings, *, progress: bool = False) -> tuple[Recording, list[str]]:
    """The recording, checked, and saved if `settings.out` is given; and a report, line by line.

    Colour is the rectified left picture, depth its disparity to the right one. Both are computed when they are read. Raises
    `RecordingError` for data that cannot be used, swapped cameras among them.
    """
    if settings.out is not None and Path(settings.out).exists():
        raise RecordingError(f"{settings.out} exists. Remove it or choose another name.")
    plain, right, rectification, lines = (
        _of_recording(settings) if settings.recording is not None else _of_pair(settings)
    )
    camera, baseline_m = rectification.camera, rectification.baseline_m
    first, count = settings.match.search_px(camera.fx_px, baseline_m)
    resolution = ", ".join(f"{1000 * z * z / (camera.fx_px * baseline_m):.0f} mm at {z:g} m" for z in _PLACES_M)
    lines.append(
        f"{camera.width} x {camera.height}, f {camera.fx_px:.1f} px, baseline {1000 * baseline_m:.1f} mm; disparities of {first} to "
        f"{first + count - 1} px; one pixel is {resolution}"
    )
    left = plain.colour
    tried = sorted({0, plain.num_frames // 2, plain.num_frames - 1})
    checked = check_pairs([(left[t], right[t]) for t in tried], camera.fx_px, baseline_m, settings.match)
    checked.raise_if_wrong(plain.name)
    lines.append(f"{checked.matched:.0%} of the pixels of frames {', '.join(map(str, tried))} have depth")
    if (warning := checked.warning()) is not None:
        lines.append(warning)

    num_averaged = _num_averaged(settings.average_s, plain.time_ns)
    steady_left, steady_right = SteadyPictures(left, num_averaged), SteadyPictures(right, num_averaged)

    def depth(frame: int) -> np.ndarray:
        return depth_of_pair(steady_left(frame), steady_right(frame), camera, baseline_m, settings.match)

    recording = dataclasses.replace(
        plain,
        depth=ComputedFrames((plain.num_frames, camera.height, camera.width), np.uint16, depth),
        name=valid_name(plain.name[: MAX_NAME - len(_NAME_ENDING)] + _NAME_ENDING),
        source=f"{plain.source}; depth from two cameras {1000 * baseline_m:.1f} mm apart, {num_averaged} frames averaged, "
        f"{settings.match}",
    )
    recording.check()
    lines.append(
        f"{recording.num_frames} frames, {recording.frame_rate_hz:.1f} frames/s, {recording.reads.num_reads} reads of "
        f"{len(recording.reads.epcs)} tags"
    )
    if settings.out is not None:
        save_recording(recording, settings.out, progress=progress)
        lines.append(f"saved as {settings.out}")
    return recording, lines


def _num_averaged(average_s: float, time_ns: np.ndarray) -> int:
    """The number of frames in `average_s`, from 1 to `MAX_FRAMES`."""
    if len(time_ns) < 2:
        return 1
    return int(np.clip(1 + np.floor(average_s * 1e9 / np.median(np.diff(time_ns))), 1, MAX_FRAMES))


def _of_recording(settings: StereoSettings) -> tuple[Recording, LazyArray, Rectification, list[str]]:
    """A stored recording of two cameras, without its depth."""
    recording = open_recording(str(settings.recording))
    if recording.second is None:
        raise RecordingError(
            f"{settings.recording}: one camera; expected a recording with a second one. A suite is simulated with two by "
            "+suite.capture.stereo_baseline_m=0.12."
        )
    rig = StereoRig(
        recording.intrinsics, recording.intrinsics, translation_m=np.array([-recording.second.baseline_m, 0.0, 0.0])
    )
    rig.check(str(settings.recording))
    plain = dataclasses.replace(recording, depth_kind="depth", second=None, store=None)
    return plain, recording.second.colour, rectify(rig), [f"second camera of {recording.name}"]


def _of_pair(settings: StereoSettings) -> tuple[Recording, LazyArray, Rectification, list[str]]:
    """Two videos or folders as a recording without depth, the right pictures rectified."""
    rig = read_rig(str(settings.camera))
    rectification = rectify(rig)
    (left, times), (right, right_times) = (
        open_pictures(str(getattr(settings, side)), side, settings.fps) for side in ("left", "right")
    )
    _check_alike(settings, rig, left, right)
    _check_times(times, right_times)
    lines = [f"{len(left)} pairs of {Path(str(settings.left)).name} and {Path(str(settings.right)).name}"]
    start_ns = start_time_ns(settings.start)
    if start_ns is not None:
        times = times - times[0] + start_ns
    reads, clock = TagReads.empty(), None
    if settings.reads is not None:
        reads, clock, report = import_table(
            settings.reads,
            format=settings.format,
            hop_table_hz=settings.hop_table_hz,
            carrier_hz=settings.carrier_hz,
            clock=settings.clock,
        )
        lines += report.lines()

    def colour(frame: int) -> np.ndarray:
        return rectification.left(left[frame])

    def second(frame: int) -> np.ndarray:
        return rectification.right(right[frame])

    plain = Recording(
        colour=ComputedFrames(left.shape, np.uint8, colour),
        depth=np.zeros((0,), np.uint16),
        time_ns=times,
        intrinsics=rectification.camera,
        reads=reads,
        antennas_m=rectification.points(np.asarray(settings.antennas_m, float)),
        clock=clock,
        name=valid_name(Path(str(settings.left)).resolve().stem),
        source=f"stereo pair {Path(str(settings.left)).name}, {Path(str(settings.right)).name}",
    )
    return plain, ComputedFrames(right.shape, np.uint8, second), rectification, lines


def _check_alike(settings: StereoSettings, rig: StereoRig, left: LazyArray, right: LazyArray) -> None:
    size = (rig.left.height, rig.left.width)
    for side, frames in (("left", left), ("right", right)):
        if tuple(frames.shape[1:3]) != size:
            raise RecordingError(
                f"{side}={getattr(settings, side)}: {frames.shape[2]} x {frames.shape[1]} pixels; expected {size[1]} x {size[0]} as "
                f"in {settings.camera}. Calibrate at the resolution of the recording."
            )
    if left.shape[0] != right.shape[0]:
        raise RecordingError(
            f"{left.shape[0]} pictures on the left, {right.shape[0]} on the right; expected pairs. Cut both to the frames that were "
            "taken at the same times."
        )


def _check_times(left_ns: np.ndarray, right_ns: np.ndarray) -> None:
    """Raise `RecordingError` where the pictures of a pair are not of one time, apart from a constant offset."""
    if len(left_ns) < 2:
        return
    frame_ns = float(np.median(np.diff(left_ns)))
    apart_ns = np.abs((left_ns - left_ns[0]) - (right_ns - right_ns[0]))
    worst = int(np.argmax(apart_ns))
    if apart_ns[worst] > _MAX_APART * frame_ns:
        raise RecordingError(
            f"frame {worst}: the times of left and right differ by {apart_ns[worst] * 1e-6:.1f} ms more than at the first frame; "
            f"expected at most {_MAX_APART:g} of the {frame_ns * 1e-6:.1f} ms of a frame. One camera dropped frames: use cameras with "
            "a common trigger, or give fps if the times are wrong."
        )
