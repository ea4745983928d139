"""People's tracks with the radial speed of a tag: files of the data sets `kinect-rfid` and `xovis-uwb`."""

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

SMOOTH_S = 0.2  # of positions and speeds: about 30 reads a second, each with 0.15 m/s of noise
_SMOOTH_UWB_S = 0.5  # of UWB positions: five a second, with errors of some decimetres
_MIN_TRACK_S, _MIN_OTHER_S = 60.0, 5.0  # shortest track of a UWB tag's carrier, and of other people
MIN_READS = 2.0  # sum of smoothing weights for a speed to be known
_STAMP = "%Y-%m-%d %H:%M:%S:%f"

Rows = Mapping[str, Sequence[tuple[float, float, float]]]


@dataclasses.dataclass(frozen=True)
class Speeds:
    """Radial speeds of a tag towards the antenna, one per read."""

    time_s: Float[np.ndarray, " reads"]
    towards_m_s: Float[np.ndarray, " reads"]


@dataclasses.dataclass(frozen=True)
class Walk:
    """A person's track at equidistant times, in the plane of the floor."""

    name: str
    time_s: Float[np.ndarray, " frames"]
    position_m: Float[np.ndarray, "frames 2"]

    def distance_m(self, point_m: Sequence[float] | np.ndarray) -> Float[np.ndarray, " frames"]:
        """Distance to a position."""
        return np.linalg.norm(self.position_m - np.asarray(point_m, np.float64), axis=1)

    def towards_m_s(self, point_m: Sequence[float] | np.ndarray) -> Float[np.ndarray, " frames"]:
        """Radial speed towards a position."""
        return -np.gradient(self.distance_m(point_m), self.time_s)


@dataclasses.dataclass(frozen=True)
class TaggedRecording:
    """The tracks of a recording, and the radial speeds of a tag that one of the people carries."""

    name: str
    walks: tuple[Walk, ...]
    epc: str
    speeds: Speeds
    carrier: str | None = None  # name of the carrier's track, if it is known


def read_kinect(path: Path) -> Rows:
    """The tracks of a file (id, time, x cm, z cm): seconds, x, z in metres, by id. Raises `RecordingError` for other
    lines.
    """
    rows: dict[str, list[tuple[float, float, float]]] = {}
    for line, text in enumerate(path.read_text().splitlines(), start=1):
        try:
            track_id, stamp, x_cm, z_cm = (part.strip() for part in text.split(","))
            row = datetime.strptime(stamp, _STAMP).timestamp(), float(x_cm) / 100, float(z_cm) / 100
        except ValueError as error:
            raise RecordingError(f"{path}, line {line}: {error}. Expected id, time, x cm, z cm.") from error
        rows.setdefault(track_id, []).append(row)
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
    """All tags of all files <name>.txt of tracks with a file RFID_<name>.txt; times in seconds from the first track on.

    Raises `RecordingError` for files that hold other lines, or no track.
    """
    found = []
    for path in sorted(folder.glob("[0-9]*.txt")):
        beside = path.with_name(f"RFID_{path.name}")
        if not beside.is_file():
            continue
        rows = {track_id: np.array(own) for track_id, own in read_kinect(path).items() if len(own) > 1}
        if not rows:
            raise RecordingError(f"{path}: no track of two samples or more.")
        start = min(own[0, 0] for own in rows.values())
        walks = tuple(_walk(track_id, own - np.array([start, 0.0, 0.0]), rate_hz) for track_id, own in rows.items())
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
    """A UWB tag with stereo-camera tracks: a recording for each long track that `XOVIS_UWB.csv` assigns the tag to.

    Returns nothing without that file. The radial speed is towards a point one metre before the covered floor, from
    positions smoothed over half a second.
    Raises `RecordingError` for missing columns.
    """
    paired = folder / "XOVIS_UWB.csv"
    if not paired.is_file():
        return []
    rows = _table(paired, {"UWB_TIME", "UWB_X", "UWB_Y", "XOVIS_PERSON_ID"})
    path = np.array([[float(row[name]) * 1e-3 for name in ("UWB_TIME", "UWB_X", "UWB_Y")] for row in rows])
    path = path[np.unique(path[:, 0], return_index=True)[1]]
    tracks = {track_id: np.array(own) for track_id, own in read_xovis(folder / "raw_xovis.csv", unit_m).items()}
    found = []
    for track_id in dict.fromkeys(row["XOVIS_PERSON_ID"] for row in rows):
        if track_id not in tracks or np.ptp(tracks[track_id][:, 0]) < _MIN_TRACK_S:
            continue
        begin, end = tracks[track_id][0, 0], tracks[track_id][-1, 0]
        there = [own for name, own in tracks.items() if name == track_id or (own[0, 0] < end and own[-1, 0] > begin)]
        names = [name for name, own in tracks.items() if any(own is one for one in there)]
        origin = np.array([begin, 0.0, 0.0])
        walks = {
            name: _walk(name, own - origin, rate_hz)
            for name, own in zip(names, there, strict=True)
            if np.ptp(own[:, 0]) >= _MIN_OTHER_S
        }
        speeds = _speeds_of_path(path[(path[:, 0] > begin) & (path[:, 0] < end)] - origin)
        found.append(TaggedRecording(f"xovis-uwb {track_id}", tuple(walks.values()), "uwb", speeds, track_id))
    return found


def _speeds_of_path(path: Float[np.ndarray, "samples 3"]) -> Speeds:
    """Radial speeds towards a point one metre before the floor that a path (s, x, y in metres) covers."""
    low, high = path[:, 1:].min(axis=0), path[:, 1:].max(axis=0)
    antenna_m = np.array([low[0] - 1.0, 0.7 * low[1] + 0.3 * high[1]])
    clock = np.arange(path[0, 0], path[-1, 0], 0.05)
    weight = np.exp(-0.5 * np.square((clock[:, None] - path[None, :, 0]) / _SMOOTH_UWB_S))
    count = weight.sum(axis=1)
    smooth = weight @ path[:, 1:] / np.maximum(count, 1e-9)[:, None]
    speed = -np.gradient(np.linalg.norm(smooth - antenna_m, axis=1), clock)
    known = count >= MIN_READS
    return Speeds(clock[known], speed[known])


def _walk(name: str, rows: Float[np.ndarray, "samples 3"], rate_hz: float) -> Walk:
    seconds, first = np.unique(rows[:, 0], return_index=True)
    clock = np.arange(seconds[0], seconds[-1], 1.0 / rate_hz)
    place = np.stack([np.interp(clock, seconds, rows[first, axis]) for axis in (1, 2)], axis=1)
    return Walk(name, clock, scipy.ndimage.gaussian_filter1d(place, SMOOTH_S * rate_hz, axis=0))
