"""Goller et al. whole: from a recording and a calibration to tags' places, their blobs and the alarms."""

from __future__ import annotations

import dataclasses
import json
import reprlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from ...recording import Recording
from ._alarm import exit_score, rssi_score
from ._antennas import FLOOR_DBM, AntennaModel, fit_antennas
from ._association import AssociationModel, associate, make_association
from ._blobs import BlobSettings, BlobTracker, BlobTracks, in_slots
from ._location import FloorGrid, Location, LocationModel, locate, make_grid, make_location
from ._reads import RssiFrames, grid_statistic, rssi_frames
from ._site import find_site


@dataclasses.dataclass(frozen=True)
class GollerSettings:
    """What is fixed at a site, beside what calibration fits."""

    blobs: BlobSettings = dataclasses.field(default_factory=BlobSettings)
    period_s: float = 0.5  # of RSSI means: the reader visits every antenna within it
    cell_m: float = 0.2  # of the floor grid
    margin_m: tuple[float, float] = (2.0, 1.6)  # of the floor beyond the antennas, x and y
    num_slots: int = 6  # blobs at a time
    exit_x_m: float = 0.0  # the exit region is below it: beyond antenna 1
    exit_antenna: int = 1  # of the RFID-only rule


class Calibration(eqx.Module):
    """What is fitted: antennas and location, association, and the two thresholds."""

    location: LocationModel
    association: AssociationModel
    alarm_threshold: Float[Array, ""]  # of `exit_score`
    rssi_threshold_dbm: Float[Array, ""]  # of `rssi_score`


def calibrate(recording: Recording, *, floor_dbm: float = FLOOR_DBM, fit_means: bool = False) -> Calibration:
    """The antennas from a recording of a tag grid (III.D); everything else at its starting value.

    Raises `RecordingError` where the recording holds no places of its tag, `ValueError` where they do not suffice.
    """
    site = find_site(recording)
    statistic = grid_statistic(recording, site)
    places = site.to_room(np.asarray(recording.antennas_m, np.float64))[:, :2]
    antennas = fit_antennas(statistic.position_m, statistic.mean_dbm, places, floor_dbm=floor_dbm, fit_means=fit_means)
    return Calibration(make_location(antennas), make_association(), jnp.asarray(0.5), jnp.asarray(-60.0))


def save_calibration(calibration: Calibration, path: str | Path) -> None:
    """Write a calibration as JSON."""
    leaves = {jax.tree_util.keystr(key): np.asarray(leaf).tolist() for key, leaf in _leaves(calibration)}
    Path(path).write_text(json.dumps(leaves, indent=1) + "\n")


def load_calibration(path: str | Path) -> Calibration:
    """Read a calibration. Raises `ValueError` where there is none, or not this one's finite numbers."""
    try:
        found = json.loads(Path(path).read_text())
        skew_m = found[".location.antennas.skew_m"]
        if not isinstance(skew_m, list) or not skew_m:
            raise ValueError(f"skew_m is {reprlib.repr(skew_m)}; expected a number for each antenna")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(
            f"{path}: no calibration ({type(error).__name__}: {error}). Calibrate from a tag grid: experiments.goller does."
        ) from error
    num = len(skew_m)
    antennas = AntennaModel(jnp.zeros((num, 2)), jnp.zeros((num, 2)), jnp.zeros(num), jnp.zeros(num), jnp.zeros(()))
    like = Calibration(make_location(antennas), make_association(), jnp.zeros(()), jnp.zeros(()))
    wanted = {jax.tree_util.keystr(key): np.shape(leaf) for key, leaf in _leaves(like)}
    if sorted(wanted) != sorted(found):
        raise ValueError(f"{path}: holds {', '.join(sorted(found))}; expected {', '.join(sorted(wanted))}.")
    leaves = [_numbers(found[name], shape, f"{path}: {name}") for name, shape in wanted.items()]
    return jax.tree_util.tree_unflatten(jax.tree_util.tree_structure(like), leaves)


def _numbers(value: Any, shape: tuple[int, ...], where: str) -> Array:
    """Finite numbers of that shape, as lists of lists."""
    try:
        array = np.asarray(value)
    except ValueError:  # ragged
        array = np.asarray(None)
    if array.dtype.kind not in "iuf" or array.shape != shape:
        held = f"has shape {array.shape}" if array.dtype.kind in "iuf" else f"is {reprlib.repr(value)}"
        raise ValueError(f"{where} {held}; expected numbers of shape {shape}. Calibrate again.")
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    if not np.all(np.isfinite(array)):
        raise ValueError(
            f"{where} holds {int(np.sum(~np.isfinite(array)))} values that are not finite. Calibrate again."
        )
    return jnp.asarray(array)


def _leaves(calibration: Calibration) -> list[tuple[Any, Any]]:
    return jax.tree_util.tree_leaves_with_path(calibration)


@dataclasses.dataclass(frozen=True)
class Observations:
    """What both sensors saw of a recording, before any model: reads by frame, blobs by frame."""

    name: str
    epcs: tuple[str, ...]
    time_s: Float[np.ndarray, " time"]
    rssi: RssiFrames
    blobs: BlobTracks


class Decision(eqx.Module):
    """What the models make of a recording's tags; arrays lead with the tag axis."""

    location: Location  # (tag, time, ...)
    probability: Float[Array, "*tag time states"]  # background, then slots
    exit_score: Float[Array, "*tag time"]
    rssi_score: Float[Array, "*tag time"]


