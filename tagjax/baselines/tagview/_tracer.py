"""Tagview as a host tracer: boxes, tracks, and for every trace the tag that the programme gives it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from ...recording import Intrinsics, Recording, TagReads
from ...tracing.tracer import Trace
from .._interface import AbstractHostTracer, Claim, HostCamera, HostFrame, claims_to_trace, joined_reads
from ._boxes import middle_px
from ._detect import AbstractDetector, DetectorSettings, make_detector
from ._match import Identification, MatchSettings, Traces, identify
from ._reads import ReadSettings, hear, useful_reads
from ._sort import BoxTracks, SortSettings, track_boxes

MOST_APART_M = 0.3
"""Between camera and antenna: beyond it S says too little of the distance to the antenna, wherever that is."""

_PAD_FRAMES = 64


@dataclasses.dataclass(frozen=True)
class TagviewSettings:
    """Everything that is chosen; see the parts for what is the paper's."""

    decide_every_s: float = 0.5
    memory_s: float = 60.0
    least_trace_s: float = 0.4  # a shorter trace is no candidate
    height_m: float | None = (
        None  # of the camera over the plane of things' middles; None takes the fit's, see `_depth_m`
    )
    detector: DetectorSettings = dataclasses.field(default_factory=DetectorSettings)
    tracks: SortSettings = dataclasses.field(default_factory=SortSettings)
    reads: ReadSettings = dataclasses.field(default_factory=ReadSettings)
    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)

    def __post_init__(self):
        if not (self.memory_s > 0 and self.decide_every_s >= 0 and self.least_trace_s >= 0):
            raise ValueError(
                f"memory_s {self.memory_s}, decide_every_s {self.decide_every_s}, least_trace_s {self.least_trace_s}; "
                "expected positive, and not negative."
            )
        if self.height_m is not None and not self.height_m > 0:
            raise ValueError(f"height_m is {self.height_m}; expected positive, or None for the fit's.")


@dataclasses.dataclass(frozen=True)
class ViewState:
    """What is remembered: tracks, the boxes seen and the reads within `memory_s`, and the last decision."""

    detector: Any
    tracks: BoxTracks
    boxes: tuple[tuple[float, Mapping[int, np.ndarray]], ...]  # time, box of each track seen then
    confirmed: frozenset[int]  # of these; what led to a track's confirmation belongs to it
    reads: tuple[tuple[TagReads, np.ndarray], ...]  # of each frame, with their times
    named: Mapping[int, int]  # tag of each track, index into the tags asked for
    confidence: Mapping[int, float]  # of that, by track
    height_m: float  # of the antenna over the plane; NaN while unknown
    decided_s: float


