"""Virtual tags: reads that a tag would have given had it followed a known track, for real or simulated video."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from ..core.errors import RecordingError
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
from .reads import TagReads
from .recording import Recording, Truth

MAX_GAP_FRAMES = 2
"""A track that misses more frames than this is out of view: it breaks into pieces, and no read falls between them."""


@dataclasses.dataclass(frozen=True)
class Track:
    """Where something was: one row a frame, NaN where it was not seen. Camera frame, metres."""

    time_s: np.ndarray  # (num_frames,)
    position_m: np.ndarray  # (num_frames, 3)

    def pieces(self) -> list[np.ndarray]:
        """Frame indices of each stretch without a gap of more than `MAX_GAP_FRAMES` frames and of 2 frames at least."""
        seen = np.flatnonzero(np.all(np.isfinite(self.position_m), axis=1))
        if not seen.size:
            return []
        return [
            part for part in np.split(seen, np.flatnonzero(np.diff(seen) > MAX_GAP_FRAMES + 1) + 1) if len(part) > 1
        ]

    def at(self, time_s: np.ndarray) -> np.ndarray:
        """Position at any time, (len(time_s), 3); NaN outside the pieces.

        Cubic Hermite between frames with central-difference velocities: smooth, so that the phase between frames is
        that of a body, even where the range changes by more than half a wavelength from one frame to the next.
        """
        out = np.full((len(time_s), 3), np.nan)
        for piece in self.pieces():
            t, x = self.time_s[piece], self.position_m[piece]
            velocity = np.gradient(x, t, axis=0)
            inside = (time_s >= t[0]) & (time_s <= t[-1])
            out[inside] = CubicHermiteSpline(t, x, velocity)(time_s[inside])
        return out


def load_tracks_csv(path: str | Path, frame_time_s: np.ndarray) -> dict[int, Track]:
    """Tracks by label from a table frame,person,x_m,y_m,z_m,... with frames counted from 1.

    Missing columns, numbers that are none, and frames outside the recording raise `RecordingError`.
    """
    path = Path(path)
    if not path.is_file():
        raise RecordingError(f"{path}: no such file; expected a table of tracks (frame,person,x_m,y_m,z_m).")
    with path.open(encoding="utf-8-sig", newline="") as file:
        rows = csv.DictReader(file)
        missing = {"frame", "person", "x_m", "y_m", "z_m"} - set(rows.fieldnames or ())
        if missing:
            raise RecordingError(f"{path}: columns {', '.join(sorted(missing))} are missing; found {rows.fieldnames}.")
        positions: dict[int, np.ndarray] = {}
        for line, row in enumerate(rows, start=2):
            try:
                frame, label = int(row["frame"]) - 1, int(row["person"])
                place = [float(row[name]) for name in ("x_m", "y_m", "z_m")]
            except (TypeError, ValueError) as error:
                raise RecordingError(f"{path}, line {line}: {error}. Expected numbers.") from error
            if not 0 <= frame < len(frame_time_s):
                raise RecordingError(
                    f"{path}, line {line}: frame {frame + 1}; the recording has frames 1 to {len(frame_time_s)}."
                )
            positions.setdefault(label, np.full((len(frame_time_s), 3), np.nan))[frame] = place
    return {label: Track(np.asarray(frame_time_s, float), place) for label, place in sorted(positions.items())}


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
    """Reads of a tag on a track: schedule, hopping, phase with noise, ripple and pi flips, RSSI, Doppler.

    Times are drawn over the whole track; reads while the tag is out of view, or too weak to hear, do not happen. The
    same seed gives the same reads.
    """
    rng = np.random.default_rng([seed, *epc.encode()])
    state = reader or ReaderState.draw(settings, rng)
    time_s = read_times(float(track.time_s[0]), float(track.time_s[-1]), settings, rng)
    range_m = np.linalg.norm(track.at(time_s) - antenna_m, axis=1)
    rssi = rssi_at(np.nan_to_num(range_m, nan=1.0), rng)
    heard = np.isfinite(range_m) & (rssi >= SENSITIVITY_DBM)
    time_s, range_m, rssi = time_s[heard], range_m[heard], rssi[heard]
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
    """A 96-bit EPC that ends in the label."""
    return f"E28011{label:018X}"


def attach_virtual_tags(
    recording: Recording,
    tracks: Mapping[int, Track],
    settings: ReaderSettings,
    *,
    seed: int,
    epc_of: Callable[[int], str] = default_epc,
) -> Recording:
    """The recording with a virtual tag on each track instead of its own reads; truth says which and where.

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
    columns = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in dataclasses.fields(TagReads)
        if parts and isinstance(getattr(parts[0], field.name), np.ndarray)
    }
    reads = TagReads.empty()
    if parts:
        joined = dataclasses.replace(parts[0], **columns)
        reads = joined[np.argsort(joined.time_ns, kind="stable")]
    truth = dataclasses.replace(
        recording.truth or Truth(), tag_to_label=to_label, tag_range_m=ranges, tag_position_m=positions
    )
    return recording.with_reads(reads, truth)
