"""Virtual tags: simulated reads of a tag on a known track, for real or simulated video."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import scipy  # `scipy.interpolate` is imported at its first use: it takes a third of a second

from ..core.numerics import SPEED_OF_LIGHT_M_S
from ..radio.reader import (
    DOPPLER_STD_HZ,
    SENSITIVITY_DBM,
    ReaderSettings,
    ReaderState,
    channel_at,
    noise_sigma_rad,
    quantise_phase,
    quantise_rssi,
    read_times,
    rssi_at,
)
from .importers.read_values import integer, number
from .importers.rows import Rejected, RowError, csv_header, csv_row, numbered, read_rows, text_lines
from .reads import TagReads, join_reads
from .recording import Recording, Truth

MAX_GAP_FRAMES = 2
"""A gap of more frames than this splits a track into segments; there are no reads within the gap."""

_POSITION = ("x_m", "y_m", "z_m")
_TRACK_COLUMNS = ("frame", "person", *_POSITION)
_MAX_LABEL = 254  # of a label image, in which 255 is for pixels to ignore
_MAX_POSITION_M = 100.0


@dataclasses.dataclass(frozen=True)
class Track:
    """Positions of an object: one row per frame, NaN where it was not observed. Camera frame, metres."""

    time_s: np.ndarray  # (num_frames,)
    position_m: np.ndarray  # (num_frames, 3)

    def segments(self) -> list[np.ndarray]:
        """Frame indices of each segment of at least 2 frames without a gap of more than `MAX_GAP_FRAMES` frames."""
        observed = np.flatnonzero(np.all(np.isfinite(self.position_m), axis=1))
        if not observed.size:
            return []
        return [
            part
            for part in np.split(observed, np.flatnonzero(np.diff(observed) > MAX_GAP_FRAMES + 1) + 1)
            if len(part) > 1
        ]

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Position at any time, (len(time_s), 3) metres; NaN outside the segments.

        Cubic Hermite interpolation with central-difference velocities, so that phases between frames are those of
        smooth motion, even if the range changes by more than half a wavelength per frame.
        """
        out = np.full((len(time_s), 3), np.nan)
        for segment in self.segments():
            t, x = self.time_s[segment], self.position_m[segment]
            velocity = np.gradient(x, t, axis=0)
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            out[inside] = scipy.interpolate.CubicHermiteSpline(t, x, velocity)(time_s[inside])
        return out


def load_tracks_csv(path: str | Path, frame_time_s: np.ndarray) -> dict[int, Track]:
    """Tracks by label from a CSV table frame,person,x_m,y_m,z_m,... with frames counted from 1.

    Rows that are not valid are left out, with a `RecordingWarning`. Raises `RecordingError` for missing columns, and if most
    rows are not valid.
    """
    path, num_frames = Path(path), len(frame_time_s)
    (_, header), *lines = numbered(text_lines(path))
    columns, rejected = csv_header(path, header, _TRACK_COLUMNS), Rejected()
    positions: dict[int, np.ndarray] = {}
    found: set[tuple[int, int]] = set()

    def parse(text: str) -> tuple[int, int, list[float]]:
        row = csv_row(columns, text)
        frame, label = integer(row, "frame"), integer(row, "person")
        if not 1 <= frame <= num_frames:
            raise RowError(f"frame is outside the recording, which has frames 1 to {num_frames}")
        if not 1 <= label <= _MAX_LABEL:
            raise RowError(f"person is outside 1 to {_MAX_LABEL}")
        if (frame, label) in found:
            raise RowError("this frame of the same person is there already")
        found.add((frame, label))
        if all(row[name].strip().lower() == "nan" for name in _POSITION):
            return frame, label, [np.nan] * 3
        position = [number(row, name) for name in _POSITION]
        if max(map(abs, position)) > _MAX_POSITION_M:
            raise RowError(f"position is more than {_MAX_POSITION_M:g} m away: wrong unit?")
        return frame, label, position

    for _, (frame, label, position) in read_rows(lines, parse, rejected):
        positions.setdefault(label, np.full((num_frames, 3), np.nan))[frame - 1] = position
    rejected.check(path, len(lines), "frame, person, x_m, y_m and z_m of the same recording")
    return {label: Track(np.asarray(frame_time_s, float), position) for label, position in sorted(positions.items())}


