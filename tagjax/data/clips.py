"""Clips: stretches of recordings as device arrays at the working resolution, and the pipeline that draws them."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import grain
import jax
import jax.numpy as jnp
import numpy as np

from ..geometry import pixel_rays, range_to_depth
from ..recording import Recording, RecordingError, RecordingWarning
from ..rf.reads import PhaseReads, RadioWindow
from ..rf.windows import phase_reads, radio_windows, window_reads
from ..tracer import Camera, Frame
from .flow_cache import pair_flow
from .stream import Stream

Estimator = Literal["robust", "paper", "truth"]
"""Of the tags' distances; `truth` takes those of a simulated recording, to tell what the radio costs."""

_TRUTH_STD_M = 1e-3


class Clip(eqx.Module):
    """A stretch of a recording: the camera, and the frames with a leading time axis."""

    camera: Camera
    frames: Frame
    epcs: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    start: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)


def check_clip(*, stride: int = 1, window: int = 2, max_reads: int = 1) -> None:
    """Raise `ValueError` for a stride, a window or a number of reads that no clip can have."""
    for name, found, least, meaning in (
        ("stride", stride, 1, "every n-th pixel is kept"),
        ("window", window, 2, "motion takes two frames"),
        ("max_reads", max_reads, 1, "reads of one tag in a window"),
    ):
        if found < least:
            raise ValueError(f"{name} is {found}; expected at least {least} ({meaning}).")


def choose_antenna(recording: Recording, epcs: Sequence[str], antenna: int | None = None) -> int:
    """The antenna (counted from 1) that distances are to: the given one, or the one with the most reads of the tags.

    Only antennas that `antennas_m` places count, and reads of known carrier before others; of equals the first. It is
    one antenna for all tags, since pixels have one distance. Warns (`RecordingWarning`) of the reads that the other
    antennas made, which are of no use then. Raises `RecordingError` where no antenna is left.
    """
    reads = recording.reads[np.isin(recording.reads.epc, list(epcs))]
    ports, counts = np.unique(reads.antenna, return_counts=True)
    made = ", ".join(f"{count} of antenna {port}" for port, count in zip(ports, counts, strict=True)) or "none"
    num_placed = len(recording.antennas_m)
    if antenna is None:
        placed = [int(port) for port in ports if 1 <= port <= num_placed]
        if not placed:
            raise RecordingError(
                f"{recording.name}: reads: {made}; antennas_m places antennas 1 to {num_placed}. Give all places."
            )
        told = np.isfinite(reads.carrier_hz)
        antenna = max(placed, key=lambda p: (np.sum(told & (reads.antenna == p)), np.sum(reads.antenna == p)))
    elif not 1 <= antenna <= num_placed or antenna not in ports:
        raise RecordingError(
            f"{recording.name}: antenna {antenna} asked for; antennas_m places antennas 1 to {num_placed}, and the tags' "
            f"reads are: {made}. Choose an antenna that has both."
        )
    others = int(np.sum(reads.antenna != antenna))
    if others:
        unread = [epc for epc in epcs if not np.any((reads.epc == epc) & (reads.antenna == antenna))]
        warnings.warn(
            f"{recording.name}: {others} of {reads.num_reads} reads left out (reads: {made}): distances are to antenna "
            f"{antenna}, and another antenna's say nothing of them."
            + (f" Without any read are then: {', '.join(unread)}." if unread else ""),
            RecordingWarning,
            stacklevel=3,
        )
    return antenna


