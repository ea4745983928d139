"""An antenna's position in the camera frame, from a recording in which one tag is moved about.

The tag's path is the true one where the recording holds it, or that of the object which the tracer finds. The fit begins at the
best places of a grid and is refined from each: by all phases together, with one offset that is affine in the carrier's frequency
(`radio.affine_position`), or by the phases' changes within dwells or channels (`radio.antenna_position`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from ..core.progress import OnProgress, unobserved
from ..core.settings import ConfigError
from ..radio.affine_position import coherent_places, find_position
from ..radio.antenna_position import AntennaPosition, PathReads, fit_position, position_coherence
from ..radio.noise import thermal_sigma_rad
from ..recording import Recording, RecordingError, TagReads
from ..recording.store import open_recording
from ..tagattention.tracer_settings import make_tracer, tracer_clips
from ..tracing.clips import clip_loader
from ..tracing.recordings import TraceSettings, trace_recording
from .true_distance import at_times

MAX_DWELL_S = 0.5
"""A longer stay on one channel counts as several dwells: beginning and end need not share an offset."""

MIN_READS = 40
_GAP_S = 0.25
_NUM_STARTS = 24
_READ_SPREAD_RAD = 0.03  # of a read beside thermal noise, where reflections are counted by themselves
_MIN_COHERENCE = 0.5
_APART_M = 0.15
_SMOOTH_S = 0.15

_fit = eqx.filter_jit(fit_position)
_coherence = eqx.filter_jit(position_coherence)


@dataclasses.dataclass(frozen=True, kw_only=True)
class AntennaConfig:
    """The recording, the tag that is moved, and where the antenna may be."""

    recording: str
    epc: str
    tracer: Mapping[str, Any]  # settings as under conf/tracer; used where the path is traced
    antenna: int = 1  # counted from 1
    path: Literal["auto", "truth", "traced"] = "auto"  # auto: truth where the recording holds it
    # of the phases: affine in the carrier's frequency throughout, or one for each dwell, or for each channel
    offsets: Literal["affine", "dwell", "channel"] = "affine"
    reach_m: float = 1.5  # the antenna lies within this distance of the camera along each axis
    step_m: float = 0.15  # of the grid of starts
    spread_rad: float = 0.1  # phase errors beside thermal noise: reflections
    max_std_m: float = 0.1  # a fit that is less sure along any axis is refused

    def __post_init__(self) -> None:
        for name in ("reach_m", "step_m", "spread_rad", "max_std_m"):
            if not getattr(self, name) > 0:
                raise ConfigError(f"{name} is {getattr(self, name)}; expected a positive number.")
        if (places := (2 * self.reach_m / self.step_m + 1) ** 3) > 200_000:
            raise ConfigError(f"reach_m and step_m give {places:.0f} places; expected at most 200,000. Widen step_m.")


@dataclasses.dataclass(frozen=True)
class FoundAntenna:
    """The fitted position of the antenna, camera frame, with what there is to judge it by."""

    position_m: tuple[float, float, float]
    std_m: tuple[float, float, float]
    covariance_m2: tuple[tuple[float, ...], ...]
    noise_rad: float
    num_reads: int
    path: str  # truth or traced
    extent_m: tuple[float, float, float]  # of the tag's path
    rival_m: tuple[float, float, float] | None  # another place that explains the phases nearly as well
    recorded_m: tuple[float, float, float]  # the recording's own antenna position

    def lines(self) -> list[str]:
        """The result as text."""
        values = "  ".join(f"{one:+.3f} +- {std:.3f}" for one, std in zip(self.position_m, self.std_m, strict=True))
        apart = np.linalg.norm(np.subtract(self.position_m, self.recorded_m))
        rows = [
            f"antenna at x, y, z = {values} m (camera frame; standard deviations)",
            f"{self.num_reads} reads, path {self.path}, extent {_text(self.extent_m)} m, phase residuals {self.noise_rad:.3f} rad rms",
            f"the recording has it at {_text(self.recorded_m)} m, {apart:.3f} m away",
        ]
        if self.rival_m is not None:
            rows.append(
                f"AMBIGUOUS: {_text(self.rival_m)} m explains the phases nearly as well. Move the tag in all directions."
            )
        return rows


def _text(values: tuple[float, ...]) -> str:
    return ", ".join(f"{value:+.3f}" for value in values)


def calibrate_antenna(config: AntennaConfig, *, on_progress: OnProgress = unobserved) -> FoundAntenna:
    """Find the antenna. `on_progress` counts the frames of a path that is traced.

    Raises `RecordingError` for a tag or antenna without enough reads, for a path that is not known, and for a position that
    the recording does not determine.
    """
    recording = open_recording(config.recording)
    source, path_m = _path(recording, config, on_progress)
    return find_antenna(recording, path_m, config, source=source)


def find_antenna(recording: Recording, path_m: np.ndarray, config: AntennaConfig, *, source: str) -> FoundAntenna:
    """The antenna from a tag's path at every frame, (frames, 3) metres, NaN where unknown. Errors as `calibrate_antenna`."""
    if not 1 <= config.antenna <= len(recording.antennas_m):
        raise RecordingError(
            f"{recording.name}: antenna is {config.antenna}; expected 1 to {len(recording.antennas_m)}, as in antennas_m."
        )
    reads = recording.reads.select(config.epc)
    time_s = (reads.time_ns - recording.time_ns[0]) * 1e-9
    frame_s = recording.frame_time_s()
    place_m = np.stack([at_times(frame_s, column, time_s) for column in np.asarray(path_m, float).T], axis=-1)
    used = np.isfinite(place_m).all(axis=1) & np.isfinite(reads.carrier_hz) & (reads.antenna == config.antenna)
    if used.sum() < MIN_READS:
        raise RecordingError(
            f"{recording.name}: {used.sum()} reads of {config.epc} through antenna {config.antenna} at times at which its path "
            f"is known; expected at least {MIN_READS}. Move the tag about in view for ten seconds or more."
        )
    own = reads[used], time_s[used], place_m[used], config
    found = _affine(*own, name=recording.name) if config.offsets == "affine" else _by_groups(*own)
    std_m = np.sqrt(np.diagonal(found.covariance_m2))
    if not np.all(std_m <= config.max_std_m):
        extent = _text(_three(np.ptp(place_m[used], axis=0)))
        raise RecordingError(
            f"{recording.name}: the antenna's position has standard deviations of {_text(_three(std_m))} m; expected at most "
            f"{config.max_std_m:g}. The tag moved by {extent} m along x, y, z. Move it farther, along all three axes and near the "
            "antenna, for a minute, with nothing in between; set max_std_m to accept."
        )
    return FoundAntenna(
        position_m=_three(found.position_m),
        std_m=_three(std_m),
        covariance_m2=tuple(_three(row) for row in found.covariance_m2),
        noise_rad=found.noise_rad,
        num_reads=int(used.sum()),
        path=source,
        extent_m=_three(np.ptp(place_m[used], axis=0)),
        rival_m=None if found.rival_m is None else _three(found.rival_m),
        recorded_m=_three(recording.antennas_m[config.antenna - 1]),
    )


