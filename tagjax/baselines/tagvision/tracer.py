"""TagVision as a host tracer: blobs, tracks, positions on the plane, and for each tag the track of highest phase
score.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from ...recording import Recording, TagReads
from ...recording.reads import concatenate_reads
from ...tracing.tracer import Trace
from ..host_tracer import AbstractHostTracer, Detection, HostCamera, HostFrame, trace_from_detections
from ..opencv import grey
from ..reads import usable_reads
from .detection import backward_flow, find_blobs
from .matching import NO_MATCH, Match, match_tags
from .plane import PlaneCamera
from .settings import TagVisionSettings
from .tracks import BlobTrack, Tracks, track_blobs


@dataclasses.dataclass(frozen=True)
class TagVisionState:
    """Tracks, their positions and the reads within `memory_s`, the last matches, and recent pictures."""

    tracks: Tracks
    positions: tuple[tuple[float, Mapping[int, np.ndarray]], ...]  # time, world position of each track seen then
    reads: TagReads
    read_time_s: Float[np.ndarray, " reads"]
    matches: Mapping[str, Match]
    matched_s: float  # time of the last matches
    pictures: tuple[tuple[float, np.ndarray], ...]  # time, grey

    def paths(self) -> tuple[Float[np.ndarray, " frames"], dict[int, Float[np.ndarray, "frames 3"]]]:
        """Frame times, and the path of every track in memory, NaN where it was not seen."""
        missing = np.full(3, np.nan)
        numbers = sorted({number for _, seen in self.positions for number in seen})
        time_s = np.array([time for time, _ in self.positions])
        return time_s, {
            number: np.array([seen.get(number, missing) for _, seen in self.positions]) for number in numbers
        }


class TagVisionTracer(AbstractHostTracer):
    """Duan et al., INFOCOM 2017. `camera` is the calibration; the tagged objects move on a plane `height_m` above
    it.
    """

    def __init__(self, camera: PlaneCamera | None, settings: TagVisionSettings | None = None):
        self.camera = camera
        self.settings = settings or TagVisionSettings()

    def inapplicable(self, recording: Recording) -> str | None:
        if self.camera is None:
            return "no calibration of the camera over a plane (experiments.calibrate_camera makes one)."
        k, (height, width) = self.camera.intrinsics, recording.image_shape
        if (k.height, k.width) != (height, width):
            return f"the calibration is for pictures of {k.width} x {k.height} pixels, these have {width} x {height}."
        if self.settings.antenna > len(recording.antennas_m):
            return f"antenna {self.settings.antenna} has no known position."
        if not np.any(usable_reads(recording.reads, self.settings.antenna)):
            return f"no read of antenna {self.settings.antenna} with a known carrier."
        return None

    def init(self, camera: HostCamera) -> TagVisionState:
        unmatched = dict.fromkeys(camera.epcs, NO_MATCH)
        return TagVisionState(Tracks(), (), TagReads.empty(), np.zeros(0), unmatched, -np.inf, ())

    def step(self, camera: HostCamera, state: TagVisionState, frame: HostFrame) -> tuple[TagVisionState, Trace]:
        tracks, pictures = self._track(state, frame.colour, frame.time_s)
        seen = [track for track in tracks.tracks if track.is_seen()]
        centres_px = np.array([track.centre_px for track in seen]).reshape(-1, 2)
        world_m = self._plane().to_plane(centres_px, self.settings.height_m)
        positions = {track.number: position for track, position in zip(seen, world_m, strict=True)}
        start_s = frame.time_s - self.settings.memory_s
        usable, kept = usable_reads(frame.reads, self.settings.antenna), state.read_time_s >= start_s
        after = TagVisionState(
            tracks=tracks,
            positions=(*(entry for entry in state.positions if entry[0] >= start_s), (frame.time_s, positions)),
            reads=concatenate_reads([state.reads[kept], frame.reads[usable]]),
            read_time_s=np.concatenate([state.read_time_s[kept], frame.read_time_s[usable]]),
            matches=state.matches,
            matched_s=state.matched_s,
            pictures=pictures,
        )
        if frame.time_s - state.matched_s >= self.settings.decision_interval_s:
            matches = self.match(camera, after, alive=True)
            after = dataclasses.replace(after, matches=matches, matched_s=frame.time_s)
        by_number = {track.number: track for track in seen}
        shape = (frame.colour.shape[0], frame.colour.shape[1])
        detections = [
            self._detection(camera, after, by_number.get(after.matches[epc].track), epc, shape) for epc in camera.epcs
        ]
        return after, trace_from_detections(detections, shape)

    def finish(self, state: TagVisionState) -> TagVisionState:
        return dataclasses.replace(state, pictures=())

    def match(self, camera: HostCamera, state: TagVisionState, *, alive: bool = False) -> dict[str, Match]:
        """The track of highest score for every tag, by all remembered reads: among current tracks, or among all.

        After the last frame, and among all tracks, this is the paper's result for the whole recording.
        """
        confirmed = {
            track.number for track in state.tracks.tracks if track.num_blobs >= self.settings.tracks.confirm_frames
        }
        time_s, paths = state.paths()
        if alive:
            paths = {number: path for number, path in paths.items() if number in confirmed}
        return match_tags(
            camera.epcs, time_s, paths, state.reads, state.read_time_s, self._antenna_m(camera), self.settings.match
        )

    def _track(
        self, state: TagVisionState, colour: UInt8[np.ndarray, "height width 3"], time_s: float
    ) -> tuple[Tracks, tuple[tuple[float, np.ndarray], ...]]:
        """Tracks of this frame, and the pictures with which the next ones may be compared."""
        settings, now = self.settings.blobs, grey(colour)
        # Frame times jitter: a frame that is half an interval late is still used.
        past = tuple(entry for entry in state.pictures if 0 < time_s - entry[0] <= 1.5 * settings.flow_interval_s)
        blobs = []
        if past:
            then_s, before = min(past, key=lambda entry: abs(time_s - entry[0] - settings.flow_interval_s))
            flow_px = backward_flow(now, before, settings.flow)
            change = np.asarray(cv2.absdiff(now, before))
            plane, height_m = self._plane(), self.settings.height_m
            blobs = find_blobs(colour, flow_px, change, time_s - then_s, plane, height_m, settings)
        tracks = track_blobs(state.tracks, colour, blobs, time_s, self.settings.tracks)
        return tracks, (*past, (time_s, now))

    def _detection(
        self, camera: HostCamera, state: TagVisionState, track: BlobTrack | None, epc: str, shape: tuple[int, int]
    ) -> Detection | None:
        if track is None:
            return None
        position = state.positions[-1][1][track.number]
        before = state.positions[-2][1].get(track.number) if len(state.positions) > 1 else None
        step_m = 0.0
        if before is not None:
            ranges = np.linalg.norm(np.stack([before, position]) - self._antenna_m(camera), axis=1)
            step_m = float(ranges[1] - ranges[0])
        return Detection(
            mask=track.full_mask(shape),
            centre_m=self._plane().to_camera(position[None])[0],
            confidence=state.matches[epc].confidence,
            step_m=step_m if np.isfinite(step_m) else 0.0,
        )

    def _antenna_m(self, camera: HostCamera) -> Float[np.ndarray, " 3"]:
        return self._plane().to_world(camera.antennas_m[self.settings.antenna - 1][None])[0]

    def _plane(self) -> PlaneCamera:
        if self.camera is None:
            raise ValueError("TagVision has no calibration; give one made by experiments.calibrate_camera.")
        return self.camera
