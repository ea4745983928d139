"""Goller et al. as a tracer: a tag's object is the blob that most probably carries it, or none if it is background."""

from __future__ import annotations

import copy
import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ...recording import Recording
from ...tracing.tracer import Trace
from ..host_tracer import AbstractHostTracer, Detection, HostCamera, HostFrame, trace_from_detections
from .calibration import Calibration, floor_grid
from .detection import empty_scene
from .location import FloorGrid, LocationModel, LocationState, locate_start, locate_step
from .matching import AssociationModel, AssociationState, assignment_row, forward_start, forward_step
from .room import RoomFrame, find_room_frame, level_room_frame
from .rssi import RssiReads, mean_rssi, rssi_reads
from .settings import GollerSettings
from .slots import BlobTracks, assign_slots
from .tracks import Blob, BlobTracker


@dataclasses.dataclass
class GollerState:
    """The blob tracker (OpenCV's, updated in place), recent reads, and every tag's filters."""

    tracker: BlobTracker
    grid: FloorGrid
    reads: RssiReads  # of the last observation period, times since the recording's first frame
    location: LocationState  # tags first
    association: AssociationState  # tags first
    slots: tuple[int, ...]  # identities of the blobs in the slots
    range_m: dict[int, float]  # of each blob to antenna 1
    time_s: float | None = None
    consumed: bool = False


