"""Clips: stretches of recordings as device arrays at the working resolution, and the pipeline that draws them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import grain
import jax
import jax.numpy as jnp
import numpy as np

from ..geometry import pixel_rays, range_to_depth
from ..recording import Recording, RecordingError
from ..rf.reads import PhaseReads
from ..rf.windows import phase_reads, radio_windows, window_reads
from ..tracer import Camera, Frame
from .flow_cache import pair_flow

Estimator = Literal["robust", "paper"]


class Clip(eqx.Module):
    """A stretch of a recording: the camera, and the frames with a leading time axis."""

    camera: Camera
    frames: Frame
    epcs: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    start: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)


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
) -> Clip:
    """Frames `start` to `stop` - 1 with the radio of the given tags (all that were read if None).

    `stride` keeps every n-th pixel in both directions. The radio is estimated from the recording's start, causally, so
    that a clip in the middle knows its past. Distances are to the antenna of the first read. Raises `RecordingError`
    for an unknown EPC and `ValueError` for frames outside the recording.
    """
    if not 0 <= start < stop <= recording.num_frames:
        raise ValueError(f"Frames {start} to {stop} asked for; {recording.name} has {recording.num_frames}.")
    named = tuple(recording.resolve_epcs(epcs))
    if not named:
        raise RecordingError(f"{recording.name} holds no tag read: there is nothing to trace.")
    intrinsics = recording.intrinsics.scaled(stride)
    depth = recording.depth_metres(slice(start, stop))
    if recording.depth_kind == "range":
        depth = range_to_depth(depth, recording.intrinsics)
    forward, backward = (
        ways[:, ::stride, ::stride] / np.float32(stride) for ways in pair_flow(recording, start, stop, flow)
    )
    time_s = jnp.asarray(recording.frame_time_s(), jnp.float32)
    longest = max(int(np.sum(recording.reads.epc == epc)) for epc in named)
    length = max(256, -(-longest // 256) * 256)
    buffers = [phase_reads(recording.reads, epc, int(recording.time_ns[0]), length=length) for epc in named]
    radio = [radio_windows(reads, time_s, window, estimator) for reads in buffers]
    reads = [_window(reads, time_s, window, max_reads) for reads in buffers]

    def per_tag(parts):
        return jax.tree.map(lambda *leaves: jnp.stack([leaf[start:stop] for leaf in leaves], axis=1), *parts)

    antenna = int(recording.reads.antenna[0]) - 1
    return Clip(
        camera=Camera(
            rays=jnp.asarray(pixel_rays(intrinsics)), antenna_m=jnp.asarray(recording.antennas_m[antenna], jnp.float32)
        ),
        frames=Frame(
            time_s=time_s[start:stop],
            depth_m=jnp.asarray(_thin_depth(depth, stride)),
            backward_px=jnp.asarray(backward),
            forward_px=jnp.asarray(forward),
            radio=per_tag(radio),
            reads=per_tag(reads),
        ),
        epcs=named,
        name=recording.name,
        start=start,
        stop=stop,
    )


def _window(reads: PhaseReads, time_s: jax.Array, num_window: int, max_reads: int) -> PhaseReads:
    return _window_jit(reads, time_s, num_window, max_reads)


_window_jit = jax.jit(window_reads, static_argnums=(2, 3))


class _ClipSource:
    """Every clip of `length` frames that starts on a multiple of `step`, as Grain's random access source."""

    def __init__(self, recordings: Sequence[Recording], length: int, step: int, **settings):
        self._recordings, self._length, self._settings = list(recordings), length, settings
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
        return load_clip(self._recordings[number], start, start + self._length, **self._settings)


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
    step: int | None = None,
) -> grain.IterDataset:
    """An endless, shuffled stream of clips; the same seed gives the same order.

    Its iterator's `get_state` and `set_state` resume exactly. Clips begin on multiples of `step` (half a clip if None).
    """
    source = _ClipSource(
        recordings,
        clip_length,
        step or max(1, clip_length // 2),
        stride=stride,
        epcs=epcs,
        flow=flow,
        window=window,
        max_reads=max_reads,
    )
    dataset = grain.MapDataset.source(source).shuffle(seed=seed).repeat()
    return dataset.to_iter_dataset(grain.ReadOptions(num_threads=1, prefetch_buffer_size=2))
