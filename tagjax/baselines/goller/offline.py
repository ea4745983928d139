"""Goller et al.'s system over a whole recording: observations of both sensors, then location, association and
alarms.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ...recording import Recording
from .alarm import exit_score, rssi_score
from .calibration import Calibration, floor_grid
from .detection import empty_scene
from .location import FloorGrid, Location, LocationModel, locate
from .matching import AssociationModel, associate
from .room import find_room_frame
from .rssi import RssiFrames, mean_rssi, rssi_reads
from .settings import GollerSettings
from .slots import BlobTracks, assign_slots
from .tracks import BlobTracker


@dataclasses.dataclass(frozen=True)
class Observations:
    """The measurements of both sensors, before any model: RSSI and blobs of every frame."""

    name: str
    epcs: tuple[str, ...]
    time_s: Float[np.ndarray, " time"]
    rssi: RssiFrames
    blobs: BlobTracks


class Estimates(eqx.Module):
    """What the models estimate of a recording's tags; arrays lead with the tag axis."""

    location: Location  # (tag, time, ...)
    probability: Float[Array, "*tag time states"]  # background, then slots
    exit_score: Float[Array, "*tag time"]
    rssi_score: Float[Array, "*tag time"]


class ModelInputs(eqx.Module):
    """The models and a recording's RSSI as JAX arrays; tags lead."""

    location: LocationModel
    association: AssociationModel
    grid: FloorGrid
    time_s: Float[Array, " time"]
    rssi_dbm: Float[Array, "*tag time antennas"]
    received: Bool[Array, "*tag time antennas"]
    exit_x_m: Float[Array, ""]


def observe(
    recording: Recording, settings: GollerSettings, epcs: Sequence[str] | None = None, *, keep_labels: bool = False
) -> Observations:
    """Run both sensors over a recording: RSSI means and blobs; each pixel's blob as well if `keep_labels`.

    A recording without tags, or without blobs, gives observations without them. Raises `RecordingError` for an EPC that
    was never read, or where the floor is not found.
    """
    traced = tuple(recording.resolve_epcs(epcs))
    tracker = BlobTracker(settings.blobs, find_room_frame(recording), recording.intrinsics)
    if settings.blobs.warm_up == "empty":
        tracker.warm_up(empty_scene(recording))
    time_s = recording.frame_time_s()
    no_depth = np.zeros(recording.image_shape, np.float32)
    frames, labels = [], []
    for frame in range(recording.num_frames):
        depth = recording.depth_metres(frame) if settings.blobs.position == "depth" else no_depth
        blobs, identity = tracker.step(np.asarray(recording.colour[frame]), depth, float(time_s[frame]))
        frames.append(blobs)
        if keep_labels:
            labels.append(identity.astype(np.uint16))
    shape = len(traced), len(recording.antennas_m)
    reads = rssi_reads(recording.reads, traced)
    return Observations(
        name=recording.name,
        epcs=traced,
        time_s=time_s.astype(np.float32),
        rssi=mean_rssi(reads, recording.time_ns, shape, settings.period_s),
        blobs=assign_slots(frames, settings.num_slots, labels=np.stack(labels) if keep_labels else None),
    )


def model_inputs(calibration: Calibration, observed: Observations, settings: GollerSettings) -> ModelInputs:
    """A recording's RSSI beside the calibrated models. Raises `ValueError` for another number of antennas."""
    num = observed.rssi.received.shape[2]
    if num != calibration.num_antennas:
        raise ValueError(
            f"{observed.name}: {num} antennas, calibrated are {calibration.num_antennas}. Calibrate with this site's tag "
            "grid."
        )
    return ModelInputs(
        calibration.location,
        calibration.association,
        floor_grid(calibration, settings),
        jnp.asarray(observed.time_s),
        jnp.asarray(np.moveaxis(observed.rssi.rssi_dbm, 1, 0)),
        jnp.asarray(np.moveaxis(observed.rssi.received, 1, 0)),
        jnp.asarray(settings.exit_x_m, jnp.float32),
    )


def estimate(calibration: Calibration, observed: Observations, settings: GollerSettings) -> Estimates:
    """Locations, assignments and exit scores of all tags of a recording. Raises `ValueError` as `model_inputs` does."""
    blobs = jnp.asarray(observed.blobs.position_m), jnp.asarray(observed.blobs.identity)
    return _estimate(model_inputs(calibration, observed, settings), *blobs, settings.exit_antenna)


@eqx.filter_jit
def _estimate(
    inputs: ModelInputs, blob_m: Float[Array, "time slots 2"], identity: Int[Array, "time slots"], exit_antenna: int
) -> Estimates:
    def one_tag(rssi_dbm: Float[Array, "time antennas"], received: Bool[Array, "time antennas"]) -> Estimates:
        path = locate(inputs.location, inputs.grid, inputs.time_s, rssi_dbm, received)
        states = associate(
            inputs.association, inputs.time_s, path.position_m, path.velocity_m_s, path.received, blob_m, identity
        )
        score = exit_score(states.probability, blob_m, identity, inputs.exit_x_m)
        return Estimates(path, states.probability, score, rssi_score(rssi_dbm, received, exit_antenna))

    return jax.vmap(one_tag)(inputs.rssi_dbm, inputs.received)


def peak(score: Float[Array, "tag time"]) -> Float[np.ndarray, " tag"]:
    """The highest score of each tag: an alarm, once raised, stays raised."""
    return np.max(np.asarray(score), axis=1, initial=-np.inf)