@dataclasses.dataclass(frozen=True)
class _Place:
    """A fitted place."""

    position_m: np.ndarray
    covariance_m2: np.ndarray
    noise_rad: float
    rival_m: np.ndarray | None


def _affine(reads: TagReads, time_s: np.ndarray, place_m: np.ndarray, config: AntennaConfig, *, name: str) -> _Place:
    """The place by all reads together. Raises `RecordingError`, before the long fits, where they agree with none."""
    own = path_reads(reads, time_s, place_m, offsets="channel", spread_rad=_READ_SPREAD_RAD)
    peaks = coherent_places(own, _grid(config))
    if peaks[0].coherence < _MIN_COHERENCE:
        raise RecordingError(
            f"{name}: the phases agree by {peaks[0].coherence:.2f} with the best place of the antenna; expected {_MIN_COHERENCE:g} of "
            "1. The path is wrong, much of it is hidden from the antenna, or the reader's offsets differ in each dwell: move the tag "
            "nearer, in the open, or set offsets=dwell."
        )
    found = find_position(own, peaks)
    if found is None:
        raise RecordingError(
            f"{name}: no fit of the antenna's position and of what reflections add has succeeded. Move the tag farther, along all "
            "three axes, or set offsets=dwell."
        )
    return _Place(found.best.position_m, found.covariance_m2, found.best.noise_rad, found.rival_m)


def _by_groups(reads: TagReads, time_s: np.ndarray, place_m: np.ndarray, config: AntennaConfig) -> _Place:
    """The place by changes within dwells, or within channels."""
    fits = _fits(reads, time_s, place_m, config)
    best, rival = fits[0], next((fit for fit in fits[1:] if _differs(fit, fits[0])), None)
    # A rival must explain the phases as well to a few times the cost's own spread.
    close = rival is not None and float(rival.cost) < float(best.cost) * (1 + 4 / np.sqrt(len(time_s)))
    return _Place(
        np.asarray(best.position_m, float),
        np.asarray(best.covariance_m2, float),
        float(best.noise_rad),
        np.asarray(rival.position_m, float) if rival is not None and close else None,
    )


def _grid(config: AntennaConfig) -> np.ndarray:
    """Places at which the antenna may be, (places, 3)."""
    along = np.arange(-config.reach_m, config.reach_m + 1e-9, config.step_m)
    return np.stack(np.meshgrid(along, along, along, indexing="ij"), axis=-1).reshape(-1, 3)


def _three(values: Any) -> tuple[float, float, float]:
    x, y, z = np.asarray(values, float).tolist()
    return x, y, z


def _differs(one: AntennaPosition, other: AntennaPosition) -> bool:
    return float(np.linalg.norm(np.asarray(one.position_m - other.position_m))) > _APART_M