class GollerTracer(AbstractHostTracer):
    """Calibrated antennas, blobs and association, one frame at a time.

    `room` and `empty` come from an installation at the site, see `install`. Without them the camera is taken to be
    level, the floor to be `antenna_height_m` below the antennas, and the background is learned from the first frame on.
    Blobs are located without depth.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: GollerSettings | None = None,
        *,
        room: RoomFrame | None = None,
        empty: UInt8[np.ndarray, "height width 3"] | None = None,
        antenna_height_m: float = 2.8,
    ):
        self.calibration, self.settings = calibration, settings or GollerSettings()
        self.room, self.empty, self.antenna_height_m = room, empty, antenna_height_m
        if self.settings.blobs.position == "depth":
            raise ValueError("blobs.position is 'depth', which this tracer does not see; expected 'foot' or 'centre'.")

    def install(self, recording: Recording) -> GollerTracer:
        """This tracer for the site of a recording: its floor from depth, and its `empty_scene`."""
        room = find_room_frame(recording)
        return GollerTracer(self.calibration, self.settings, room=room, empty=empty_scene(recording))

    def inapplicable(self, recording: Recording) -> str | None:
        num = len(recording.antennas_m)
        if num < 2:
            return f"location by proximity needs several antennas; there is {num}"
        if num != self.calibration.num_antennas:
            return f"{num} antennas, calibrated are {self.calibration.num_antennas}"
        if not np.isfinite(recording.reads.rssi_dbm).any():
            return "the reads hold no RSSI"
        if self.room is None:
            try:
                level_room_frame(recording.antennas_m, self.antenna_height_m)
            except ValueError:
                return "no room frame without depth: the antennas must hang in a line that is not the picture's rows"
        return None

    def init(self, camera: HostCamera) -> GollerState:
        tracker = BlobTracker(self.settings.blobs, self._room(camera), camera.intrinsics)
        if self.empty is not None:
            tracker.warm_up(self.empty)
        grid = floor_grid(self.calibration, self.settings)
        num = len(camera.epcs)
        repeat = lambda tree: jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), tree)  # noqa: E731
        return GollerState(
            tracker=tracker,
            grid=grid,
            reads=RssiReads(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)),
            location=repeat(locate_start(grid)),
            association=repeat(forward_start(self.settings.num_slots)),
            slots=(0,) * self.settings.num_slots,
            range_m={},
        )

    def step(self, camera: HostCamera, state: GollerState, frame: HostFrame) -> tuple[GollerState, Trace]:
        """The next state and this frame's `Trace`. Raises `ValueError` where the same state is stepped a second
        time.
        """
        if state.consumed:
            raise ValueError(
                "This state was stepped already, which changed its background model. Step the newest state."
            )
        state.consumed = True
        shape = camera.intrinsics.height, camera.intrinsics.width
        blobs, labels = state.tracker.step(frame.colour, np.zeros(shape, np.float32), frame.time_s)
        slots = assign_slots([blobs], self.settings.num_slots, previous=state.slots)
        reads = self._recent_reads(camera, state, frame)
        now_ns, counts = np.array([round(frame.time_s * 1e9)]), (len(camera.epcs), len(camera.antennas_m))
        rssi = mean_rssi(reads, now_ns, counts, self.settings.period_s)
        elapsed_s = 0.0 if state.time_s is None else frame.time_s - state.time_s
        location, association, probability = _advance(
            self.calibration.location,
            self.calibration.association,
            state.grid,
            state.location,
            state.association,
            jnp.asarray(elapsed_s, jnp.float32),
            jnp.asarray(rssi.rssi_dbm[0]),
            jnp.asarray(rssi.received[0]),
            jnp.asarray(slots.position_m[0]),
            jnp.asarray(slots.identity[0]),
        )
        positions, ranges = self._positions(camera, blobs)
        detections: list[Detection | None] = []
        for row in np.asarray(probability):
            identity, confidence, slot = _most_probable(row, slots)
            if not identity:
                detections.append(None)
                continue
            step_m = ranges[identity] - state.range_m.get(identity, ranges[identity])
            box_px = slots.box_px[0, slot]
            detections.append(Detection(labels == identity, positions[identity], confidence, box_px, step_m))
        identities = tuple(int(one) for one in slots.identity[0])
        after = GollerState(state.tracker, state.grid, reads, location, association, identities, ranges, frame.time_s)
        return after, trace_from_detections(detections, shape)

    def finish(self, state: GollerState) -> GollerState:
        return copy.copy(state)

    def _room(self, camera: HostCamera) -> RoomFrame:
        return level_room_frame(camera.antennas_m, self.antenna_height_m) if self.room is None else self.room

    def _recent_reads(self, camera: HostCamera, state: GollerState, frame: HostFrame) -> RssiReads:
        """The reads of the observation period that ends with a frame."""
        time_ns = np.rint(frame.read_time_s * 1e9).astype(np.int64)
        every = state.reads.append(rssi_reads(frame.reads, camera.epcs, time_ns))
        return every[every.time_ns > round((frame.time_s - self.settings.period_s) * 1e9)]

    def _positions(
        self, camera: HostCamera, blobs: list[Blob]
    ) -> tuple[dict[int, Float[np.ndarray, " 3"]], dict[int, float]]:
        """The middle of each blob's person in the camera frame, and its distance to antenna 1."""
        room, middle = self._room(camera), 0.5 * self.settings.blobs.person_height_m
        positions = {blob.identity: room.to_camera(np.append(blob.position_m, middle)[None])[0] for blob in blobs}
        ranges = {one: float(np.linalg.norm(position - camera.antennas_m[0])) for one, position in positions.items()}
        return positions, ranges


def _most_probable(probability: Float[np.ndarray, " states"], slots: BlobTracks) -> tuple[int, float, int]:
    """Identity (0 for the background), probability and slot of a tag's most probable blob."""
    best = int(np.argmax(probability))
    identity = int(slots.identity[0, best - 1]) if best else 0
    return identity, float(probability[best]), best - 1


@eqx.filter_jit
def _advance(
    location: LocationModel,
    association: AssociationModel,
    grid: FloorGrid,
    location_state: LocationState,
    association_state: AssociationState,
    elapsed_s: Float[Array, ""],
    rssi_dbm: Float[Array, "tag antennas"],
    received: Bool[Array, "tag antennas"],
    blob_m: Float[Array, "slots 2"],
    identity: Int[Array, " slots"],
) -> tuple[LocationState, AssociationState, Float[Array, "tag states"]]:
    """One frame of both filters for all tags."""

    def one_tag(where, states, rssi, by):
        where, here = locate_step(location, grid, where, elapsed_s, rssi, by)
        row = assignment_row(association, here.position_m, here.velocity_m_s, blob_m)
        states, out = forward_step(association, states, elapsed_s, row, identity, here.received)
        return where, states, out.probability

    return jax.vmap(one_tag)(location_state, association_state, rssi_dbm, received)
