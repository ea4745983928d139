"""TagVision as a host tracer: blobs, tracks, places on the plane, and for each tag the track of highest phase score."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from ...recording import Recording, TagReads
from ...tracing.tracer import Trace
from .._interface import AbstractHostTracer, Claim, HostCamera, HostFrame, claims_to_trace, joined_reads
from ._blobs import BlobSettings, backward_flow, find_blobs
from ._match import NO_MATCH, Match, MatchSettings, match_tags
from ._plane import PlaneCamera
from ._tracks import BlobTrack, Tracks, TrackSettings, follow


@dataclasses.dataclass(frozen=True)
class TagVisionSettings:
    """Everything that is chosen; see the parts for what is the paper's."""

    height_m: float = 0.0  # of the plane in which things move, above the calibration's
    antenna: int = 1
    decide_every_s: float = 0.2
    memory_s: float = 30.0
    blobs: BlobSettings = dataclasses.field(default_factory=BlobSettings)
    tracks: TrackSettings = dataclasses.field(default_factory=TrackSettings)
    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)

    def __post_init__(self):
        if self.antenna < 1:
            raise ValueError(f"antenna is {self.antenna}; antennas are counted from 1.")
        if not (self.memory_s > 0 and self.decide_every_s >= 0):
            raise ValueError(
                f"memory_s {self.memory_s}, decide_every_s {self.decide_every_s}; expected positive, and not negative."
            )


@dataclasses.dataclass(frozen=True)
class VisionState:
    """What is remembered: tracks, their places and the reads within `memory_s`, the last decision, some pictures."""

    tracks: Tracks
    places: tuple[tuple[float, Mapping[int, np.ndarray]], ...]  # time, world place of each track seen then
    reads: TagReads
    read_time_s: Float[np.ndarray, " reads"]
    matches: Mapping[str, Match]
    decided_s: float
    pictures: tuple[tuple[float, np.ndarray], ...]  # time, grey

    def paths(self) -> tuple[Float[np.ndarray, " frames"], dict[int, Float[np.ndarray, "frames 3"]]]:
        """Frame times, and the path of every track in memory, NaN where it was not seen."""
        missing = np.full(3, np.nan)
        numbers = sorted({number for _, here in self.places for number in here})
        time_s = np.array([time for time, _ in self.places])
        return time_s, {number: np.array([here.get(number, missing) for _, here in self.places]) for number in numbers}


class TagVision(AbstractHostTracer):
    """Duan et al., INFOCOM 2017. `camera` is the calibration; the tags' hosts move on a plane `height_m` above it."""

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
            return f"antenna {self.settings.antenna} has no known place."
        if not np.any(self._useful(recording.reads)):
            return f"no read of antenna {self.settings.antenna} with a known carrier."
        return None

    def init(self, camera: HostCamera) -> VisionState:
        nothing = dict.fromkeys(camera.epcs, NO_MATCH)
        return VisionState(Tracks(), (), TagReads.empty(), np.zeros(0), nothing, -np.inf, ())

    def step(self, camera: HostCamera, state: VisionState, frame: HostFrame) -> tuple[VisionState, Trace]:
        plane = self._plane()
        tracks, pictures = self._see(state, frame.colour, frame.time_s)
        seen = [track for track in tracks.tracks if track.is_seen()]
        centres_px = np.array([track.centre_px for track in seen]).reshape(-1, 2)
        world_m = plane.to_plane(centres_px, self.settings.height_m)
        here = {track.number: place for track, place in zip(seen, world_m, strict=True)}
        start_s = frame.time_s - self.settings.memory_s
        useful, kept = self._useful(frame.reads), state.read_time_s >= start_s
        after = VisionState(
            tracks=tracks,
            places=(*(entry for entry in state.places if entry[0] >= start_s), (frame.time_s, here)),
            reads=joined_reads([state.reads[kept], frame.reads[useful]]),
            read_time_s=np.concatenate([state.read_time_s[kept], frame.read_time_s[useful]]),
            matches=state.matches,
            decided_s=state.decided_s,
            pictures=pictures,
        )
        if frame.time_s - state.decided_s >= self.settings.decide_every_s:
            matches = self.match(camera, after, alive=True)
            after = dataclasses.replace(after, matches=matches, decided_s=frame.time_s)
        by_number = {track.number: track for track in seen}
        shape = (frame.colour.shape[0], frame.colour.shape[1])
        claims = [
            self._claim(camera, after, by_number.get(after.matches[epc].track), epc, shape) for epc in camera.epcs
        ]
        return after, claims_to_trace(claims, shape)

    def finish(self, state: VisionState) -> VisionState:
        return dataclasses.replace(state, pictures=())

    def match(self, camera: HostCamera, state: VisionState, *, alive: bool = False) -> dict[str, Match]:
        """The tracks of highest score by all that is remembered: among those still followed, or among all.

        After the last frame, and among all, this is the paper's result for the whole recording.
        """
        followed = {
            track.number for track in state.tracks.tracks if track.num_blobs >= self.settings.tracks.confirm_frames
        }
        time_s, paths = state.paths()
        if alive:
            paths = {number: path for number, path in paths.items() if number in followed}
        return match_tags(
            camera.epcs, time_s, paths, state.reads, state.read_time_s, self._antenna_m(camera), self.settings.match
        )

    def _see(
        self, state: VisionState, colour: UInt8[np.ndarray, "height width 3"], time_s: float
    ) -> tuple[Tracks, tuple[tuple[float, np.ndarray], ...]]:
        """Blobs and tracks of this frame, and the pictures that the next ones may be compared with."""
        chosen = self.settings.blobs
        grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
        # Frames jitter: one that is half a gap late still does.
        past = tuple(entry for entry in state.pictures if 0 < time_s - entry[0] <= 1.5 * chosen.gap_s)
        blobs = []
        if past:
            then_s, before = min(past, key=lambda entry: abs(time_s - entry[0] - chosen.gap_s))
            flow_px = backward_flow(grey, before, chosen.flow)
            change = np.asarray(cv2.absdiff(grey, before))
            blobs = find_blobs(colour, flow_px, change, time_s - then_s, self._plane(), self.settings.height_m, chosen)
        return follow(state.tracks, colour, blobs, time_s, self.settings.tracks), (*past, (time_s, grey))

    def _claim(
        self, camera: HostCamera, state: VisionState, track: BlobTrack | None, epc: str, shape: tuple[int, int]
    ) -> Claim | None:
        if track is None:
            return None
        place = state.places[-1][1][track.number]
        before = state.places[-2][1].get(track.number) if len(state.places) > 1 else None
        step_m = 0.0
        if before is not None:
            ends = np.linalg.norm(np.stack([before, place]) - self._antenna_m(camera), axis=1)
            step_m = float(ends[1] - ends[0])
        return Claim(
            mask=track.full_mask(shape),
            centre_m=self._plane().to_camera(place[None])[0],
            confidence=state.matches[epc].confidence,
            step_m=step_m if np.isfinite(step_m) else 0.0,
        )

    def _antenna_m(self, camera: HostCamera) -> Float[np.ndarray, " 3"]:
        return self._plane().to_world(camera.antennas_m[self.settings.antenna - 1][None])[0]

    def _useful(self, reads: TagReads) -> Bool[np.ndarray, " reads"]:
        return np.asarray((reads.antenna == self.settings.antenna) & np.isfinite(reads.carrier_hz))

    def _plane(self) -> PlaneCamera:
        if self.camera is None:
            raise ValueError("TagVision has no calibration; give one made by experiments.calibrate_camera.")
        return self.camera