def empty_picture(recording: Recording, num_frames: int = 50) -> UInt8[np.ndarray, "height width 3"]:
    """What every pixel shows most steadily over the recording: stands for the empty scene that a mounted camera knows.

    The middle of the tightest half of a pixel's brightnesses (the "shorth"): unlike the median it holds where people who
    come along the picture's columns cover a pixel for half of the time. It looks ahead, yet only at what does not move.
    """
    some = np.unique(np.linspace(0, recording.num_frames - 1, min(recording.num_frames, num_frames)).astype(int))
    pictures = np.stack([np.asarray(recording.colour[int(frame)]) for frame in some])
    grey = np.sum(pictures, axis=-1, dtype=np.uint16)
    order = np.argsort(grey, axis=0, kind="stable")
    level = np.take_along_axis(grey, order, axis=0)
    half = len(some) // 2 + 1
    start = np.argmin(level[half - 1 :] - level[: len(some) - half + 1], axis=0)
    middle = range(half // 3, max(half - half // 3, half // 3 + 1))
    total = np.zeros(pictures.shape[1:], np.float32)
    for offset in middle:
        chosen = np.take_along_axis(order, (start + offset)[None], axis=0)
        total += np.take_along_axis(pictures, chosen[..., None], axis=0)[0]
    return np.clip(np.rint(total / len(middle)), 0, 255).astype(np.uint8)


def observe(
    recording: Recording, settings: GollerSettings, epcs: Sequence[str] | None = None, *, keep_labels: bool = False
) -> Observations:
    """Run both sensors over a recording: RSSI means, foreground, blobs; which pixels are whose if `keep_labels`.

    A recording without tags, or without blobs, gives observations without them. Raises `RecordingError` for an EPC that
    was never read, or where the floor is not found.
    """
    names = tuple(recording.resolve_epcs(epcs))
    site = find_site(recording)
    tracker = BlobTracker(settings.blobs, site, recording.intrinsics)
    if settings.blobs.warm_up == "empty":
        tracker.warm_up(empty_picture(recording))
    time_s = recording.frame_time_s()
    no_depth = np.zeros(recording.image_shape, np.float32)
    frames, labels = [], []
    for frame in range(recording.num_frames):
        depth = recording.depth_metres(frame) if settings.blobs.position == "depth" else no_depth
        blobs, identity = tracker.step(np.asarray(recording.colour[frame]), depth, float(time_s[frame]))
        frames.append(blobs)
        if keep_labels:
            labels.append(identity.astype(np.uint16))
    num_antennas = len(recording.antennas_m)
    return Observations(
        name=recording.name,
        epcs=names,
        time_s=time_s.astype(np.float32),
        rssi=rssi_frames(recording.reads, names, recording.time_ns, num_antennas, period_s=settings.period_s),
        blobs=in_slots(frames, settings.num_slots, labels=np.stack(labels) if keep_labels else None),
    )


def floor_grid(calibration: Calibration, settings: GollerSettings) -> FloorGrid:
    """The floor that tags are looked for on: around the calibrated antennas."""
    places, margin = np.asarray(calibration.location.antennas.mean_m), np.asarray(settings.margin_m)
    low, high = places.min(axis=0) - margin, places.max(axis=0) + margin
    return make_grid((float(low[0]), float(low[1])), (float(high[0]), float(high[1])), settings.cell_m)


def decide(calibration: Calibration, seen: Observations, settings: GollerSettings) -> Decision:
    """Places, assignments and exit scores of all tags of a recording.

    Raises `ValueError` where the calibration is of another number of antennas.
    """
    blobs = jnp.asarray(seen.blobs.position_m), jnp.asarray(seen.blobs.identity)
    return _decide(prepared(calibration, seen, settings), *blobs, settings.exit_antenna)


class Prepared(eqx.Module):
    """A recording's reads beside the models that are asked of them; tags lead."""

    location: LocationModel
    association: AssociationModel
    grid: FloorGrid
    time_s: Float[Array, " time"]
    rssi_dbm: Float[Array, "*tag time antennas"]
    heard: Bool[Array, "*tag time antennas"]
    exit_x_m: Float[Array, ""]


def prepared(calibration: Calibration, seen: Observations, settings: GollerSettings) -> Prepared:
    """What was heard of a recording's tags, as the models take it.

    Raises `ValueError` where the calibration is of another number of antennas.
    """
    num = seen.rssi.heard.shape[2]
    calibrated = calibration.location.antennas.mean_m.shape[0]
    if num != calibrated:
        raise ValueError(
            f"{seen.name}: {num} antennas, calibrated are {calibrated}. Calibrate with this site's tag grid."
        )
    return Prepared(
        calibration.location,
        calibration.association,
        floor_grid(calibration, settings),
        jnp.asarray(seen.time_s),
        jnp.asarray(np.moveaxis(seen.rssi.rssi_dbm, 1, 0)),
        jnp.asarray(np.moveaxis(seen.rssi.heard, 1, 0)),
        jnp.asarray(settings.exit_x_m, jnp.float32),
    )


@eqx.filter_jit
def _decide(
    given: Prepared, blob_m: Float[Array, "time slots 2"], identity: Int[Array, "time slots"], exit_antenna: int
) -> Decision:
    def one(rssi, by):
        path = locate(given.location, given.grid, given.time_s, rssi, by)
        held = associate(
            given.association, given.time_s, path.position_m, path.velocity_m_s, path.heard, blob_m, identity
        )
        score = exit_score(held.probability, blob_m, identity, given.exit_x_m)
        return Decision(path, held.probability, score, rssi_score(rssi, by, exit_antenna))

    return jax.vmap(one)(given.rssi_dbm, given.heard)


def peak(score: Float[Array, "tag time"]) -> Float[np.ndarray, " tag"]:
    """The highest score of each tag: an alarm, once raised, stays."""
    return np.max(np.asarray(score), axis=1, initial=-np.inf)
