"""One recording: follow everything, name it, and hold names and boxes against the truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from ...baselines._interface import HostCamera, host_frames
from ...baselines.tagview import (
    Identification,
    MatchSettings,
    ReadSettings,
    TagviewTracer,
    from_inclusive,
    middle_px,
    overlap,
)
from ...recording import Recording

SAME_OVERLAP = 0.3
"""A box that overlaps a thing's by this or more is that thing's."""

MISSED_FRAMES = 3
"""A thing out of sight for no more frames is still in the same stretch."""

COVERED = 0.5
"""A stretch is found if so much of it is rightly named."""


@dataclasses.dataclass(frozen=True)
class Watched:
    """The camera's side of a recording, done once, and what is true of it. Things are those with tags, in their order."""

    name: str
    epcs: tuple[str, ...]
    camera: HostCamera
    state: Any
    box_px: Float[np.ndarray, "traces frames 4"]  # NaN where not seen
    truth_px: Float[np.ndarray, "things frames 4"]
    owner: Int[np.ndarray, " traces"]  # the thing that a trace follows; -1 for none
    mm_px: float  # what a pixel in the middle of the picture is worth on the plane


def watch(tracer: TagviewTracer, recording: Recording, *, on_frame: Callable[[], None] | None = None) -> Watched:
    """Detect and follow through a whole recording; raises `ValueError` for one without true boxes of tagged things.

    The tracer's memory is to span the recording. Tags that were never read are things all the same.
    """
    truth = recording.truth
    if truth is None or truth.boxes_px is None or not truth.tag_to_label:
        raise ValueError(f"{recording.name}: no true boxes of tagged things; expected a simulated recording.")
    epcs = tuple(sorted(truth.tag_to_label))
    camera = HostCamera(recording.intrinsics, np.asarray(recording.antennas_m, np.float64), epcs)
    state = tracer.init(camera)
    for frame in host_frames(recording, epcs):
        state = tracer.see(state, frame)
        if on_frame is not None:
            on_frame()
    boxes, _, _ = tracer.boxes(state)
    rows = [truth.tag_to_label[epc] - 1 for epc in epcs]
    true_px = from_inclusive(np.moveaxis(np.asarray(truth.boxes_px, np.float64)[:, rows], 1, 0))
    depth_m = np.nanmedian([np.nanmedian(truth.tag_position_m[epc][:, 2]) for epc in epcs])
    return Watched(
        name=recording.name,
        epcs=epcs,
        camera=camera,
        state=state,
        box_px=boxes,
        truth_px=true_px,
        owner=owners(boxes, true_px),
        mm_px=1e3 * float(depth_m) / recording.intrinsics.fx_px,
    )


def owners(
    box_px: Float[np.ndarray, "traces frames 4"], truth_px: Float[np.ndarray, "things frames 4"]
) -> Int[np.ndarray, " traces"]:
    """The thing that each trace overlaps in most of its frames, by `SAME_OVERLAP`; -1 where that is less than half."""
    found = np.full(len(box_px), -1)
    for row, boxes in enumerate(box_px):
        seen = np.flatnonzero(np.isfinite(boxes[:, 0]))
        counts = np.zeros(len(truth_px))
        for frame in seen:
            things = truth_px[:, frame]
            counts += overlap(boxes[frame][None], np.nan_to_num(things, nan=-1e6))[0] >= SAME_OVERLAP
        if len(counts) and counts.max() >= 0.5 * len(seen):
            found[row] = int(counts.argmax())
    return found


def true_stretches(seen: Bool[np.ndarray, " frames"], least_frames: int) -> list[tuple[int, int]]:
    """First frame and one past the last of each stretch in sight, gaps of `MISSED_FRAMES` closed, short ones left out."""
    frames = np.flatnonzero(seen)
    if not len(frames):
        return []
    breaks = np.flatnonzero(np.diff(frames) > MISSED_FRAMES + 1)
    first, last = np.append(frames[0], frames[breaks + 1]), np.append(frames[breaks], frames[-1])
    return [(int(a), int(b) + 1) for a, b in zip(first, last, strict=True) if b - a + 1 >= least_frames]


@dataclasses.dataclass(frozen=True)
class Judged:
    """What became of a recording by one setting."""

    recording: str
    num_tags: int
    num_traces: int  # of tagged things
    num_false: int  # traces of nothing
    num_right: int  # traces named as their thing
    num_named: int  # traces that got a name at all
    num_stretches: int  # in sight, by the truth
    num_found: int  # of those, rightly named for most of their frames
    error_px: Float[np.ndarray, " boxes"]  # of middles, all traces of tagged things
    r_squared: Float[np.ndarray, "2 _"]  # of pairs: value, and 1 where the pair is right
    slope: Float[np.ndarray, "2 _"]  # over 4 pi h / wavelength with the true height
    gap: float  # of the programme; 0 if solved to the end


def judge(
    watched: Watched,
    tracer: TagviewTracer,
    match: MatchSettings,
    reads: ReadSettings,
    *,
    least_frames: int,
    true_slope: float,
) -> Judged:
    """Name the traces with these settings and count. `true_slope` is 4 pi h / wavelength, rad."""
    found, _ = tracer.identify(watched.camera, watched.state, match, reads)
    return counted(watched, found, least_frames=least_frames, true_slope=true_slope)


def counted(watched: Watched, found: Identification, *, least_frames: int, true_slope: float) -> Judged:
    """Counts of an identification against the truth."""
    owner, named = watched.owner, found.tag_of
    right = (owner >= 0) & (named == owner)
    stretches = covered = 0
    for thing, boxes in enumerate(watched.truth_px):
        mine = np.any(np.isfinite(watched.box_px[right & (owner == thing), :, 0]), axis=0)
        for first, last in true_stretches(np.isfinite(boxes[:, 0]), least_frames):
            stretches += 1
            covered += bool(np.mean(mine[first:last]) >= COVERED)
    errors = [
        np.linalg.norm(middle_px(watched.box_px[row]) - middle_px(watched.truth_px[owner[row]]), axis=1)
        for row in np.flatnonzero(owner >= 0)
    ]
    flat = np.concatenate(errors) if errors else np.zeros(0)
    real = np.flatnonzero(owner >= 0)
    pair = (owner[real, None] == np.arange(len(watched.epcs))[None, :]).ravel().astype(np.float64)
    return Judged(
        recording=watched.name,
        num_tags=len(watched.epcs),
        num_traces=len(real),
        num_false=int(np.sum(owner < 0)),
        num_right=int(right.sum()),
        num_named=int(np.sum(named >= 0)),
        num_stretches=stretches,
        num_found=covered,
        error_px=flat[np.isfinite(flat)],
        r_squared=np.stack([found.r_squared[real].ravel(), pair]),
        slope=np.stack([found.slope[real].ravel() / true_slope, pair]),
        gap=0.0 if found.selection is None else found.selection.gap,
    )