def _thin_depth(depth_m: np.ndarray, stride: int) -> np.ndarray:
    """Every stride-th pixel; where it is missing, the nearest measured one of the cell that it stands for."""
    height, width = depth_m.shape[1:]
    padded = np.pad(depth_m, ((0, 0), (0, -height % stride), (0, -width % stride)))
    cells = padded.reshape(len(depth_m), padded.shape[1] // stride, stride, padded.shape[2] // stride, stride)
    cells = cells.transpose(0, 1, 3, 2, 4).reshape(*cells.shape[:2], padded.shape[2] // stride, stride * stride)
    offset = np.arange(stride)
    order = np.argsort((offset[:, None] ** 2 + offset[None, :] ** 2).reshape(-1), kind="stable")
    ranked = cells[..., order]
    first = np.argmax(ranked > 0, axis=-1)
    return np.take_along_axis(ranked, first[..., None], axis=-1)[..., 0]


def load_clip(
    recording: Recording,
    start: int,
    stop: int,
    *,
    stride: int,
    epcs: Sequence[str] | None = None,
    flow: str = "dis",
    window: int = 5,
    max_reads: int = 64,
    estimator: Estimator = "robust",
    antenna: int | None = None,
    colour: bool = False,
) -> Clip:
    """Frames `start` to `stop` - 1 with the radio of the given tags (all that were read if None).

    `stride` keeps every n-th pixel in both directions. The radio is estimated from the recording's start, causally, so
    that a clip in the middle knows its past. Distances are to one antenna, and the radio uses that antenna's
    reads only (see `choose_antenna`). With `colour` the clip holds its pictures, and zero in place of the flow, which is
    then a network's to make. Raises `RecordingError` for an unknown EPC or antenna and `ValueError` for frames outside
    the recording or settings that no clip can have.
    """
    check_clip(stride=stride, window=window, max_reads=max_reads)
    if not 0 <= start < stop <= recording.num_frames:
        raise ValueError(f"Frames {start} to {stop} asked for; {recording.name} has {recording.num_frames}.")
    named = tuple(recording.resolve_epcs(epcs))
    if not named:
        raise RecordingError(f"{recording.name} holds no tag read: there is nothing to trace.")
    antenna = choose_antenna(recording, named, antenna)
    intrinsics = recording.intrinsics.scaled(stride)
    depth = recording.depth_metres(slice(start, stop))
    if recording.depth_kind == "range":
        depth = range_to_depth(depth, recording.intrinsics)
    depth = _thin_depth(depth, stride)
    if colour:
        forward = backward = np.zeros((*depth.shape, 2), np.float32)
    else:
        forward, backward = (
            ways[:, ::stride, ::stride] / np.float32(stride) for ways in pair_flow(recording, start, stop, flow)
        )
    time_s = jnp.asarray(recording.frame_time_s(), jnp.float32)
    heard = recording.reads.antenna == antenna
    longest = max(int(np.sum((recording.reads.epc == epc) & heard)) for epc in named)
    length = max(256, -(-longest // 256) * 256)
    origin_ns = int(recording.time_ns[0])
    buffers = [phase_reads(recording.reads, epc, origin_ns, length=length, antenna=antenna) for epc in named]
    if estimator == "truth":
        radio = [_true_window(recording, epc, window, antenna) for epc in named]
    else:
        radio = [radio_windows(reads, time_s, window, estimator) for reads in buffers]
    reads = [_window(reads, time_s, window, max_reads) for reads in buffers]

    def per_tag(parts):
        return jax.tree.map(lambda *leaves: jnp.stack([leaf[start:stop] for leaf in leaves], axis=1), *parts)

    return Clip(
        camera=Camera(
            rays=jnp.asarray(pixel_rays(intrinsics)),
            antenna_m=jnp.asarray(recording.antennas_m[antenna - 1], jnp.float32),
        ),
        frames=Frame(
            time_s=time_s[start:stop],
            depth_m=jnp.asarray(depth),
            backward_px=jnp.asarray(backward),
            forward_px=jnp.asarray(forward),
            radio=per_tag(radio),
            reads=per_tag(reads),
            colour=jnp.asarray(recording.colour[start:stop]) if colour else None,
        ),
        epcs=named,
        name=recording.name,
        start=start,
        stop=stop,
    )


def _true_window(recording: Recording, epc: str, num_window: int, antenna: int) -> RadioWindow:
    """The true distances to the antenna, with next to no doubt; unknown ones are infinitely doubtful."""
    truth = recording.truth
    if antenna != 1:
        raise RecordingError(
            f"{recording.name}: estimator=truth, but true ranges are to antenna 1 and the clip's are to antenna {antenna}. "
            "Set antenna=1."
        )
    if truth is None or epc not in truth.tag_range_m:
        there = ", ".join(truth.tag_range_m) if truth is not None else ""
        raise RecordingError(
            f"{recording.name}: estimator=truth needs the true range of {epc}; truth holds that of: {there or 'no tag'}."
        )
    range_m = np.asarray(truth.tag_range_m[epc], np.float64)
    frame = np.arange(recording.num_frames)
    past = np.maximum(frame[:, None] + np.arange(1 - num_window, 1)[None], 0)
    relative = range_m[past] - range_m[past[:, :1]]
    known = np.isfinite(relative).all(axis=1, keepdims=True) & (frame > 0)[:, None]
    std = np.where(np.arange(num_window) > 0, _TRUTH_STD_M, 0.0)[None]
    return RadioWindow(
        jnp.asarray(np.where(known, relative, 0.0), jnp.float32), jnp.asarray(np.where(known, std, np.inf), jnp.float32)
    )


def _window(reads: PhaseReads, time_s: jax.Array, num_window: int, max_reads: int) -> PhaseReads:
    return _window_jit(reads, time_s, num_window, max_reads)


_window_jit = jax.jit(window_reads, static_argnums=(2, 3))


class _ClipSource:
    """Every clip of `length` frames that starts on a multiple of `step`, as Grain's random access source."""

    def __init__(self, recordings: Sequence[Recording], length: int, step: int, on_host: bool, **settings):
        self._recordings, self._length, self._settings = list(recordings), length, settings
        self._on_host = on_host  # NumPy arrays, which one process can hand to another
        self._places = [
            (number, start)
            for number, recording in enumerate(recordings)
            for start in range(0, recording.num_frames - length + 1, step)
        ]
        if not self._places:
            longest = max((recording.num_frames for recording in recordings), default=0)
            raise RecordingError(
                f"No clip of {length} frames in {len(self._recordings)} recordings (the longest has {longest} frames). "
                "Ask for shorter clips or give longer recordings."
            )

    def __len__(self) -> int:
        return len(self._places)

    def __getitem__(self, index) -> Clip:
        number, start = self._places[int(index)]
        clip = load_clip(self._recordings[number], start, start + self._length, **self._settings)
        return jax.tree.map(np.asarray, clip) if self._on_host else clip


def _on_device(clip: Clip) -> Clip:
    return jax.tree.map(jnp.asarray, clip)


def clip_dataset(
    recordings: Sequence[Recording],
    *,
    clip_length: int,
    stride: int,
    seed: int,
    epcs: Sequence[str] | None = None,
    flow: str = "dis",
    window: int = 5,
    max_reads: int = 64,
    estimator: Estimator = "robust",
    antenna: int | None = None,
    colour: bool = False,
    step: int | None = None,
    workers: int = 0,
    share: tuple[int, int] = (0, 1),
) -> Stream:
    """An endless, shuffled stream of clips; the same seed gives the same order.

    Its iterator's `get_state` and `set_state` resume exactly. Clips begin on multiples of `step` (half a clip if None).
    With `workers` as many processes load them, radio included, and this one only takes them to its device; `share`
    (i, n) is every n-th clip from the i-th on. Raises `RecordingError` if no recording is as long as a clip, `ValueError`
    for settings that no clip can have.
    """
    check_clip(stride=stride, window=window, max_reads=max_reads)
    for name, found in (("clip_length", clip_length), ("step", 1 if step is None else step)):
        if found < 1:
            raise ValueError(f"{name} is {found}; expected at least 1 frame.")
    source = _ClipSource(
        recordings,
        clip_length,
        step or max(1, clip_length // 2),
        workers > 0,
        stride=stride,
        epcs=epcs,
        flow=flow,
        window=window,
        max_reads=max_reads,
        estimator=estimator,
        antenna=antenna,
        colour=colour,
    )
    dataset = grain.MapDataset.source(source).shuffle(seed=seed).repeat()
    return Stream(dataset, workers=workers, share=share, finish=_on_device if workers else None)
