"""Tagview as a host tracer: boxes, tracks, and for every trace the tag that the programme assigns to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, Shaped

from ...recording import Intrinsics, Recording, TagReads
from ...recording.reads import concatenate_reads
from ...tracing.tracer import Trace
from ..boxes import box_centre_px, box_mask
from ..host_tracer import AbstractHostTracer, Detection, HostCamera, HostFrame, trace_from_detections
from ..reads import padded_size, usable_reads
from .detection import AbstractDetector, make_detector
from .matching import Identification, MatchSettings, Traces, identify
from .sequences import ReadSettings, tag_measurements
from .settings import TagviewSettings
from .tracks import BoxTracks, track_boxes

MAX_OFFSET_M = 0.3
"""Largest distance of camera and antenna: beyond it S no longer determines the distance to the antenna."""

_PAD_FRAMES = 64


@dataclasses.dataclass(frozen=True)
class TagviewState:
    """Tracks, the boxes and reads within `memory_s`, and the last identification."""

    detector: Any
    tracks: BoxTracks
    boxes: tuple[tuple[float, Mapping[int, np.ndarray]], ...]  # time, box of each track seen then
    confirmed: frozenset[int]  # confirmed tracks; their boxes from before the confirmation count too
    reads: tuple[tuple[TagReads, np.ndarray], ...]  # of each frame, with their times
    tag_of: Mapping[int, int]  # index of each track's tag, -1 = none
    confidence: Mapping[int, float]  # of that, by track
    height_m: float  # of the antenna over the plane; NaN while unknown
    identified_s: float  # time of the last identification


class TagviewTracer(AbstractHostTracer):
    """Duan et al., INFOCOM 2020: camera and antenna at one position, looking straight at the plane of motion."""

    def __init__(self, settings: TagviewSettings | None = None, *, detector: AbstractDetector | None = None):
        """`detector` replaces the one of the settings. Raises `ValueError` for weights that cannot be read."""
        self.settings = settings or TagviewSettings()
        self.detector = detector or make_detector(self.settings.detector)

    def inapplicable(self, recording: Recording) -> str | None:
        # A recording does not hold the camera's attitude: the caller must know that it faces the plane of motion.
        antenna = self.settings.reads.antenna
        if antenna > len(recording.antennas_m):
            return f"antenna {antenna} has no known position."
        offset_m = float(np.linalg.norm(recording.antennas_m[antenna - 1]))
        if offset_m > MAX_OFFSET_M:
            return f"antenna {antenna} is {offset_m:.2f} m from the camera; Tagview needs both at one position."
        if not np.any(usable_reads(recording.reads, antenna)):
            return f"no read of antenna {antenna} with a known carrier."
        return None

    def init(self, camera: HostCamera) -> TagviewState:
        return TagviewState(self.detector.init(), BoxTracks(), (), frozenset(), (), {}, {}, float("nan"), -np.inf)

    def step(self, camera: HostCamera, state: TagviewState, frame: HostFrame) -> tuple[TagviewState, Trace]:
        after = self.observe(state, frame)
        if frame.time_s - after.identified_s >= self.settings.decision_interval_s:
            after = self._identify_online(camera, after, frame.time_s)
        shape = (frame.colour.shape[0], frame.colour.shape[1])
        seen, before = after.boxes[-1][1], after.boxes[-2][1] if len(after.boxes) > 1 else {}
        track_of = {after.tag_of[number]: number for number in seen if after.tag_of.get(number, -1) >= 0}
        detections: list[Detection | None] = []
        for tag in range(len(camera.epcs)):
            number = track_of.get(tag)
            if number is None:
                detections.append(None)
                continue
            detections.append(self._detection(camera, after, seen[number], before.get(number), number, shape))
        return after, trace_from_detections(detections, shape)

    def finish(self, state: TagviewState) -> TagviewState:
        return state

    def observe(self, state: TagviewState, frame: HostFrame) -> TagviewState:
        """The state with the frame's boxes and reads, without an identification."""
        detector, boxes, _ = self.detector.detect(state.detector, frame.colour)
        tracks = track_boxes(state.tracks, boxes, self.settings.tracks)
        seen = {one.number: one.box_px for one in tracks.tracks if one.missed == 0}
        start_s = frame.time_s - self.settings.memory_s
        remembered = (*(entry for entry in state.boxes if entry[0] >= start_s), (frame.time_s, seen))
        known = set().union(*(numbers for _, numbers in remembered))
        confirmed = (state.confirmed & known) | {one.number for one in tracks.tracks if one.confirmed}
        usable = usable_reads(frame.reads, self.settings.reads.antenna)
        new = ((frame.reads[usable], frame.read_time_s[usable]),) if usable.any() else ()
        return dataclasses.replace(
            state,
            detector=detector,
            tracks=tracks,
            boxes=remembered,
            confirmed=frozenset(confirmed),
            reads=(*(entry for entry in state.reads if entry[1][-1] >= start_s), *new),
        )

    def identify(
        self,
        camera: HostCamera,
        state: TagviewState,
        match: MatchSettings | None = None,
        reads: ReadSettings | None = None,
    ) -> tuple[Identification, Traces]:
        """Identify all remembered traces by all remembered reads, with the tracer's settings unless others are given.

        After the last frame this is the paper's result for the whole recording.
        """
        traces = self.traces(camera.intrinsics, state)
        all_reads = concatenate_reads([reads for reads, _ in state.reads])
        time_s = np.concatenate([time_s for _, time_s in state.reads] or [np.zeros(0)])
        measured = tag_measurements(camera.epcs, all_reads, time_s, traces.time_s, reads or self.settings.reads)
        k = camera.intrinsics
        antenna_m = camera.antennas_m[self.settings.reads.antenna - 1]
        focal_px = float(np.sqrt(k.fx_px * k.fy_px))
        return identify(traces, measured, focal_px, antenna_m, match or self.settings.match), traces

    def traces(self, intrinsics: Intrinsics, state: TagviewState) -> Traces:
        """Directions of all tracks that were seen for long enough; padded at the end with frames without a track."""
        boxes, time_s, number = self.boxes(state)
        seen = np.isfinite(boxes[..., 0])
        direction = undistorted(box_centre_px(boxes), seen, intrinsics)
        pad = padded_size(len(time_s), _PAD_FRAMES) - len(time_s)
        last = time_s[-1] if len(time_s) else 0.0
        return Traces(
            number,
            np.concatenate([time_s, np.full(pad, last)]),
            np.pad(direction, ((0, 0), (0, pad), (0, 0))),
            np.pad(seen, ((0, 0), (0, pad))),
        )

    def boxes(
        self, state: TagviewState
    ) -> tuple[Float[np.ndarray, "traces frames 4"], Float[np.ndarray, " frames"], tuple[int, ...]]:
        """Boxes of all traces, NaN where not seen, times of the frames, and the traces' numbers."""
        time_s = np.array([time for time, _ in state.boxes], np.float64)
        spans: dict[int, list[float]] = {}
        for time, seen in state.boxes:
            for number in seen.keys() & state.confirmed:
                spans.setdefault(number, [time, time])[1] = time
        number = tuple(sorted(n for n, (a, b) in spans.items() if b - a >= self.settings.min_trace_s))
        missing = np.full(4, np.nan)
        rows = [[seen.get(one, missing) for _, seen in state.boxes] for one in number]
        return np.array(rows, np.float64).reshape(len(number), len(time_s), 4), time_s, number

    def _identify_online(self, camera: HostCamera, state: TagviewState, time_s: float) -> TagviewState:
        found, traces = self.identify(camera, state)
        tag_of = dict(zip(traces.number, found.tag_of.tolist(), strict=True))
        confidence = {
            number: float(found.fit[row, tag]) for row, (number, tag) in enumerate(tag_of.items()) if tag >= 0
        }
        return dataclasses.replace(
            state, tag_of=tag_of, confidence=confidence, height_m=found.height_m, identified_s=time_s
        )

    def _detection(
        self,
        camera: HostCamera,
        state: TagviewState,
        box_px: Shaped[np.ndarray, " 4"],
        before_px: Shaped[np.ndarray, " 4"] | None,
        number: int,
        shape: tuple[int, int],
    ) -> Detection:
        ends = np.stack([box_px if before_px is None else before_px, box_px])
        direction = undistorted(box_centre_px(ends), np.ones(2, bool), camera.intrinsics)
        antenna_m = camera.antennas_m[self.settings.reads.antenna - 1]
        position_m = self._depth_m(state, antenna_m) * np.concatenate([direction, np.ones((2, 1))], axis=1)
        range_m = np.linalg.norm(position_m - antenna_m, axis=1)
        step_m = float(range_m[1] - range_m[0])
        return Detection(
            mask=box_mask(box_px, shape),
            centre_m=position_m[1],
            confidence=state.confidence[number],
            step_m=step_m if np.isfinite(step_m) else 0.0,
        )

    def _depth_m(self, state: TagviewState, antenna_m: Shaped[np.ndarray, " 3"]) -> float:
        """The plane's depth before the camera: the known height, or the one of the shared slope (a = 4 pi h /
        wavelength).

        Identification needs only that all slopes agree, and the paper uses nothing else of them. As a length the slope
        is inaccurate: where distances change by 0.1 m, multipath of 0.3 rad changes it by a tenth and more.
        """
        known = self.settings.height_m
        return state.height_m + float(antenna_m[2]) if known is None else known


def undistorted(
    point_px: Shaped[np.ndarray, "*points 2"], known: Bool[np.ndarray, "*points"], intrinsics: Intrinsics
) -> Float[np.ndarray, "*points 2"]:
    """Directions (x / z, y / z) of pixels with lens distortion corrected (III.C); 0 where not known.

    The paper undistorts pictures; for the centres of boxes this is equivalent.
    """
    out = np.zeros(point_px.shape)
    if known.any():
        points = np.asarray(point_px[known], np.float64).reshape(-1, 1, 2)
        lens = np.asarray(intrinsics.distortion or (0.0,) * 5, np.float64)
        out[known] = cv2.undistortPoints(points, intrinsics.matrix(), lens).reshape(-1, 2)
    return out
