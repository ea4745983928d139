"""Tracers that run on the host: OpenCV detects and tracks, so there is no `lax.scan`, but the interface is the same.

`AbstractHostTracer` is a state machine as `AbstractTracer` is: `init`, one `step` a frame, `finish`. Its input is
colour pictures (and depth, where a tracer asks for it) instead of flow, and raw reads instead of distances; its
output is a `Trace` at the full size of the picture. `host_trace` yields the same pairs as the tracing of
`AbstractTracer`, so the same code scores both. Everything is causal: at a frame only the reads up to that frame are
used.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from ..core.geometry import range_to_depth
from ..recording import Intrinsics, Recording, RecordingError, TagReads
from ..tracing.tracer import Trace


@dataclasses.dataclass(frozen=True)
class HostCamera:
    """What is constant in a recording: the camera, the antennas (camera frame), and the tags to trace, in order."""

    intrinsics: Intrinsics
    antennas_m: Float[np.ndarray, "antennas 3"]
    epcs: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class HostFrame:
    """One picture, and the reads of the traced tags after the previous frame up to this one."""

    number: int
    time_s: float  # since the recording's first frame
    colour: UInt8[np.ndarray, "height width 3"]
    reads: TagReads  # of all traced tags, in order of time
    read_time_s: Float[np.ndarray, " reads"]  # of those reads, since the recording's first frame
    depth_m: Float[np.ndarray, "height width"] | None = None  # z, 0 = missing; for tracers that need depth


@dataclasses.dataclass(frozen=True)
class Detection:
    """One tag's object in one frame. Pixels are those of the full picture; positions are in the camera frame."""

    mask: Bool[np.ndarray, "height width"]
    centre_m: Shaped[np.ndarray, " 3"]  # NaN where the method gives no position
    confidence: float  # 0 to 1
    box_px: Shaped[np.ndarray, " 4"] | None = None  # x0 y0 x1 y1, first and last pixel; the mask's own box if None
    step_m: float = 0.0  # change of the distance to the antenna since the previous frame, 0 where the method has none


class AbstractHostTracer(abc.ABC):
    """A tracing system on the host as a state machine: `init`, one `step` a frame, `finish`."""

    needs_depth: ClassVar[bool] = False
    """Whether frames hold depth. The systems before TagAttention have no depth camera."""

    @abc.abstractmethod
    def inapplicable(self, recording: Recording) -> str | None:
        """Why the method's assumptions do not hold for a recording, in a sentence for a table's cell; None if they
        do.
        """

    @abc.abstractmethod
    def init(self, camera: HostCamera) -> Any:
        """The state before the first frame."""

    @abc.abstractmethod
    def step(self, camera: HostCamera, state: Any, frame: HostFrame) -> tuple[Any, Trace]:
        """The next state and this frame's `Trace` (see `trace_from_detections`); the given state is not modified."""

    @abc.abstractmethod
    def finish(self, state: Any) -> Any:
        """The state to continue from in the next piece of the recording; it refers to no buffer of a past frame."""


def host_frames(
    recording: Recording, epcs: Sequence[str], frames: tuple[int, int] | None = None, *, depth: bool = False
) -> Iterator[HostFrame]:
    """The frames `first` to `last` - 1 with their reads, and with their depth if asked for. The first frame gets every read since the recording's start.

    Raises `RecordingError` for frames outside the recording.
    """
    first, last = frames or (0, recording.num_frames)
    if not 0 <= first < last <= recording.num_frames:
        raise RecordingError(
            f"{recording.name}: found frames {first} to {last}, expected a part of 0 to {recording.num_frames}. "
            "Choose frames within the recording."
        )
    own = recording.reads[np.isin(recording.reads.epc, list(epcs))]
    read_time_s = (own.time_ns - recording.time_ns[0]) * 1e-9
    # Reads from before the first frame are kept: phases are unwrapped from there.
    stop = np.searchsorted(own.time_ns, recording.time_ns, side="right")
    start = 0
    for number in range(first, last):
        part = slice(start, int(stop[number]))
        start = int(stop[number])
        yield HostFrame(
            number=number,
            time_s=float((recording.time_ns[number] - recording.time_ns[0]) * 1e-9),
            colour=np.asarray(recording.colour[number]),
            reads=own[part],
            read_time_s=read_time_s[part],
            depth_m=_depth_m(recording, number) if depth else None,
        )


def _depth_m(recording: Recording, number: int) -> Float[np.ndarray, "height width"]:
    """Depth along the optical axis at a frame, 0 where missing."""
    depth_m = recording.depth_metres(number)
    return range_to_depth(depth_m, recording.intrinsics) if recording.depth_kind == "range" else depth_m


def host_trace(
    tracer: AbstractHostTracer,
    recording: Recording,
    *,
    epcs: Sequence[str] | None = None,
    frames: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Trace]]:
    """Run a host tracer over a recording: each frame's number and `Trace` (NumPy leaves, tags in the order of `epcs`).

    Frames are yielded one by one, so that masks do not accumulate. Raises `RecordingError` where there is no tag, for a
    recording that `Recording.check` refuses (depth may be missing), or where the method does not apply
    (`inapplicable`).
    """
    traced = tuple(recording.resolve_epcs(epcs))
    if not traced:
        raise RecordingError(
            f"{recording.name}: no tag to trace: the recording holds no read, or epcs is empty. Name a tag that was read."
        )
    recording.check(depth=False)
    reason = tracer.inapplicable(recording)
    if reason is not None:
        raise RecordingError(f"{recording.name}: {type(tracer).__name__} does not apply: {reason}")
    camera = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m, np.float64), traced)
    state = tracer.init(camera)
    for frame in host_frames(recording, traced, frames, depth=tracer.needs_depth):
        state, trace = tracer.step(camera, state, frame)
        yield frame.number, jax.tree.map(np.asarray, trace)


def trace_from_detections(detections: Sequence[Detection | None], shape: tuple[int, int]) -> Trace:
    """The `Trace` of one frame from each tag's detection; None is a tag without one, with an empty mask.

    `found` is true for every detection with a mask that is not empty, whatever its confidence.
    """
    num_tags = len(detections)
    mask = np.zeros((num_tags, *shape), np.float32)
    box, centre = np.zeros((num_tags, 4), np.float32), np.zeros((num_tags, 2), np.float32)
    position = np.zeros((num_tags, 3), np.float32)
    step, confidence = np.zeros(num_tags, np.float32), np.zeros(num_tags, np.float32)
    found = np.zeros(num_tags, bool)
    for tag, detection in enumerate(detections):
        if detection is None:
            continue
        rows, columns = np.nonzero(detection.mask)
        if not len(rows):
            continue
        mask[tag] = detection.mask
        tight = (columns.min(), rows.min(), columns.max(), rows.max())
        box[tag] = tight if detection.box_px is None else detection.box_px
        centre[tag] = columns.mean(), rows.mean()
        position[tag], step[tag] = detection.centre_m, detection.step_m
        confidence[tag], found[tag] = detection.confidence, True
    # Masks are large and read on the host: they stay there even if an accelerator is the default device.
    with jax.default_device(jax.devices("cpu")[0]):
        return Trace(
            mask=jnp.asarray(mask),
            box_px=jnp.asarray(box),
            centre_px=jnp.asarray(centre),
            centre_m=jnp.asarray(position),
            step_m=jnp.asarray(step[:, None]),
            confidence=jnp.asarray(confidence),
            detected=jnp.asarray(found),
        )
