"""Recordings of people's tracks with how fast a tag came nearer beside them: files of `kinect-rfid` and `xovis-uwb`."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from ...core.errors import RecordingError

SMOOTH_S = 0.2  # of positions and speeds: reads come some 30 a second, with 0.15 m/s of noise each
_SMOOTH_UWB_S = 0.5  # of UWB positions: five a second, off by some decimetres
_LEAST_TRACK_S, _LEAST_OTHER_S = 60.0, 5.0  # of a UWB tag's own tracks, and of those beside
LEAST_READS = 2.0  # within the smoothing, for a speed to be known
_STAMP = "%Y-%m-%d %H:%M:%S:%f"

Rows = Mapping[str, Sequence[tuple[float, float, float]]]


@dataclasses.dataclass(frozen=True)
class Speeds:
    """A tag's reads as speeds towards the antenna."""

    time_s: Float[np.ndarray, " reads"]
    towards_m_s: Float[np.ndarray, " reads"]


@dataclasses.dataclass(frozen=True)
class Walk:
    """A track at even times."""

    name: str
    time_s: Float[np.ndarray, " frames"]
    position_m: Float[np.ndarray, "frames 2"]

    def distance_m(self, place_m: Sequence[float] | np.ndarray) -> Float[np.ndarray, " frames"]:
        """From a place."""
        return np.linalg.norm(self.position_m - np.asarray(place_m, np.float64), axis=1)

    def towards_m_s(self, place_m: Sequence[float] | np.ndarray) -> Float[np.ndarray, " frames"]:
        """Its speed towards a place."""
        return -np.gradient(self.distance_m(place_m), self.time_s)


@dataclasses.dataclass(frozen=True)
class TaggedRecording:
    """The tracks of a recording, and the speeds of a tag that one of them carries."""

    name: str
    walks: tuple[Walk, ...]
    epc: str
    speeds: Speeds
    carrier: str | None = None  # the track's name, where it is known


