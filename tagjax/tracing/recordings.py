"""Run a tracer over a whole recording, frame by frame, in memory that does not grow with it."""

from __future__ import annotations

import dataclasses
import tempfile
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..radio.reads import RadioWindow
from ..recording import Recording, RecordingError, RecordingWarning
from ..recording.time_reversal import time_reversed
from .tracer import AbstractSmoother, AbstractTracer, Camera, Frame, Trace

CAMERA_MOVED = (
    "the camera moved {}: nearly all of the static background shows another depth. Tracing goes on, but what the camera's "
    "own motion adds is taken for motion of objects. Keep the camera at rest."
)


@dataclasses.dataclass(frozen=True)
class TraceSettings:
    """How much of a recording is traced at once, and whether later frames are used."""

    tags_at_once: int = 6
    frames_at_once: int = 48
    smooth: bool = False  # offline (two-pass) smoothing: takes twice the time, and the whole recording

    def __post_init__(self) -> None:
        for name in ("tags_at_once", "frames_at_once"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least 1.")


@eqx.filter_jit
def _init(tracer: AbstractTracer, camera: Camera, frame: Frame) -> Any:
    return tracer.init(camera, frame)


@eqx.filter_jit
def _step_back(tracer: AbstractSmoother, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Any]:
    state, message = tracer.backward_step(camera, state, frame)
    return state, tracer.compact(message)


@eqx.filter_jit
def _step(tracer: AbstractTracer, camera: Camera, state: Any, frame: Frame) -> tuple[Any, Trace]:
    return tracer.step(camera, state, frame)


def _tags(frame: Frame, first: int, size: int) -> Frame:
    """One frame (leading time axis kept) with `size` of the tags; places beyond the last tag have no valid read."""
    num_tags = frame.radio.std_m.shape[1]
    chosen = np.arange(first, first + size)
    there = chosen < num_tags
    pick = lambda leaf: leaf[:, chosen.clip(max=num_tags - 1)]  # noqa: E731
    radio, reads = jax.tree.map(pick, frame.radio), jax.tree.map(pick, frame.reads)
    exists = there[None, :, None, None]
    radio = RadioWindow(jnp.where(exists, radio.relative_m, 0.0), jnp.where(exists, radio.std_m, jnp.inf))
    reads = eqx.tree_at(lambda one: one.valid, reads, reads.valid & exists)
    frame = eqx.tree_at(lambda f: (f.radio, f.reads), frame, (radio, reads))
    if frame.arrivals is None or frame.present is None:
        return frame
    number = frame.arrivals.tag - first
    own = frame.arrivals.valid & (number >= 0) & (number < size)
    arrivals = eqx.tree_at(lambda a: (a.tag, a.valid), frame.arrivals, (jnp.where(own, number, 0), own))
    present = pick(frame.present) & there[None]
    return eqx.tree_at(lambda f: (f.arrivals, f.present), frame, (arrivals, present))


def trace_recording(
    tracer: AbstractTracer,
    recording: Recording,
    load: Callable[..., Any],
    *,
    epcs: Sequence[str],
    settings: TraceSettings | None = None,
    frames: tuple[int, int] | None = None,
) -> Iterator[tuple[int, Trace]]:
    """Every frame's number and `Trace` (NumPy leaves, tag axis in the order of `epcs`), frame by frame.

    `load(recording, start, stop, epcs=...)` returns a `Clip`. Pieces of `frames_at_once` frames are loaded one after
    the other and the tracer's state is carried across them, so that memory does not grow with the recording. Tags are
    traced in groups of `tags_at_once`; the last group is padded with tags without reads, so that one compilation serves
    all groups. Tags compete for pixels within their group.

    With `smooth` in the settings a backward pass runs first and the trace of a frame uses later frames too; its messages are
    kept in a temporary file, in the types of `AbstractSmoother.compact`. Raises `RecordingError` for a tracer that is no `AbstractSmoother`.
    """
    settings = settings or TraceSettings()
    first, last = frames or (0, recording.num_frames)
    if not 0 <= first < last <= recording.num_frames:
        raise RecordingError(
            f"{recording.name}: frames {first} to {last} asked for; expected a part of 0 to {recording.num_frames}."
        )
    if not epcs:
        raise RecordingError(f"{recording.name}: no tag to trace: the recording holds no read, or epcs is empty.")
    messages: Callable[[int], list[Any]] | None = None
    if settings.smooth:
        if not isinstance(tracer, AbstractSmoother):
            raise RecordingError(
                f"smooth: {type(tracer).__name__} has no backward pass; expected TagAttention. Set scores.smooth=false."
            )
        messages = _backward_pass(tracer, recording, load, epcs, settings, (first, last))
    for number, outputs in run_tracer(_step, tracer, recording, load, epcs, settings, (first, last), messages):
        yield number, jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(epcs)], *outputs)


