"""Goller et al. as a tracer: a tag is the motion blob that most probably carries it, or nowhere if it is background."""

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
from .._interface import AbstractHostTracer, Claim, HostCamera, HostFrame, claims_to_trace
from ._association import AssociationModel, HeldState, assignment_row, forward_start, forward_step
from ._blobs import Blob, BlobTracker, in_slots
from ._location import FloorGrid, LocationModel, LocationState, locate_start, locate_step
from ._reads import mean_rssi
from ._site import Site, find_site, level_site
from ._system import Calibration, GollerSettings, empty_picture, floor_grid


@dataclasses.dataclass(frozen=True)
class Reads:
    """Columns of recent reads, in order of time."""

    tag: Int[np.ndarray, " reads"]
    antenna: Int[np.ndarray, " reads"]  # from 0
    time_ns: Int[np.ndarray, " reads"]  # from the recording's first frame
    rssi_dbm: Float[np.ndarray, " reads"]

    def joined(self, epcs: tuple[str, ...], frame: HostFrame, period_s: float) -> Reads:
        """With a frame's reads, without those that the observation period up to it leaves out."""
        told = np.isfinite(frame.reads.rssi_dbm)
        number = {epc: tag for tag, epc in enumerate(epcs)}
        columns = (
            np.array([number[str(epc)] for epc in frame.reads.epc[told]], np.int64),
            frame.reads.antenna[told].astype(np.int64) - 1,
            np.rint(frame.read_time_s[told] * 1e9).astype(np.int64),
            frame.reads.rssi_dbm[told].astype(np.float64),
        )
        before = (self.tag, self.antenna, self.time_ns, self.rssi_dbm)
        every = [np.concatenate(pair) for pair in zip(before, columns, strict=True)]
        kept = every[2] > round((frame.time_s - period_s) * 1e9)
        return Reads(*(column[kept] for column in every))


@dataclasses.dataclass
class GollerState:
    """The blob tracker (OpenCV's, which goes on in place), recent reads, and every tag's filters."""

    tracker: BlobTracker
    grid: FloorGrid
    reads: Reads  # of the last observation period
    location: LocationState  # tags first
    held: HeldState  # tags first
    names: tuple[int, ...]  # who is in the slots
    range_m: dict[int, float]  # of each blob to antenna 1
    time_s: float | None = None
    spent: bool = False


