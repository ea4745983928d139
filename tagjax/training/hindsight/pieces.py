"""Pieces of recordings as the tracer's learned stages see them: segments, reads, and the masks of the smoother."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ...radio.arrivals import Arrivals
from ...radio.reads import RadioWindow
from ...recording import Recording, TagReads
from ...tagattention.segments import SegmentFrame, TagAttention
from ...tagattention.segments.outline import filled_labels
from ...tagattention.segments.state import last_s
from ...tracing.recordings import TraceSettings, run_tracer
from ...tracing.tracer import Camera, Frame
from .control import ControlReads, control_reads
from .teachers import Teacher, smoother_masks, true_masks

_FRAMES = 32
"""Pieces are padded to a multiple of so many frames, so that few programs are compiled."""


class PieceFrames(eqx.Module):
    """Frames in a row. Those behind the end hold no tag."""

    time_s: Float[Array, " time"]
    depth_m: Float[Array, "time height width"]
    found: SegmentFrame  # (time,)
    arrivals: Arrivals  # (time, reads)
    radio: RadioWindow  # (time, tag, antenna, window)
    present: Bool[Array, "time tag"]
    target: Float[Array, "time tag segment"]  # the part of the segment that lies in the teacher's mask
    confidence: Float[Array, "time tag"]  # of the teacher
    control: ControlReads | None = None  # (time,)

    def of_control(self) -> PieceFrames:
        """The same frames with the control's reads, which agree with no mask. Raises `ValueError` where there are none."""
        if self.control is None:
            raise ValueError("found a piece without control reads; expected one of `PieceFiles.made(controls=True)`.")
        nothing = RadioWindow(jnp.zeros_like(self.radio.relative_m), jnp.full_like(self.radio.std_m, jnp.inf))
        return dataclasses.replace(
            self,
            arrivals=self.control.arrivals,
            radio=nothing,
            present=self.control.present,
            target=jnp.zeros_like(self.target),
            confidence=jnp.zeros_like(self.confidence),
            control=None,
        )


@dataclasses.dataclass(frozen=True)
class Piece:
    """A piece of a recording, for a training step."""

    camera: Camera
    frames: PieceFrames
    name: str  # of the recording
    start: int  # its first frame
    num_frames: int  # without the padding


def frame_of(frames: PieceFrames, num_antennas: int) -> Frame:
    """The tracer's input at one frame (no time axis), without flow."""
    flow = jnp.zeros((*frames.depth_m.shape, 2))
    frame = Frame.of_arrivals(frames.time_s, frames.depth_m, flow, frames.arrivals, frames.present, num_antennas)
    return eqx.tree_at(lambda one: one.radio, frame, frames.radio)


@eqx.filter_jit
def _segments_step(tracer: TagAttention, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Any]:
    dt_s = frame.time_s - last_s(state.tags, frame)
    segments, found = tracer.segments.step(camera, state.segments, frame.depth_m, frame.backward_px, dt_s)
    state = eqx.tree_at(lambda one: (one.segments, one.tags.time_s), state, (segments, frame.time_s))
    filled = filled_labels(found.labels, frame.depth_m)
    return state, (found, filled, frame.time_s, frame.depth_m, frame.arrivals, frame.radio)


def segment_pieces(
    recording: Recording,
    tracer: TagAttention,
    load: Callable[..., Any],
    *,
    epcs: Sequence[str],
    num_frames: int = 256,
    teacher: Teacher = "smoother",
    control: TagReads | None = None,
) -> Iterator[Piece]:
    """The recording in pieces of at most `num_frames` frames of about equal length, in order of time.

    `tracer` gives the segments and, smoothed over the whole recording, the masks to learn from; with `teacher` labels these
    are the true ones. `load` is as in `trace_recording`. The number of tags is padded to a power of two. `control` are reads
    that belong to nothing in the recording.
    """
    if num_frames < 1:
        raise ValueError(f"num_frames is {num_frames}; expected at least 1 frame a piece.")
    settings = TraceSettings(tags_at_once=len(epcs))
    seen = run_tracer(_segments_step, tracer, recording, load, epcs, settings, (0, recording.num_frames))
    count = -(-recording.num_frames // num_frames)
    ends = set(np.linspace(0, recording.num_frames, count + 1).astype(int)[1:].tolist())
    camera = load(recording, 0, 1, epcs=list(epcs)).camera
    if teacher == "labels":
        taught = true_masks(recording, camera.rays.shape[:2], epcs)
    else:
        taught = smoother_masks(tracer, recording, load, epcs)
    strange = None if control is None else control_reads(recording, control, camera, _padded_tags(len(epcs)))
    rows: list[Any] = []
    for (mask, confidence), (number, (outputs,)) in zip(taught, seen, strict=True):
        found, filled, time_s, depth_m, arrivals, radio = outputs
        target = _overlap(mask, filled, found.area.shape[0])
        there = np.ones(len(epcs), bool)
        own = jax.tree.map(lambda leaf, number=number: leaf[number], strange)
        rows.append((time_s, depth_m, found, arrivals, radio, there, target, confidence, own))
        if number + 1 in ends:
            yield Piece(camera, _padded(rows), recording.name, number + 1 - len(rows), len(rows))
            rows = []


def _overlap(mask: np.ndarray, labels: np.ndarray, num_segments: int) -> np.ndarray:
    """Of each segment the part of its pixels that lies in each tag's mask, (tag, segment); 0 for the static background."""
    shown = labels > 0
    of_all = np.bincount(labels[shown], minlength=num_segments)
    of_mask = np.stack([np.bincount(labels[shown & own], minlength=num_segments) for own in mask])
    return (of_mask / np.maximum(of_all, 1)).astype(np.float32)


def _padded(rows: Sequence[Any]) -> PieceFrames:
    """The rows on a time axis, padded: with their last frame, at which then no tag is present and no read arrives."""
    after = -len(rows) % _FRAMES
    stacked = jax.tree.map(lambda *leaves: np.stack([*leaves, *leaves[-1:] * after]), *rows)
    time_s, _, _, arrivals, _, present, _, _, control = stacked
    of_control = [] if control is None else [control.present, control.arrivals.valid]
    for there in (present, arrivals.valid, *of_control):
        there[len(rows) :] = False
    step_s = (time_s[len(rows) - 1] - time_s[0]) / np.float32(max(len(rows) - 1, 1))
    time_s[len(rows) :] += step_s * np.arange(1, after + 1, dtype=np.float32)
    frames = PieceFrames(*jax.tree.map(jnp.asarray, stacked))
    return with_tags(frames, _padded_tags(present.shape[1]))


def with_tags(frames: PieceFrames, num_tags: int) -> PieceFrames:
    """The frames with places for so many tags; those behind its own hold none."""
    more = num_tags - frames.present.shape[1]

    def padded(leaf: Array, fill: float = 0.0) -> Array:
        return jnp.pad(
            leaf, [(0, 0), (0, more), *[(0, 0)] * (leaf.ndim - 2)], constant_values=jnp.asarray(fill, leaf.dtype)
        )

    return dataclasses.replace(
        frames,
        radio=RadioWindow(padded(frames.radio.relative_m), padded(frames.radio.std_m, np.inf)),
        present=padded(frames.present),
        target=padded(frames.target),
        confidence=padded(frames.confidence),
    )


def _padded_tags(num_tags: int) -> int:
    return 1 << (num_tags - 1).bit_length()