def run_tracer(
    step: Callable[..., tuple[Any, Any]],
    tracer: AbstractTracer,
    recording: Recording,
    load: Callable[..., Any],
    epcs: Sequence[str],
    settings: TraceSettings,
    frames: tuple[int, int],
    messages: Callable[[int], list[Any]] | None = None,
) -> Iterator[tuple[int, list[Any]]]:
    """Every frame's number, and the output of `step` for each group of tags (NumPy leaves).

    `step(tracer, camera, state, frame)` returns the next state and the output; the first state is `tracer.init`.
    `messages` gives those of the backward pass by frame, for each group.
    """
    first, last = frames
    size = min(settings.tags_at_once, len(epcs))
    groups = range(0, len(epcs), size)
    states: list[Any] = [None] * len(groups)
    moved = False
    for start in range(first, last, settings.frames_at_once):
        stop = min(start + settings.frames_at_once, last)
        overlap = int(start > first)  # the first frame of a clip has no flow: load it with the frame before
        clip = load(recording, start - overlap, stop, epcs=list(epcs))
        parts = [_tags(clip.frames, group, size) for group in groups]
        for index in range(overlap, stop - start + overlap):
            outputs = []
            known = messages(start - overlap + index) if messages is not None else None
            for number, part in enumerate(parts):
                frame = jax.tree.map(lambda leaf, i=index: jnp.asarray(leaf[i]), part)
                if known is not None:
                    message = jax.tree.map(_restored, known[number])
                    frame = eqx.tree_at(
                        lambda one: one.backward_message, frame, message, is_leaf=lambda leaf: leaf is None
                    )
                if states[number] is None:
                    states[number] = _init(tracer, clip.camera, frame)
                states[number], out = step(tracer, clip.camera, states[number], frame)
                outputs.append(jax.tree.map(np.asarray, out))
            yield start - overlap + index, outputs
        moved = moved or _warn_of_motion(tracer, states[0], recording.name, stop)


def _warn_of_motion(tracer: AbstractTracer, state: Any, name: str, stop: int) -> bool:
    """Warn where the camera has moved; whether it has."""
    flag = tracer.camera_moved(state)
    if flag is None or not bool(flag):
        return False
    warnings.warn(f"{name}: {CAMERA_MOVED.format(f'before frame {stop}')}", RecordingWarning, stacklevel=4)
    return True


def _restored(leaf: np.ndarray) -> jax.Array:
    return jnp.asarray(leaf, jnp.float32 if np.issubdtype(leaf.dtype, np.floating) else leaf.dtype)


def _backward_pass(
    tracer: AbstractSmoother,
    recording: Recording,
    load: Callable[..., Any],
    epcs: Sequence[str],
    settings: TraceSettings,
    frames: tuple[int, int],
) -> Callable[[int], list[Any]]:
    """Run the backward pass; the returned function gives the messages for a frame by its number, one a group of tags."""
    count, (first, last) = recording.num_frames, frames
    rows: np.ndarray | None = None
    tree: Any = None
    for number, outputs in run_tracer(
        _step_back, tracer, time_reversed(recording), load, epcs, settings, (count - last, count - first)
    ):
        leaves, tree = jax.tree.flatten(outputs)
        if rows is None:
            row = np.dtype([(f"leaf_{index}", leaf.dtype, leaf.shape) for index, leaf in enumerate(leaves)])
            with tempfile.TemporaryFile() as file:  # unnamed: deleted together with the array
                rows = np.memmap(file, row, "w+", shape=(last - first,))
        for name, leaf in zip(rows.dtype.names or (), leaves, strict=True):
            rows[name][count - 1 - number - first] = leaf

    def messages(frame: int) -> list[Any]:
        assert rows is not None
        return jax.tree.unflatten(tree, [rows[name][frame - first] for name in rows.dtype.names or ()])

    return messages
