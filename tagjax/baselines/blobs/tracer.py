"""The blob tracer: blobs, tracks, and for each tag the track of which the range explains its phases best.

Bodies are tracked as a whole and in parts, side by side. A tag's phases decide whether its object is the whole (a badge on a
person) or a part (a bottle in a hand).
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

from ...core.assignment import hard_assignment
from ...core.geometry import pixel_rays
from ...recording import Recording, TagReads
from ...recording.reads import concatenate_reads
from ...tracing.tracer import Trace
from ..host_tracer import AbstractHostTracer, Detection, HostCamera, HostFrame, trace_from_detections
from ..reads import range_phase_rad
from .detection import Background, connected_parts, foreground
from .matching import coherent_evidence
from .settings import BlobSettings
from .tracks import Track, follow


@dataclasses.dataclass(frozen=True)
class BlobState:
    """Background, tracks, their positions and the reads within `memory_s`."""

    background: Background | None = None
    tracks: tuple[Track, ...] = ()
    next_number: int = 0
    time_s: float = -np.inf
    positions: tuple[tuple[float, dict[int, np.ndarray]], ...] = ()  # time, position of each track at that time
    reads: TagReads = dataclasses.field(default_factory=TagReads.empty)
    read_time_s: Float[np.ndarray, " reads"] = dataclasses.field(default_factory=lambda: np.zeros(0))


class BlobTracer(AbstractHostTracer):
    """Blobs in depth and colour, tracked in space, and matched to tags by the coherence of their phases."""

    needs_depth = True

    def __init__(self, settings: BlobSettings | None = None):
        self.settings = settings or BlobSettings()
        self._rays: np.ndarray | None = None

    def inapplicable(self, recording: Recording) -> str | None:
        if not any(np.any(recording.depth_metres(frame)) for frame in {0, recording.num_frames // 2}):
            return "no depth"
        placed = (recording.reads.antenna >= 1) & (recording.reads.antenna <= len(recording.antennas_m))
        if not np.any(placed & np.isfinite(recording.reads.carrier_hz)):
            return "no read of known carrier by an antenna of known position"
        return None

    def init(self, camera: HostCamera) -> BlobState:
        return BlobState()

    def step(self, camera: HostCamera, state: BlobState, frame: HostFrame) -> tuple[BlobState, Trace]:
        settings = self.settings
        if frame.depth_m is None:
            raise ValueError("The blob tracer needs depth; found a frame without.")
        elapsed_s = frame.time_s - state.time_s if np.isfinite(state.time_s) else 0.0
        moving, background = foreground(state.background, frame.colour, frame.depth_m, elapsed_s, settings)
        tracks: tuple[Track, ...] = ()
        number, rays = state.next_number, self._rays_of(camera)
        for part, edge_m in ((False, settings.whole_edge_m), (True, settings.part_edge_m)):
            blobs = connected_parts(moving, frame.depth_m, rays, edge_m, settings.min_area_m2, bridge=not part)
            own = [one for one in state.tracks if one.part == part]
            followed, number = follow(own, blobs, frame.time_s, elapsed_s, number, settings, part=part)
            tracks += followed
        seen = {track.number: track.position_m for track in tracks if track.blob is not None}
        begin_s = frame.time_s - settings.memory_s
        usable = np.isfinite(frame.reads.carrier_hz) & (frame.reads.antenna >= 1)
        usable &= frame.reads.antenna <= len(camera.antennas_m)
        kept = state.read_time_s >= begin_s
        after = BlobState(
            background=background,
            tracks=tracks,
            next_number=number,
            time_s=frame.time_s,
            positions=(*(one for one in state.positions if one[0] >= begin_s), (frame.time_s, seen)),
            reads=concatenate_reads([state.reads[kept], frame.reads[usable]]),
            read_time_s=np.concatenate([state.read_time_s[kept], frame.read_time_s[usable]]),
        )
        shape = (frame.depth_m.shape[0], frame.depth_m.shape[1])
        return after, trace_from_detections(self._detections(camera, after, shape), shape)

    def finish(self, state: BlobState) -> BlobState:
        return dataclasses.replace(state, tracks=tuple(dataclasses.replace(one, blob=None) for one in state.tracks))

    def _rays_of(self, camera: HostCamera) -> np.ndarray:
        if self._rays is None or self._rays.shape[:2] != (camera.intrinsics.height, camera.intrinsics.width):
            self._rays = pixel_rays(camera.intrinsics)
        return self._rays

    def _detections(self, camera: HostCamera, state: BlobState, shape: tuple[int, int]) -> list[Detection | None]:
        """Each tag's track of this frame, by the best assignment of tags to tracks that explain their phases."""
        settings = self.settings
        old = [one for one in state.tracks if one.blob is not None and state.time_s - one.born_s >= settings.confirm_s]
        evidence = np.zeros((len(camera.epcs), len(old)))
        for tag, epc in enumerate(camera.epcs):
            evidence[tag] = self._evidence(camera, state, epc, [one.number for one in old])
        chosen = hard_assignment(evidence, unmatched_score=settings.min_evidence)
        part = np.array([one.part for one in old], bool)
        found: list[Detection | None] = []
        for tag, column in enumerate(chosen):
            blob = old[column].blob if column >= 0 else None
            if blob is None:
                found.append(None)
                continue
            # A body and its part have nearly the same evidence and are no alternatives: each has its own confidence.
            alternatives = np.append(evidence[tag, part == part[column]], 0.0)
            confidence = float(np.exp(evidence[tag, column] - np.logaddexp.reduce(alternatives)))
            step_m = self._last_step_m(camera, state, old[column].number)
            found.append(Detection(blob.full_mask(shape), old[column].position_m, confidence, step_m=step_m))
        return found

    def _evidence(
        self, camera: HostCamera, state: BlobState, epc: str, numbers: list[int]
    ) -> Float[np.ndarray, " tracks"]:
        """The evidence of a tag's reads for each track."""
        own = state.reads.epc == epc
        reads, time_s = state.reads[own], state.read_time_s[own]
        if not reads.num_reads or not numbers:
            return np.zeros(len(numbers))
        range_m = np.stack([self._range_m(camera, state, number, reads, time_s) for number in numbers])
        phase, pairs = range_phase_rad(reads), np.stack([reads.antenna, reads.carrier_hz])
        channel = np.unique(pairs, axis=1, return_inverse=True)[1].reshape(-1)
        return coherent_evidence(phase, reads.carrier_hz, channel, range_m, self.settings.phase_std_rad)

    @staticmethod
    def _range_m(
        camera: HostCamera, state: BlobState, number: int, reads: TagReads, time_s: np.ndarray
    ) -> Float[np.ndarray, " reads"]:
        """A track's range to each read's antenna, linear between frames; NaN where it was not seen."""
        when = np.array([time for time, seen in state.positions if number in seen])
        place = np.array([seen[number] for _, seen in state.positions if number in seen])
        at = np.stack([np.interp(time_s, when, column, left=np.nan, right=np.nan) for column in place.T], axis=1)
        return np.linalg.norm(at - camera.antennas_m[reads.antenna - 1], axis=1)

    @staticmethod
    def _last_step_m(camera: HostCamera, state: BlobState, number: int) -> float:
        """The change of a track's range to the first antenna since the frame before; 0 where it was not seen then."""
        if len(state.positions) < 2 or number not in state.positions[-2][1]:
            return 0.0
        before, now = (np.linalg.norm(seen[number] - camera.antennas_m[0]) for _, seen in state.positions[-2:])
        return float(now - before)