def read_kinect(path: Path) -> Rows:
    """The tracks of a file (id, time, x cm, z cm): seconds, x, z in metres, by id. Raises `RecordingError` for other lines."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for line, text in enumerate(path.read_text().splitlines(), start=1):
        try:
            who, stamp, x_cm, z_cm = (part.strip() for part in text.split(","))
            row = datetime.strptime(stamp, _STAMP).timestamp(), float(x_cm) / 100, float(z_cm) / 100
        except ValueError as error:
            raise RecordingError(f"{path}, line {line}: {error}. Expected id, time, x cm, z cm.") from error
        rows.setdefault(who, []).append(row)
    return rows


def read_speeds(path: Path) -> dict[str, Speeds]:
    """The tags of a file (EPC, Doppler by phase, Doppler by the reader, radial speed m/s, time), by EPC.

    Raises `RecordingError` for other lines, and for speeds that are not finite.
    """
    rows: dict[str, list[tuple[float, float]]] = {}
    for line, text in enumerate(path.read_text().splitlines(), start=1):
        try:
            epc, _, _, speed, stamp = (part.strip() for part in text.split(","))
            row = datetime.strptime(stamp, _STAMP).timestamp(), float(speed)
            if not np.isfinite(row[1]):
                raise ValueError(f"the speed is {speed}")
        except ValueError as error:
            raise RecordingError(
                f"{path}, line {line}: {error}. Expected EPC, Doppler by phase, Doppler by the reader, speed m/s, time."
            ) from error
        rows.setdefault(epc, []).append(row)
    tags = {epc: np.array(sorted(own)) for epc, own in rows.items()}
    return {epc: Speeds(own[:, 0], own[:, 1]) for epc, own in tags.items()}


def load_tagged(folder: Path, rate_hz: float) -> list[TaggedRecording]:
    """Every tag of every <name>.txt of tracks beside which there is a RFID_<name>.txt; times from the first track on.

    Raises `RecordingError` for files that hold other lines, or no track.
    """
    found = []
    for path in sorted(folder.glob("[0-9]*.txt")):
        beside = path.with_name(f"RFID_{path.name}")
        if not beside.is_file():
            continue
        rows = {who: np.array(own) for who, own in read_kinect(path).items() if len(own) > 1}
        if not rows:
            raise RecordingError(f"{path}: no track of two samples or more.")
        start = min(own[0, 0] for own in rows.values())
        walks = tuple(_walk(who, own - np.array([start, 0.0, 0.0]), rate_hz) for who, own in rows.items())
        for epc, speeds in read_speeds(beside).items():
            moved = dataclasses.replace(speeds, time_s=speeds.time_s - start)
            found.append(TaggedRecording(path.stem, walks, epc, moved))
    return found


def read_xovis(path: Path, unit_m: float) -> Rows:
    """The tracks of a table ;time;id;x;y;... (ms; x and y in units of `unit_m`). Raises `RecordingError` for others."""
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for row in _table(path, {"time", "id", "x", "y"}):
        place = float(row["x"]) * unit_m, float(row["y"]) * unit_m
        rows.setdefault(row["id"], []).append((float(row["time"]) * 1e-3, *place))
    return rows


def _table(path: Path, columns: set[str]) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        table = csv.DictReader(file, delimiter=";")
        missing = columns - set(table.fieldnames or ())
        if missing:
            raise RecordingError(f"{path}: columns {', '.join(sorted(missing))} are missing; found {table.fieldnames}.")
        return list(table)


def load_uwb(folder: Path, rate_hz: float, unit_m: float) -> list[TaggedRecording]:
    """A UWB tag beside stereo tracks, one recording for each track that `XOVIS_UWB.csv` gives it to for long; none without that file.

    Its speed is that of its distance to a place a metre before its floor, of positions smoothed over half a second.
    Raises `RecordingError` for missing columns.
    """
    paired = folder / "XOVIS_UWB.csv"
    if not paired.is_file():
        return []
    rows = _table(paired, {"UWB_TIME", "UWB_X", "UWB_Y", "XOVIS_PERSON_ID"})
    path = np.array([[float(row[name]) * 1e-3 for name in ("UWB_TIME", "UWB_X", "UWB_Y")] for row in rows])
    path = path[np.unique(path[:, 0], return_index=True)[1]]
    tracks = {who: np.array(own) for who, own in read_xovis(folder / "raw_xovis.csv", unit_m).items()}
    found = []
    for who in dict.fromkeys(row["XOVIS_PERSON_ID"] for row in rows):
        if who not in tracks or np.ptp(tracks[who][:, 0]) < _LEAST_TRACK_S:
            continue
        begin, end = tracks[who][0, 0], tracks[who][-1, 0]
        there = [own for name, own in tracks.items() if name == who or (own[0, 0] < end and own[-1, 0] > begin)]
        names = [name for name, own in tracks.items() if any(own is one for one in there)]
        origin = np.array([begin, 0.0, 0.0])
        walks = {
            name: _walk(name, own - origin, rate_hz)
            for name, own in zip(names, there, strict=True)
            if np.ptp(own[:, 0]) >= _LEAST_OTHER_S
        }
        speeds = _speeds_of_path(path[(path[:, 0] > begin) & (path[:, 0] < end)] - origin)
        found.append(TaggedRecording(f"xovis-uwb {who}", tuple(walks.values()), "uwb", speeds, who))
    return found


def _speeds_of_path(path: Float[np.ndarray, "samples 3"]) -> Speeds:
    """Speeds towards a place a metre before the floor that a path (s, x, y in metres) covers."""
    low, high = path[:, 1:].min(axis=0), path[:, 1:].max(axis=0)
    place = np.array([low[0] - 1.0, 0.7 * low[1] + 0.3 * high[1]])
    clock = np.arange(path[0, 0], path[-1, 0], 0.05)
    weight = np.exp(-0.5 * np.square((clock[:, None] - path[None, :, 0]) / _SMOOTH_UWB_S))
    count = weight.sum(axis=1)
    smooth = weight @ path[:, 1:] / np.maximum(count, 1e-9)[:, None]
    speed = -np.gradient(np.linalg.norm(smooth - place, axis=1), clock)
    known = count >= LEAST_READS
    return Speeds(clock[known], speed[known])


def _walk(name: str, rows: Float[np.ndarray, "samples 3"], rate_hz: float) -> Walk:
    seconds, first = np.unique(rows[:, 0], return_index=True)
    clock = np.arange(seconds[0], seconds[-1], 1.0 / rate_hz)
    place = np.stack([np.interp(clock, seconds, rows[first, axis]) for axis in (1, 2)], axis=1)
    return Walk(name, clock, scipy.ndimage.gaussian_filter1d(place, SMOOTH_S * rate_hz, axis=0))