def virtual_reads(
    track: Track,
    epc: str,
    settings: ReaderSettings,
    *,
    seed: int,
    antenna_m: np.ndarray,
    origin_ns: int = 0,
    reader: ReaderState | None = None,
) -> TagReads:
    """Simulated reads of a tag on a track: schedule, hopping, phase with noise, multipath ripple and pi flips, RSSI,
    Doppler.

    Read times are drawn over the whole track; reads without a position or below the reader's sensitivity are left out.
    The same seed gives the same reads.
    """
    rng = np.random.default_rng([seed, *epc.encode()])
    state = reader or ReaderState.draw(settings, rng)
    time_s = read_times(float(track.time_s[0]), float(track.time_s[-1]), settings, rng)
    range_m = np.linalg.norm(track.at(time_s) - antenna_m, axis=1)
    rssi = rssi_at(np.nan_to_num(range_m, nan=1.0), rng)
    received = np.isfinite(range_m) & (rssi >= SENSITIVITY_DBM)
    time_s, range_m, rssi = time_s[received], range_m[received], rssi[received]
    index = channel_at(time_s, state, settings)
    carrier = state.hop_table_hz[index]
    count = len(time_s)
    ripple = settings.multipath_rad * np.sqrt(2) * np.sin(range_m * rng.uniform(6, 20) + rng.uniform(0, 2 * np.pi))
    phase = (
        4 * np.pi * carrier * range_m / SPEED_OF_LIGHT_M_S
        + state.offset_rad[index]
        + rng.uniform(0, 2 * np.pi)
        + ripple
        + rng.normal(size=count) * noise_sigma_rad(rssi, state.floor_rad)
        + np.pi * (rng.random(count) < settings.flip_probability)
    )
    speed = np.gradient(range_m, time_s) if count > 1 else np.zeros(count)
    return TagReads(
        epc=np.full(count, epc),
        time_ns=origin_ns + np.rint(time_s * 1e9).astype(np.int64),
        antenna=np.ones(count, np.int16),
        carrier_hz=carrier,
        phase_rad=quantise_phase(phase),
        rssi_dbm=quantise_rssi(rssi),
        doppler_hz=(-2 * speed * carrier / SPEED_OF_LIGHT_M_S + rng.normal(0, DOPPLER_STD_HZ, count)).astype(
            np.float32
        ),
        channel_index=(index + 1).astype(np.int16),
        hop_table_hz=tuple(float(f) for f in state.hop_table_hz),
        pi_flips=settings.flip_probability > 0,
    )


def default_epc(label: int) -> str:
    """A 96-bit EPC whose last digits are the label."""
    return f"E28011{label:018X}"


def attach_virtual_tags(
    recording: Recording,
    tracks: Mapping[int, Track],
    settings: ReaderSettings,
    *,
    seed: int,
    epc_of: Callable[[int], str] = default_epc,
) -> Recording:
    """The recording with a virtual tag on each track instead of its own reads; the truth has labels, ranges and
    positions.

    All tags are read by one reader at the first antenna, each on the schedule of `settings`.
    """
    antenna = np.asarray(recording.antennas_m[0], float)
    reader = ReaderState.draw(settings, np.random.default_rng([seed, 1]))
    frame_s = recording.frame_time_s()
    parts, to_label, ranges, positions = [], {}, {}, {}
    for label, track in tracks.items():
        epc = epc_of(label)
        parts.append(
            virtual_reads(
                track, epc, settings, seed=seed, antenna_m=antenna, origin_ns=int(recording.time_ns[0]), reader=reader
            )
        )
        to_label[epc] = int(label)
        positions[epc] = track.at(frame_s)
        ranges[epc] = np.linalg.norm(positions[epc] - antenna, axis=1)
    reads = join_reads(parts) if parts else TagReads.empty()
    truth = dataclasses.replace(
        recording.truth or Truth(), tag_to_label=to_label, tag_range_m=ranges, tag_position_m=positions
    )
    return recording.with_reads(reads, truth)