class TagviewTracer(AbstractHostTracer):
    """Duan et al., INFOCOM 2020: camera and antenna in one place, looking straight at the plane that things move on."""

    def __init__(self, settings: TagviewSettings | None = None, *, detector: AbstractDetector | None = None):
        """`detector` stands in for the one that the settings name. Raises `ValueError` for unreadable weights."""
        self.settings = settings or TagviewSettings()
        self.detector = detector or make_detector(self.settings.detector)

    def inapplicable(self, recording: Recording) -> str | None:
        """The camera's attitude is not in a recording: that it faces the plane of motion is for the caller to know."""
        antenna = self.settings.reads.antenna
        if antenna > len(recording.antennas_m):
            return f"antenna {antenna} has no known place."
        apart_m = float(np.linalg.norm(recording.antennas_m[antenna - 1]))
        if apart_m > MOST_APART_M:
            return f"antenna {antenna} is {apart_m:.2f} m from the camera; Tagview needs both in one place."
        if not np.any(useful_reads(recording.reads, antenna)):
            return f"no read of antenna {antenna} with a known carrier."
        return None

    def init(self, camera: HostCamera) -> ViewState:
        return ViewState(self.detector.begin(), BoxTracks(), (), frozenset(), (), {}, {}, float("nan"), -np.inf)

    def step(self, camera: HostCamera, state: ViewState, frame: HostFrame) -> tuple[ViewState, Trace]:
        after = self.see(state, frame)
        if frame.time_s - after.decided_s >= self.settings.decide_every_s:
            after = self._decide(camera, after, frame.time_s)
        shape = (frame.colour.shape[0], frame.colour.shape[1])
        here, before = after.boxes[-1][1], after.boxes[-2][1] if len(after.boxes) > 1 else {}
        carrier = {after.named[number]: number for number in here if after.named.get(number, -1) >= 0}
        claims = []
        for tag in range(len(camera.epcs)):
            number = carrier.get(tag)
            claims.append(
                None if number is None else self._claim(camera, after, here[number], before.get(number), number, shape)
            )
        return after, claims_to_trace(claims, shape)

    def finish(self, state: ViewState) -> ViewState:
        return state

    def see(self, state: ViewState, frame: HostFrame) -> ViewState:
        """The frame's boxes and reads remembered, with nothing decided."""
        seen, boxes, _ = self.detector.detect(state.detector, frame.colour)
        tracks = track_boxes(state.tracks, boxes, self.settings.tracks)
        here = {one.number: one.box_px for one in tracks.tracks if one.missed == 0}
        start_s = frame.time_s - self.settings.memory_s
        boxes_seen = (*(entry for entry in state.boxes if entry[0] >= start_s), (frame.time_s, here))
        known = set().union(*(there for _, there in boxes_seen))
        confirmed = (state.confirmed & known) | {one.number for one in tracks.tracks if one.confirmed}
        useful = useful_reads(frame.reads, self.settings.reads.antenna)
        new = ((frame.reads[useful], frame.read_time_s[useful]),) if useful.any() else ()
        return dataclasses.replace(
            state,
            detector=seen,
            tracks=tracks,
            boxes=boxes_seen,
            confirmed=frozenset(confirmed),
            reads=(*(entry for entry in state.reads if entry[1][-1] >= start_s), *new),
        )

    def identify(
        self,
        camera: HostCamera,
        state: ViewState,
        match: MatchSettings | None = None,
        reads: ReadSettings | None = None,
    ) -> tuple[Identification, Traces]:
        """Name all remembered traces by all remembered reads; other settings than the tracer's own if given.

        After the last frame this is the paper's result for the whole recording.
        """
        traces = self.traces(camera.intrinsics, state)
        all_reads = joined_reads([reads for reads, _ in state.reads])
        time_s = np.concatenate([time_s for _, time_s in state.reads] or [np.zeros(0)])
        heard = hear(camera.epcs, all_reads, time_s, traces.time_s, reads or self.settings.reads)
        k = camera.intrinsics
        antenna_m = camera.antennas_m[self.settings.reads.antenna - 1]
        chosen = match or self.settings.match
        return identify(traces, heard, float(np.sqrt(k.fx_px * k.fy_px)), antenna_m, chosen), traces

    def traces(self, intrinsics: Intrinsics, state: ViewState) -> Traces:
        """Directions of all tracks that were seen for long enough; frames are padded at the end, none seen there."""
        boxes, time_s, number = self.boxes(state)
        seen = np.isfinite(boxes[..., 0])
        direction = undistorted(middle_px(boxes), seen, intrinsics)
        pad = -len(time_s) % _PAD_FRAMES
        last = time_s[-1] if len(time_s) else 0.0
        return Traces(
            number,
            np.concatenate([time_s, np.full(pad, last)]),
            np.pad(direction, ((0, 0), (0, pad), (0, 0))),
            np.pad(seen, ((0, 0), (0, pad))),
        )

    def boxes(
        self, state: ViewState
    ) -> tuple[Float[np.ndarray, "traces frames 4"], Float[np.ndarray, " frames"], tuple[int, ...]]:
        """Boxes of all traces, NaN where not seen, times of the frames, and the traces' numbers."""
        time_s = np.array([time for time, _ in state.boxes], np.float64)
        spans: dict[int, list[float]] = {}
        for time, here in state.boxes:
            for number in here.keys() & state.confirmed:
                spans.setdefault(number, [time, time])[1] = time
        number = tuple(sorted(n for n, (a, b) in spans.items() if b - a >= self.settings.least_trace_s))
        missing = np.full(4, np.nan)
        rows = [[here.get(one, missing) for _, here in state.boxes] for one in number]
        return np.array(rows, np.float64).reshape(len(number), len(time_s), 4), time_s, number

    def _decide(self, camera: HostCamera, state: ViewState, time_s: float) -> ViewState:
        found, traces = self.identify(camera, state)
        named = dict(zip(traces.number, found.tag_of.tolist(), strict=True))
        share = {number: float(found.weight[row, tag]) for row, (number, tag) in enumerate(named.items()) if tag >= 0}
        return dataclasses.replace(state, named=named, confidence=share, height_m=found.height_m, decided_s=time_s)

    def _claim(
        self,
        camera: HostCamera,
        state: ViewState,
        box_px: Shaped[np.ndarray, " 4"],
        before_px: Shaped[np.ndarray, " 4"] | None,
        number: int,
        shape: tuple[int, int],
    ) -> Claim:
        ends = np.stack([box_px if before_px is None else before_px, box_px])
        direction = undistorted(middle_px(ends), np.ones(2, bool), camera.intrinsics)
        antenna_m = camera.antennas_m[self.settings.reads.antenna - 1]
        place_m = self._depth_m(state, antenna_m) * np.concatenate([direction, np.ones((2, 1))], axis=1)
        range_m = np.linalg.norm(place_m - antenna_m, axis=1)
        step_m = float(range_m[1] - range_m[0])
        corner = np.round(box_px + np.array([0.5, 0.5, -0.5, -0.5])).astype(int)
        low, high = np.maximum(corner[:2], 0), np.maximum(corner[2:] + 1, 0)
        mask = np.zeros(shape, bool)
        mask[low[1] : high[1], low[0] : high[0]] = True
        return Claim(
            mask=mask,
            centre_m=place_m[1],
            confidence=state.confidence[number],
            step_m=step_m if np.isfinite(step_m) else 0.0,
        )

    def _depth_m(self, state: ViewState, antenna_m: Shaped[np.ndarray, " 3"]) -> float:
        """The plane's depth before the camera: the height that is known, or what the shared slope says (a = 4 pi h / wavelength).

        Names need no more than that all slopes agree, and the paper asks nothing else of them. As a length the slope is a
        poor one: where distances change by 0.1 m, multipath of 0.3 rad turns it by a tenth and more.
        """
        known = self.settings.height_m
        return state.height_m + float(antenna_m[2]) if known is None else known


def undistorted(
    point_px: Shaped[np.ndarray, "*points 2"], known: Bool[np.ndarray, "*points"], intrinsics: Intrinsics
) -> Float[np.ndarray, "*points 2"]:
    """Directions (x / z, y / z) of pixels, the lens's distortion taken off (III.C); 0 where not known.

    The paper undistorts pictures; the middles of boxes need no more than this.
    """
    out = np.zeros(point_px.shape)
    if known.any():
        points = np.asarray(point_px[known], np.float64).reshape(-1, 1, 2)
        lens = np.asarray(intrinsics.distortion or (0.0,) * 5, np.float64)
        out[known] = cv2.undistortPoints(points, intrinsics.matrix(), lens).reshape(-1, 2)
    return out
