"""An animation of a traced recording: the tracer's masks on the left, the reads and distances that they follow on the right."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from ..core.camera import working_stride
from ..core.names import short_name
from ..core.progress import OnProgress, unobserved
from ..core.settings import ConfigError
from ..metrics.recordings import box_to_picture, mask_to_picture
from ..recording import Recording
from ..report.overlay import draw_overlay, scaled_boxes, true_boxes
from ..tracing.status import status_or_detected
from ..tracing.tracer import Trace
from .traced import Traced, TracedConfig

if TYPE_CHECKING:
    from ..report.charts import TagCurves

_VIDEO = 0.6
"""The part of the width that the video has."""

_MASK_LEVEL = 0.5


@dataclasses.dataclass(frozen=True, kw_only=True)
class PictureConfig(TracedConfig):
    """What is traced, and the size of the picture. `out` ends in .webp, .gif or .png, which decides on the format."""

    out: str
    shown: tuple[int, int] | None = None  # [first, last + 1] of the frames in the picture, of those that are traced
    width: int = 800  # pixels
    hold_s: float = 1.5  # so much longer the last frame is shown
    quality: int = 70  # of WebP, 0 to 100

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.width < 800:
            raise ConfigError(f"width is {self.width}; expected at least 800 pixels, for text that can be read.")
        if not self.hold_s >= 0.0 or not 0 <= self.quality <= 100:
            raise ConfigError(
                f"hold_s is {self.hold_s}, quality {self.quality}; expected at least 0, and a value from 0 to 100."
            )


def make_picture(config: PictureConfig, *, on_progress: OnProgress = unobserved) -> Path:
    """Trace the recording and write the animation to `config.out`; its path.

    Raises `ConfigError` where matplotlib or Pillow is not installed, and for another suffix.
    """
    try:
        from ..report.animation import animation_format, write_animation
        from ..report.charts import GrowingCharts
    except ImportError as error:
        raise ConfigError('needs the viz extra: pip install -c constraints.txt -e ".[viz]"') from error
    out = Path(config.out)
    animation_format(out)  # a wrong suffix raises before the work
    traced = Traced.open(config)
    first, last = _shown(config, traced)
    frame_s = np.asarray(traced.recording.frame_time_s()[first:last], np.float64)
    frame_s -= frame_s[0]
    video, ranges_m = [], []
    for number, trace in traced.traces(on_progress):
        if first <= number < last:
            time_s = float(frame_s[number - first])
            video.append(frame_overlay(traced, number, trace, round(_VIDEO * config.width), caption=f"{time_s:.1f} s"))
            ranges_m.append(_ranges_m(traced, trace))
    curves = tag_curves(traced, (first, last), np.stack(ranges_m))
    height, width = video[0].shape[:2]
    charts = GrowingCharts(curves, frame_s, config.width - width, height)
    images = []
    for number, left in enumerate(video):
        on_progress("draw", number, len(video))
        images.append(np.concatenate([left, charts.drawn(number)], axis=1))
    on_progress("draw", len(video), len(video))
    out.parent.mkdir(parents=True, exist_ok=True)
    rate_hz = traced.recording.frame_rate_hz
    write_animation(
        out, images, rate_hz=rate_hz if np.isfinite(rate_hz) else 10.0, hold_s=config.hold_s, quality=config.quality
    )
    return out


def _shown(config: PictureConfig, traced: Traced) -> tuple[int, int]:
    """The frames in the picture. Raises `ConfigError` where they are none, or not traced."""
    first, last = config.shown or traced.frames
    if not traced.frames[0] <= first < last <= traced.frames[1]:
        raise ConfigError(
            f"shown is [{first}, {last}]; expected a part of the traced frames, [{traced.frames[0]}, {traced.frames[1]}]."
        )
    return first, last


def tag_curves(traced: Traced, frames: tuple[int, int], ranges_m: Float64[np.ndarray, "frames tag"]) -> list[TagCurves]:
    """The reads of the first antenna within the frames [first, last + 1], and the distances to it, of each tag."""
    from ..report.charts import TagCurves

    recording, antenna = traced.recording, traced.antennas[0]
    first, last = frames
    begin_ns, end_ns = (int(recording.time_ns[number]) for number in (first, last - 1))
    curves = []
    for tag, epc in enumerate(traced.epcs):
        reads = recording.reads.select(epc)
        reads = reads[(reads.antenna == antenna) & (reads.time_ns >= begin_ns) & (reads.time_ns <= end_ns)]
        curves.append(
            TagCurves(
                short_name(epc),
                (reads.time_ns - begin_ns) * 1e-9,
                np.mod(np.asarray(reads.phase_rad, np.float64), 2 * np.pi),
                ranges_m[:, tag],
                _true_range_m(recording, epc, antenna)[first:last],
            )
        )
    return curves


def _true_range_m(recording: Recording, epc: str, antenna: int) -> Float64[np.ndarray, " frames"]:
    """The tag's true distance to an antenna; NaN where it is not known."""
    truth = recording.truth
    if truth is None or epc not in truth.tag_position_m:
        return np.full(recording.num_frames, np.nan)
    place_m = np.asarray(truth.tag_position_m[epc], np.float64)
    return np.linalg.norm(place_m - recording.antennas_m[antenna - 1], axis=-1)


def _ranges_m(traced: Traced, trace: Trace) -> Float64[np.ndarray, " tag"]:
    """Distance of each mask's centre to the first antenna; NaN for a tag that is not detected."""
    place_m = np.asarray(trace.centre_m, np.float64)
    range_m = np.linalg.norm(place_m - traced.recording.antennas_m[traced.antennas[0] - 1], axis=-1)
    return np.where(np.asarray(trace.detected), range_m, np.nan)


def frame_overlay(
    traced: Traced, number: int, trace: Trace, width: int, *, caption: str
) -> UInt8[np.ndarray, "rows columns 3"]:
    """The overlay of a frame, enlarged to `width` before lines and text are drawn."""
    recording = traced.recording
    rows, columns = recording.image_shape
    stride, scale = working_stride(columns, traced.clips.stride), width / columns
    size = (width, round(rows * scale))
    detected = np.asarray(trace.detected, bool)
    masks = [
        cv2.resize(mask_to_picture(np.asarray(one), stride, rows, columns), size, interpolation=cv2.INTER_LINEAR)
        for one in trace.mask
    ]
    colour = cv2.resize(np.asarray(recording.colour[number]), size, interpolation=cv2.INTER_CUBIC)
    return draw_overlay(
        colour.astype(np.uint8),
        [short_name(epc) for epc in traced.epcs],
        np.stack(masks) >= _MASK_LEVEL,
        scaled_boxes(box_to_picture(np.asarray(trace.box_px), stride, rows, columns), scale),
        np.asarray(trace.confidence),
        detected,
        status=status_or_detected(trace.status, detected),
        true_boxes_px=scaled_boxes(true_boxes(recording, number, traced.epcs), scale),
        caption=caption,
    )
