"""Tracers that run on the host: OpenCV detects and follows, so there is no `lax.scan`, but the contract is the same.

`AbstractHostTracer` is a state machine as `AbstractTracer` is: `init`, one `step` a frame, `finish`. It sees pictures
instead of flow and depth (none of the forerunners has a depth camera), the raw reads instead of distances, and says a
`Trace` at the picture's full size. `host_trace` yields what `evaluation.evaluate.trace_recording` does, so both kinds
are scored by the same code. Everything is causal: at a frame the reads up to that frame are known, and no later one.
"""

from __future__ import annotations

import abc
import dataclasses
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Shaped, UInt8

from ..recording import Intrinsics, Recording, RecordingError, TagReads
from ..tracing.tracer import Trace


@dataclasses.dataclass(frozen=True)
class HostCamera:
    """What is fixed in a recording: the camera, the antennas (camera frame), and the tags asked for, in their order."""

    intrinsics: Intrinsics
    antennas_m: Float[np.ndarray, "antennas 3"]
    epcs: tuple[str, ...]


@dataclasses.dataclass(frozen=True)
class HostFrame:
    """One picture, and the reads of the tags asked for that came after the frame before, up to this one."""

    number: int
    time_s: float  # from the recording's first frame
    colour: UInt8[np.ndarray, "height width 3"]
    reads: TagReads  # of all tags asked for, in order of time
    read_time_s: Float[np.ndarray, " reads"]  # of those reads, from the recording's first frame


@dataclasses.dataclass(frozen=True)
class Claim:
    """Where one tag is said to be at one frame. Pixels are the full picture's; places are in the camera frame."""

    mask: Bool[np.ndarray, "height width"]
    centre_m: Shaped[np.ndarray, " 3"]  # NaN where the method knows no place
    confidence: float  # 0 to 1
    box_px: Shaped[np.ndarray, " 4"] | None = None  # x0 y0 x1 y1, inclusive; the mask's own if None
    step_m: float = 0.0  # change of the distance to the antenna since the last frame, 0 where the method has none


class AbstractHostTracer(abc.ABC):
    """A tracing system on the host as a state machine: `init`, one `step` a frame, `finish`."""

    @abc.abstractmethod
    def inapplicable(self, recording: Recording) -> str | None:
        """Why the method's assumptions do not hold for a recording, in a sentence for a table's cell; None if they do."""

    @abc.abstractmethod
    def init(self, camera: HostCamera) -> Any:
        """The state before the first frame."""

    @abc.abstractmethod
    def step(self, camera: HostCamera, state: Any, frame: HostFrame) -> tuple[Any, Trace]:
        """The next state, and the `Trace` of this frame (`claims_to_trace` makes one); the given state stays as it is."""

    @abc.abstractmethod
    def finish(self, state: Any) -> Any:
        """The state handed on to whoever continues the recording: nothing in it refers to a past frame's buffer."""


def host_frames(
    recording: Recording, epcs: Sequence[str], frames: tuple[int, int] | None = None
) -> Iterator[HostFrame]:
    """The frames `first` to `last` - 1 with their reads. The first one brings every read from the recording's start.

    Raises `RecordingError` for frames outside the recording.
    """
    first, last = frames or (0, recording.num_frames)
    if not 0 <= first < last <= recording.num_frames:
        raise RecordingError(
            f"{recording.name}: frames {first} to {last} asked for; expected a part of 0 to {recording.num_frames}."
        )
    own = recording.reads[np.isin(recording.reads.epc, list(epcs))]
    read_time_s = (own.time_ns - recording.time_ns[0]) * 1e-9
    # Reads from before the camera ran are kept: phases count from there.
    until = np.searchsorted(own.time_ns, recording.time_ns, side="right")
    begin = 0
    for number in range(first, last):
        part = slice(begin, int(until[number]))
        begin = int(until[number])
        yield HostFrame(
            number=number,
            time_s=float((recording.time_ns[number] - recording.time_ns[0]) * 1e-9),
            colour=np.asarray(recording.colour[number]),
            reads=own[part],
            read_time_s=read_time_s[part],
        )


def host_trace(
    tracer: AbstractHostTracer,
    recording: Recording,
    *,
    epcs: Sequence[str] | None = None,
    frames: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Trace]]:
    """Run a host tracer over a recording: every frame's number and `Trace` (NumPy leaves, tags in the order of `epcs`).

    One frame at a time, so that no masks pile up. Raises `RecordingError` where there is no tag, for a recording that
    `Recording.check` refuses (depth may be missing), or where the method cannot apply; the message is `inapplicable`'s.
    """
    named = tuple(recording.resolve_epcs(epcs))
    if not named:
        raise RecordingError(f"{recording.name}: no tag to trace. The recording holds no read, or epcs is empty.")
    recording.check(depth=False)
    reason = tracer.inapplicable(recording)
    if reason is not None:
        raise RecordingError(f"{recording.name}: {type(tracer).__name__} does not apply: {reason}")
    camera = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m, np.float64), named)
    state = tracer.init(camera)
    for frame in host_frames(recording, named, frames):
        state, said = tracer.step(camera, state, frame)
        yield frame.number, jax.tree.map(np.asarray, said)


def joined_reads(parts: Sequence[TagReads]) -> TagReads:
    """Reads of a row of frames in one, with the settings of the last; a column that any of them lacks is left out."""
    if not parts:
        return TagReads.empty()
    last = parts[-1]
    columns: dict[str, Any] = {}
    for field in dataclasses.fields(last):
        values = [getattr(part, field.name) for part in parts]
        if isinstance(values[-1], np.ndarray):
            whole = all(isinstance(value, np.ndarray) for value in values)
            columns[field.name] = np.concatenate(values) if whole else None
    return dataclasses.replace(last, **columns)


def claims_to_trace(claims: Sequence[Claim | None], shape: tuple[int, int]) -> Trace:
    """The `Trace` of one frame from each tag's claim; None is a tag that is not found, with an empty mask.

    `found` says that there is a claim with a mask that is not empty, however low its confidence.
    """
    num_tags = len(claims)
    mask = np.zeros((num_tags, *shape), np.float32)
    box, centre = np.zeros((num_tags, 4), np.float32), np.zeros((num_tags, 2), np.float32)
    place = np.zeros((num_tags, 3), np.float32)
    step, confidence = np.zeros(num_tags, np.float32), np.zeros(num_tags, np.float32)
    found = np.zeros(num_tags, bool)
    for tag, claim in enumerate(claims):
        if claim is None:
            continue
        rows, columns = np.nonzero(claim.mask)
        if not len(rows):
            continue
        mask[tag] = claim.mask
        tight = (columns.min(), rows.min(), columns.max(), rows.max())
        box[tag] = tight if claim.box_px is None else claim.box_px
        centre[tag] = columns.mean(), rows.mean()
        place[tag], step[tag], confidence[tag], found[tag] = claim.centre_m, claim.step_m, claim.confidence, True
    # Masks are large and read on the host: they stay there even if an accelerator is the default.
    with jax.default_device(jax.devices("cpu")[0]):
        return Trace(*(jnp.asarray(x) for x in (mask, box, centre, place, step[:, None], confidence, found)))