def _fits(reads: TagReads, time_s: np.ndarray, place_m: np.ndarray, config: AntennaConfig) -> list[AntennaPosition]:
    """Fits from the best places of the grid, the one of lowest cost first."""
    dwells = path_reads(reads, time_s, place_m, offsets="dwell", spread_rad=config.spread_rad)
    grid = _grid(config)
    found = np.asarray(_coherence(dwells, jnp.asarray(grid, jnp.float32)))
    starts = grid[np.argsort(-found)[:_NUM_STARTS]]
    fits = _refined(dwells, starts)
    if config.offsets == "channel":
        shared = path_reads(reads, time_s, place_m, offsets="channel", spread_rad=config.spread_rad)
        fits = _refined(shared, [np.asarray(fit.position_m) for fit in fits[:_NUM_STARTS]])
    return fits


def _refined(reads: PathReads, starts: Any) -> list[AntennaPosition]:
    # The starts one by one: each ends when it has converged, and the program compiles in a fraction of a batch's time.
    fits = [_fit(reads, jnp.asarray(start, jnp.float32), jnp.zeros(())) for start in starts]
    return sorted(fits, key=lambda fit: float(fit.cost))


def path_reads(
    reads: TagReads, time_s: np.ndarray, place_m: np.ndarray, *, offsets: Literal["dwell", "channel"], spread_rad: float
) -> PathReads:
    """One tag's reads through one antenna with its place at each, (reads, 3) metres. Phases count modulo pi unless the reader
    has no flips.
    """
    fresh = np.concatenate([[True], (np.diff(reads.carrier_hz) != 0) | (np.diff(time_s) > _GAP_S)])
    run = np.cumsum(fresh) - 1
    part = ((time_s - time_s[fresh][run]) // MAX_DWELL_S).astype(np.int64)
    _, dwell = np.unique(np.stack([run, part]), axis=1, return_inverse=True)
    dwell = dwell.reshape(-1)
    group = dwell if offsets == "dwell" else np.unique(reads.carrier_hz, return_inverse=True)[1].reshape(-1)
    sigma = np.hypot(thermal_sigma_rad(reads.rssi_dbm), spread_rad)
    return PathReads(
        phase_rad=jnp.asarray(reads.phase_sign * reads.phase_rad, jnp.float32),
        carrier_hz=jnp.asarray(reads.carrier_hz, jnp.float32),
        sigma_rad=jnp.asarray(sigma, jnp.float32),
        position_m=jnp.asarray(place_m, jnp.float32),
        group=jnp.asarray(group, jnp.int32),
        cluster=jnp.asarray(dwell, jnp.int32),
        num_groups=int(group.max()) + 1,
        num_clusters=int(dwell.max()) + 1,
        multiple=1 if reads.pi_flips is False and reads.phase_period_rad > 6 else 2,
    )


def _path(recording: Recording, config: AntennaConfig, on_progress: OnProgress) -> tuple[str, np.ndarray]:
    """Where the path is from, and the tag's place at every frame, (frames, 3) metres."""
    known = recording.truth is not None and config.epc in recording.truth.tag_position_m
    if config.path == "truth" and not known:
        raise RecordingError(
            f"{recording.name}: path=truth, but the truth has no position of {config.epc}. Set path=traced."
        )
    if known and config.path != "traced":
        assert recording.truth is not None
        return "truth", np.asarray(recording.truth.tag_position_m[config.epc], float)
    return "traced", traced_path_m(recording, config, on_progress)


def traced_path_m(recording: Recording, config: AntennaConfig, on_progress: OnProgress) -> np.ndarray:
    """The centre of the object that carries the tag at every frame, offline, smoothed; NaN where it is not detected.

    It is the middle of the surface that the camera sees. The distance from there to the tag, if it is the same throughout,
    adds to the antenna's position, and the tracer needs a first guess of that: a recording whose antennas_m is right to some
    0.3 m.
    """
    reads = recording.reads[recording.reads.antenna == config.antenna]
    recording = recording.with_reads(reads)
    recording.reads.select(config.epc)
    path_m = np.full((recording.num_frames, 3), np.nan)
    settings = TraceSettings(smooth=True)
    load = clip_loader(tracer_clips(config.tracer))
    for number, trace in trace_recording(
        make_tracer(config.tracer), recording, load, epcs=[config.epc], settings=settings
    ):
        if np.asarray(trace.detected)[0]:
            path_m[number] = np.asarray(trace.centre_m)[0]
        on_progress("trace", number + 1, recording.num_frames)
    return _smoothed(recording.frame_time_s(), path_m)


def _smoothed(time_s: np.ndarray, path_m: np.ndarray) -> np.ndarray:
    """A Gaussian mean over the known frames around each known frame."""
    known = np.asarray(np.isfinite(path_m).all(axis=1))
    weight = np.exp(-0.5 * ((time_s[:, None] - time_s[None, :]) / _SMOOTH_S) ** 2) * known
    mean = weight @ np.where(known[:, None], path_m, 0.0) / np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    return np.where(known[:, None], mean, np.nan)
