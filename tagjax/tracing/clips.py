"""Clips: parts of recordings as device arrays at the working resolution."""

from __future__ import annotations

import dataclasses
import threading
import warnings
from collections.abc import Callable, Sequence
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from ..core.camera import working_stride
from ..core.geometry import pixel_rays, range_to_depth
from ..core.settings import ConfigError
from ..flow.cache import pair_flow
from ..radio.reads import PhaseReads, RadioWindow
from ..recording import Recording, RecordingError, RecordingWarning
from .arrivals import frame_arrivals
from .range_windows import host_reads, radio_windows, window_reads
from .tracer import Camera, Frame

Estimator = Literal["robust", "published", "published_causal", "literal", "truth"]
"""Range estimator; `truth` uses the true ranges of a simulated recording, to measure what radio errors cost."""

Antennas = tuple[int, ...] | Literal["all", "busiest"]
"""Antennas whose reads are used: numbers from 1, all that have a position, or the one with the most reads."""

_TRUTH_STD_M = 1e-3
MAX_ARRIVALS = 64
"""Reads of one frame that are used; a reader makes some 1,100 a second at most."""


_one_radio_at_a_time = threading.Lock()
"""On two cores two concurrent XLA calls can deadlock, each waiting for a thread of the pool that the other holds."""


class Clip(eqx.Module):
    """A part of a recording: the camera, and the frames with a leading time axis."""

    camera: Camera
    frames: Frame
    epcs: tuple[str, ...] = eqx.field(static=True)
    name: str = eqx.field(static=True)
    start: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)


def check_clip(*, stride: int | None = 1, window: int = 2, max_reads: int = 1) -> None:
    """Raise `ValueError` for a stride, a window or a number of reads that no clip can have."""
    for name, value, minimum, meaning in (
        ("stride", stride, 1, "every n-th pixel is kept"),
        ("window", window, 2, "motion needs two frames"),
        ("max_reads", max_reads, 1, "reads of one tag in a window"),
    ):
        if value is not None and value < minimum:
            raise ValueError(f"{name} is {value}; expected at least {minimum} ({meaning}).")


def window_frames(seconds: float, frame_rate_hz: float) -> int:
    """The number of frames of a motion vector over a time: at least 2, and 2 where the frame rate is unknown."""
    return max(2, 1 + round(seconds * frame_rate_hz)) if np.isfinite(frame_rate_hz) else 2


def choose_antennas(recording: Recording, epcs: Sequence[str], antennas: Antennas = "all") -> tuple[int, ...]:
    """The antennas (counted from 1) to which ranges are measured: the given ones, all, or the busiest, with the most reads.

    "all" are the antennas that have a position in `antennas_m` and have read one of the tags. A given antenna must have a
    position and have read any tag. "busiest" compares the counts of reads with known carrier first; of equal antennas it
    takes the first. Warns (`RecordingWarning`) with the number of reads that are then unused. Raises `RecordingError` where no
    antenna is left.
    """
    reads = recording.reads[np.isin(recording.reads.epc, list(epcs))]
    ports, counts = np.unique(reads.antenna, return_counts=True)
    made = ", ".join(f"{count} of antenna {port}" for port, count in zip(ports, counts, strict=True)) or "none"
    num_placed = len(recording.antennas_m)
    placed = tuple(int(port) for port in ports if 1 <= port <= num_placed)
    if antennas in ("all", "busiest"):
        if not placed:
            raise RecordingError(
                f"{recording.name}: found reads: {made}; antennas_m holds positions of antennas 1 to {num_placed}. "
                "Give the positions of all antennas."
            )
        known = np.isfinite(reads.carrier_hz)
        busiest = max(placed, key=lambda p: (np.sum(known & (reads.antenna == p)), np.sum(reads.antenna == p)))
        chosen = placed if antennas == "all" else (busiest,)
    else:
        chosen = antennas
        active = {port for port in np.unique(recording.reads.antenna).tolist() if 1 <= port <= num_placed}
        if not chosen or len(set(chosen)) < len(chosen) or not set(chosen) <= active:
            raise RecordingError(
                f"{recording.name}: found antennas={list(chosen)}; antennas_m holds positions of antennas 1 to "
                f"{num_placed}, and antennas {', '.join(map(str, sorted(active))) or 'none'} of these made reads (of the chosen tags: {made}). "
                "Choose antennas that have both, each once."
            )
    used = np.isin(reads.antenna, chosen)
    if not used.all():
        unread = [epc for epc in epcs if not np.any((reads.epc == epc) & used)]
        warnings.warn(
            f"{recording.name}: {np.sum(~used)} of {reads.num_reads} reads are unused (reads: {made}): ranges are measured to "
            f"antenna {', '.join(map(str, chosen))}. "
            + (
                f"antennas_m holds positions of antennas 1 to {num_placed}: add those of the others."
                if antennas == "all"
                else "`antennas=all` uses every antenna that has a position."
            )
            + (f" No read is left of: {', '.join(unread)}." if unread else ""),
            RecordingWarning,
            stacklevel=3,
        )
    return chosen