class GollerTracer(AbstractHostTracer):
    """Calibrated antennas, blobs and association, one frame at a time.

    `site` and `empty` are what commissioning finds, see `at`; without them the camera counts as level, `antenna_height_m`
    below the antennas is the floor, and the background is learnt from the first frame on. Blobs are placed monocularly.
    """

    def __init__(
        self,
        calibration: Calibration,
        settings: GollerSettings | None = None,
        *,
        site: Site | None = None,
        empty: UInt8[np.ndarray, "height width 3"] | None = None,
        antenna_height_m: float = 2.8,
    ):
        self.calibration, self.settings = calibration, settings or GollerSettings()
        self.site, self.empty, self.antenna_height_m = site, empty, antenna_height_m
        if self.settings.blobs.position == "depth":
            raise ValueError("A tracer sees no depth: blobs.position is 'depth'; expected 'foot' or 'centre'.")

    def at(self, recording: Recording) -> GollerTracer:
        """This tracer, commissioned for a recording's site: its floor by depth, and its `empty_picture`."""
        return GollerTracer(self.calibration, self.settings, site=find_site(recording), empty=empty_picture(recording))

    def inapplicable(self, recording: Recording) -> str | None:
        num, calibrated = len(recording.antennas_m), self.calibration.location.antennas.mean_m.shape[0]
        if num < 2:
            return f"location by proximity needs several antennas; there is {num}"
        if num != calibrated:
            return f"{num} antennas, calibrated are {calibrated}"
        if not np.isfinite(recording.reads.rssi_dbm).any():
            return "the reads hold no RSSI"
        if self.site is None:
            try:
                level_site(recording.antennas_m, self.antenna_height_m)
            except ValueError:
                return "no room frame without depth: the antennas must hang in a line that is not the picture's rows"
        return None

    def init(self, camera: HostCamera) -> GollerState:
        site = level_site(camera.antennas_m, self.antenna_height_m) if self.site is None else self.site
        tracker = BlobTracker(self.settings.blobs, site, camera.intrinsics)
        if self.empty is not None:
            tracker.warm_up(self.empty)
        grid = floor_grid(self.calibration, self.settings)
        num = len(camera.epcs)
        repeat = lambda tree: jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (num, *leaf.shape)), tree)  # noqa: E731
        return GollerState(
            tracker=tracker,
            grid=grid,
            reads=Reads(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)),
            location=repeat(locate_start(grid)),
            held=repeat(forward_start(self.settings.num_slots)),
            names=(0,) * self.settings.num_slots,
            range_m={},
        )

    def step(self, camera: HostCamera, state: GollerState, frame: HostFrame) -> tuple[GollerState, Trace]:
        """The next state and this frame's `Trace`. A state can be stepped once: raises `ValueError` the second time."""
        if state.spent:
            raise ValueError("This state was stepped already, and its background model with it; go on from the newest.")
        state.spent = True
        height, width = camera.intrinsics.height, camera.intrinsics.width
        nothing = np.zeros((height, width), np.float32)
        blobs, labels = state.tracker.step(frame.colour, nothing, frame.time_s)
        slots = in_slots([blobs], self.settings.num_slots, before=state.names)
        period_s, shape = self.settings.period_s, (len(camera.epcs), len(camera.antennas_m))
        reads = state.reads.joined(camera.epcs, frame, period_s)
        now_ns = np.array([round(frame.time_s * 1e9)])
        rssi = mean_rssi(reads.tag, reads.antenna, reads.time_ns, reads.rssi_dbm, now_ns, shape, period_s)
        elapsed = 0.0 if state.time_s is None else frame.time_s - state.time_s
        location, held, probability = _advance(
            self.calibration.location,
            self.calibration.association,
            state.grid,
            state.location,
            state.held,
            jnp.asarray(elapsed, jnp.float32),
            jnp.asarray(rssi.rssi_dbm[0]),
            jnp.asarray(rssi.heard[0]),
            jnp.asarray(slots.position_m[0]),
            jnp.asarray(slots.identity[0]),
        )
        site = level_site(camera.antennas_m, self.antenna_height_m) if self.site is None else self.site
        places, ranges = self._places(site, camera, blobs)
        likely = np.asarray(probability)
        claims: list[Claim | None] = []
        for row in likely:
            best = int(np.argmax(row))
            identity = int(slots.identity[0, best - 1]) if best else 0
            if not identity:
                claims.append(None)
                continue
            step_m = ranges[identity] - state.range_m.get(identity, ranges[identity])
            claims.append(
                Claim(labels == identity, places[identity], float(row[best]), slots.box_px[0, best - 1], step_m)
            )
        names = tuple(int(name) for name in slots.identity[0])
        after = GollerState(state.tracker, state.grid, reads, location, held, names, ranges, frame.time_s)
        return after, claims_to_trace(claims, (height, width))

    def finish(self, state: GollerState) -> GollerState:
        """The state as it is: nothing in it is a past frame's picture."""
        return copy.copy(state)

    def _places(
        self, site: Site, camera: HostCamera, blobs: list[Blob]
    ) -> tuple[dict[int, np.ndarray], dict[int, float]]:
        """Each blob's middle in the camera frame, and its distance to antenna 1."""
        middle = 0.5 * self.settings.blobs.person_height_m
        places = {blob.identity: site.to_camera(np.append(blob.position_m, middle)[None])[0] for blob in blobs}
        return places, {name: float(np.linalg.norm(at - camera.antennas_m[0])) for name, at in places.items()}


@eqx.filter_jit
def _advance(
    location: LocationModel,
    association: AssociationModel,
    grid: FloorGrid,
    where: LocationState,
    held: HeldState,
    elapsed_s: Float[Array, ""],
    rssi_dbm: Float[Array, "tag antennas"],
    heard: Bool[Array, "tag antennas"],
    blob_m: Float[Array, "slots 2"],
    identity: Int[Array, " slots"],
) -> tuple[LocationState, HeldState, Float[Array, "tag states"]]:
    def one(where, held, rssi, by):
        where, here = locate_step(location, grid, where, elapsed_s, rssi, by)
        row = assignment_row(association, here.position_m, here.velocity_m_s, blob_m)
        held, out = forward_step(association, held, elapsed_s, row, identity, here.heard)
        return where, held, out.probability

    return jax.vmap(one)(where, held, rssi_dbm, heard)