def selected_tags(recording: Recording, epcs: Sequence[str] | None) -> tuple[str, ...]:
    """The tags to trace: all that were read if None. Raises `RecordingError` if there is none, or one was never read."""
    try:
        selected = tuple(recording.resolve_epcs(epcs))
    except RecordingError as error:
        raise RecordingError(f"{recording.name}: {error}") from error
    if not selected:
        raise RecordingError(f"{recording.name} holds no tag read: there is nothing to trace.")
    return selected


def subsampled_depth(depth_m: np.ndarray, stride: int) -> np.ndarray:
    """Every stride-th pixel; where its depth is missing, the nearest valid one of its stride x stride cell, or 0."""
    out = np.zeros((len(depth_m), *(-(-size // stride) for size in depth_m.shape[1:])), depth_m.dtype)
    for down, right in sorted(np.ndindex(stride, stride), key=lambda place: place[0] ** 2 + place[1] ** 2):
        one = depth_m[:, down::stride, right::stride]
        place = out[:, : one.shape[1], : one.shape[2]]
        np.copyto(place, one, where=(place == 0) & (one > 0) & (one < np.inf))
    return out


def load_clip(
    recording: Recording,
    start: int,
    stop: int,
    *,
    stride: int | None = None,
    epcs: Sequence[str] | None = None,
    flow: str = "dis",
    window: int = 5,
    window_s: float | None = None,
    max_reads: int = 64,
    estimator: Estimator = "robust",
    antennas: Antennas = "all",
    colour: bool = False,
) -> Clip:
    """Frames `start` to `stop` - 1 with the radio of the given tags (all that were read if None).

    `stride` keeps every n-th pixel in both directions, None about 256 columns (`working_stride`). A motion vector has
    `window` frames, or as many as cover `window_s`
    seconds at the recording's frame rate. Ranges are estimated causally from the recording's start, so that
    a clip in the middle uses the reads before it. The constants of the reader (probability of pi flips, slope and spread
    of the channel offsets, mean carrier: `radio_model`) are fitted to all reads of the tag. `antennas` chooses the
    antennas (see `choose_antennas`). With `colour` the clip holds the pictures, and zeros in place of the flow, which
    a network then computes. Raises `RecordingError` for an unknown EPC or antenna or a recording without depth, and
    `ValueError` for frames outside the recording or settings that no clip can have.
    """
    window = window if window_s is None else window_frames(window_s, recording.frame_rate_hz)
    check_clip(stride=stride, window=window, max_reads=max_reads)
    stride = working_stride(recording.intrinsics.width, stride)
    if not 0 <= start < stop <= recording.num_frames:
        raise ValueError(f"Frames {start} to {stop} asked for; {recording.name} has {recording.num_frames}.")
    tags = selected_tags(recording, epcs)
    chosen = choose_antennas(recording, tags, antennas)
    intrinsics = recording.intrinsics.scaled(stride)
    depth = recording.depth_metres(slice(start, stop))
    if not np.any(depth):  # single frames may lack depth, a whole recording may not
        recording.check_has_depth()
    if recording.depth_kind == "range":
        depth = range_to_depth(depth, recording.intrinsics)
    depth = subsampled_depth(depth, stride)
    if colour:
        forward = backward = np.zeros((*depth.shape, 2), np.float32)
    else:
        forward, backward = (
            ways[:, ::stride, ::stride] / np.float32(stride) for ways in pair_flow(recording, start, stop, flow)
        )
    time_s = jnp.asarray(recording.frame_time_s(), jnp.float32)
    counts = [np.sum((recording.reads.epc == epc) & (recording.reads.antenna == a)) for epc in tags for a in chosen]
    length = max(256, -(-int(max(counts)) // 256) * 256)
    origin_ns = int(recording.time_ns[0])

    def radio_of(epc: str, antenna: int) -> tuple[RadioWindow, PhaseReads]:
        buffer = host_reads(recording.reads, epc, origin_ns, length=length, antenna=antenna)
        with _one_radio_at_a_time:
            if estimator == "truth":
                radio = _true_window(recording, epc, window, antenna)
            else:
                radio = radio_windows(buffer, time_s, window, estimator)
            both = radio, _window_reads(buffer, time_s, window, max_reads)
            return jax.tree.map(lambda leaf: np.asarray(leaf)[start:stop], both)

    def stacked(parts):
        return jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *parts)

    # A read at the very time of a frame is one of that frame's, also where time is reversed: not one after it.
    until_ns = recording.time_ns - int(recording.reversed_from is not None)
    since_ns = int(until_ns[start - 1]) if start else None
    arrivals, _ = frame_arrivals(
        recording.reads, tags, chosen, until_ns[start:stop], origin_ns, MAX_ARRIVALS, since_ns=since_ns
    )
    radio, reads = jax.tree.map(jnp.asarray, stacked([stacked([radio_of(e, a) for a in chosen]) for e in tags]))
    return Clip(
        camera=Camera(
            rays=jnp.asarray(pixel_rays(intrinsics)),
            antennas_m=jnp.asarray(recording.antennas_m[np.array(chosen) - 1], jnp.float32),
        ),
        frames=Frame(
            time_s=time_s[start:stop],
            depth_m=jnp.asarray(depth),
            backward_px=jnp.asarray(backward),
            forward_px=jnp.asarray(forward),
            radio=radio,
            reads=reads,
            arrivals=jax.tree.map(jnp.asarray, arrivals),
            present=jnp.ones((stop - start, len(tags)), bool),
            colour=jnp.asarray(recording.colour[start:stop]) if colour else None,
        ),
        epcs=tags,
        name=recording.name,
        start=start,
        stop=stop,
    )


def _true_window(recording: Recording, epc: str, num_window: int, antenna: int) -> RadioWindow:
    """True ranges to the antenna with a standard deviation of 1 mm; infinite where the range is unknown."""
    range_m = true_range_m(recording, epc, antenna)
    frame = np.arange(recording.num_frames)
    past = np.maximum(frame[:, None] + np.arange(1 - num_window, 1)[None], 0)
    relative = range_m[past] - range_m[past[:, :1]]
    known = np.isfinite(relative).all(axis=1, keepdims=True) & (frame > 0)[:, None]
    std = np.where(np.arange(num_window) > 0, _TRUTH_STD_M, 0.0)[None]
    return RadioWindow(
        jnp.asarray(np.where(known, relative, 0.0), jnp.float32), jnp.asarray(np.where(known, std, np.inf), jnp.float32)
    )


def true_range_m(recording: Recording, epc: str, antenna: int) -> np.ndarray:
    """A tag's true range at every frame. Raises `RecordingError` if it is unknown, or for another antenna than 1."""
    truth = recording.truth
    if antenna != 1:
        raise RecordingError(
            f"{recording.name}: estimator=truth, but true ranges are known to antenna 1 only; found antenna {antenna}. "
            "Set antennas=[1]."
        )
    if truth is None or epc not in truth.tag_range_m:
        there = ", ".join(truth.tag_range_m) if truth is not None else ""
        raise RecordingError(
            f"{recording.name}: estimator=truth needs the true range of {epc}; found ranges of: {there or 'no tag'}."
        )
    return np.asarray(truth.tag_range_m[epc], np.float64)


_window_reads = jax.jit(window_reads, static_argnums=(2, 3))


@dataclasses.dataclass(frozen=True)
class ClipSettings:
    """How recordings become clips."""

    stride: int | None = None  # every n-th pixel in both directions; None: about 256 columns are left
    window: int = 5  # frames in a motion vector (k)
    window_s: float | None = None  # seconds that it covers, which then determine the number of frames
    max_reads: int = 64  # reads of one tag in a window
    flow: str = "dis"
    estimator: Estimator = "robust"  # of the tags' distances
    antennas: Antennas = "all"  # whose reads are used: all that have a position, numbers from 1, or the busiest
    length: int = 24  # frames of a training clip
    epcs: tuple[str, ...] | None = None  # all that were read
    min_motion: float = 0.1  # training clips without a tag whose reads show so much motion are not drawn; 0 draws all
    max_tags: int | None = None  # of a training clip: the tag that moves most, others at random; all if None
    workers: int = 0  # processes that load training clips; with 0 a thread does

    def __post_init__(self) -> None:
        check_clip(stride=self.stride, window=self.window, max_reads=self.max_reads)
        if self.length < self.window:
            raise ConfigError(f"length is {self.length}; expected at least the window's {self.window} frames.")
        if self.window_s is not None and not self.window_s > 0:
            raise ConfigError(f"window_s is {self.window_s}; expected a positive time, or null for `window` frames.")
        if not 0 <= self.min_motion < 1:
            raise ConfigError(f"min_motion is {self.min_motion}; expected a loss of coherence, from 0 to less than 1.")
        if self.max_tags is not None and self.max_tags < 1:
            raise ConfigError(f"max_tags is {self.max_tags}; expected at least 1 tag, or null for all.")

    def arguments(self) -> dict[str, Any]:
        """The arguments that `load_clip` and `clip_dataset` both have, by name."""
        names = ("stride", "flow", "window", "window_s", "max_reads", "estimator", "antennas")
        return {name: getattr(self, name) for name in names}


def clip_loader(settings: ClipSettings, *, colour: bool = False) -> Callable[..., Clip]:
    """`load(recording, start, stop, epcs=...)` with the settings filled in; `colour` as of `load_clip`."""

    def load(recording: Recording, start: int, stop: int, *, epcs: Sequence[str] | None = None) -> Clip:
        return load_clip(
            recording,
            start,
            stop,
            epcs=settings.epcs if epcs is None else epcs,
            colour=colour,
            **settings.arguments(),
        )

    return load
