"""People's tracks with the radial speed of a tag: files of the data sets `kinect-rfid` and `xovis-uwb`."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy.ndimage
from jaxtyping import Float

from ...core.errors import RecordingError
from .read_values import number
from .rows import Rejected, Row, RowError, csv_header, csv_row, numbered, read_rows, text_lines

SMOOTH_S = 0.2  # of positions and speeds: about 30 reads a second, each with 0.15 m/s of noise
_SMOOTH_UWB_S = 0.5  # of UWB positions: five a second, with errors of some decimetres
_MIN_TRACK_S, _MIN_OTHER_S = 60.0, 5.0  # shortest track of a UWB tag's carrier, and of other people
MIN_READS = 2.0  # sum of smoothing weights for a speed to be known
_STAMP = "%Y-%m-%d %H:%M:%S:%f"
_MAX_GAP_S = 60.0  # in a track: a tracker that loses a person for longer gives another number
_MAX_DISTANCE_M = 50.0  # of a position from the median of all
_MAX_SPEED_M_S = 100.0
_MAX_TIME_MS = 1e14
_MAX_UWB_M = 1000.0
_KINECT = "id, time, x cm, z cm"
_SPEEDS = "EPC, Doppler by phase, Doppler by the reader, speed m/s, time"

T = TypeVar("T")

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
    """The tracks of a file (id, time, x cm, z cm): seconds, x, z in metres, in order of time, by id.

    Rows that are not valid are left out, with a `RecordingWarning`. Raises `RecordingError` if most are not.
    """

    def row(text: str) -> _Sample:
        track_id, stamp, x_cm, z_cm = _values(text, 4)
        return track_id, _stamp_s(stamp), _number(x_cm, "x") / 100, _number(z_cm, "z") / 100

    lines, rejected = list(numbered(text_lines(path))), Rejected()
    tracks = _tracks(read_rows(lines, row, rejected), rejected)
    rejected.check(path, len(lines), _KINECT)
    return tracks


_Sample = tuple[str, float, float, float]
"""Track id, time in seconds, two coordinates in metres."""


def _values(text: str, count: int) -> list[str]:
    values = [part.strip() for part in text.split(",")]
    if len(values) != count:
        raise RowError(f"the number of values is not {count}")
    return values


def _number(text: str, name: str) -> float:
    return number({name: text}, name)


def _stamp_s(text: str) -> float:
    try:
        return datetime.strptime(text, _STAMP).timestamp()
    except (ValueError, OverflowError, OSError) as error:
        raise RowError("time is not year-month-day hour:minute:second:millisecond") from error


def _tracks(samples: Sequence[tuple[int, _Sample]], rejected: Rejected) -> Rows:
    """Samples in order of time, by track. Those far from the others in time or position are rejected."""
    if not samples:
        return {}
    place = np.array([sample[2:] for _, sample in samples])
    far = np.abs(place - np.median(place, axis=0)).max(axis=1) > _MAX_DISTANCE_M
    by_track: dict[str, list[tuple[int, _Sample]]] = {}
    for (line, sample), is_far in zip(samples, far, strict=True):
        if is_far:
            rejected.add(f"position is more than {_MAX_DISTANCE_M:g} m from the median", line)
        else:
            by_track.setdefault(sample[0], []).append((line, sample))
    return {track_id: _without_gaps(own, rejected) for track_id, own in by_track.items()}


def _without_gaps(own: Sequence[tuple[int, _Sample]], rejected: Rejected) -> list[tuple[float, float, float]]:
    """The samples of a track in order of time; of the parts between long gaps the longest, and the others are rejected."""
    ordered = sorted(own, key=lambda one: one[1][1])
    gaps = np.flatnonzero(np.diff([sample[1] for _, sample in ordered]) > _MAX_GAP_S) + 1
    bounds = [0, *gaps.tolist(), len(ordered)]
    begin, end = max(itertools.pairwise(bounds), key=lambda part: part[1] - part[0])
    for line, _ in [*ordered[:begin], *ordered[end:]]:
        rejected.add(f"time is more than {_MAX_GAP_S:g} s from the others of its track", line)
    return [sample[1:] for _, sample in ordered[begin:end]]


def read_speeds(path: Path) -> dict[str, Speeds]:
    """The tags of a file (EPC, Doppler by phase, Doppler by the reader, radial speed m/s, time), by EPC.

    Rows that are not valid are left out, with a `RecordingWarning`. Raises `RecordingError` if most are not.
    """

    def row(text: str) -> tuple[str, float, float]:
        epc, _, _, speed, stamp = _values(text, 5)
        towards_m_s = _number(speed, "speed")
        if abs(towards_m_s) > _MAX_SPEED_M_S:
            raise RowError(f"speed is outside -{_MAX_SPEED_M_S:g} to {_MAX_SPEED_M_S:g} m/s")
        return epc, _stamp_s(stamp), towards_m_s

    lines, rejected = list(numbered(text_lines(path))), Rejected()
    rows = read_rows(lines, row, rejected)
    rejected.check(path, len(lines), _SPEEDS)
    tags: dict[str, list[tuple[float, float]]] = {}
    for _, (epc, time_s, speed_m_s) in rows:
        tags.setdefault(epc, []).append((time_s, speed_m_s))
    arrays = {epc: np.array(sorted(own)) for epc, own in tags.items()}
    return {epc: Speeds(own[:, 0], own[:, 1]) for epc, own in arrays.items()}


def load_tagged(folder: Path, rate_hz: float) -> list[TaggedRecording]:
    """All tags of all files <name>.txt of tracks with a file RFID_<name>.txt; times in seconds from the first track on.

    Raises `RecordingError` for files that mostly hold other lines, and for a file without a track of two samples.
    """
    found = []
    for path in sorted(folder.glob("[0-9]*.txt")):
        beside = path.with_name(f"RFID_{path.name}")
        if not beside.is_file():
            continue
        tracks = {track_id: np.array(own) for track_id, own in read_kinect(path).items()}
        rows = {track_id: own for track_id, own in tracks.items() if np.ptp(own[:, 0]) >= 2 / rate_hz}
        if not rows:
            raise RecordingError(
                f"{path}: found no track of two samples or more; expected one of at least {2 / rate_hz:.2g} s. Leave the file out."
            )
        start = min(own[0, 0] for own in rows.values())
        walks = tuple(_walk(track_id, own - np.array([start, 0.0, 0.0]), rate_hz) for track_id, own in rows.items())
        for epc, speeds in read_speeds(beside).items():
            moved = dataclasses.replace(speeds, time_s=speeds.time_s - start)
            found.append(TaggedRecording(path.stem, walks, epc, moved))
    return found


def read_xovis(path: Path, unit_m: float) -> Rows:
    """The tracks of a table ;time;id;x;y;... (ms; x and y in units of `unit_m`): seconds, x, y in metres, by id.

    Rows that are not valid are left out, with a `RecordingWarning`. Raises `RecordingError` for missing columns, or if
    most rows are not valid.
    """

    def row(values: Row) -> _Sample:
        x_m, y_m = (number(values, name) * unit_m for name in ("x", "y"))
        return values["id"], _milliseconds_s(values, "time"), x_m, y_m

    samples, num_rows, rejected = _table(path, ("time", "id", "x", "y"), row)
    tracks = _tracks(samples, rejected)
    rejected.check(path, num_rows, "time in ms, id, x and y")
    return tracks


def _milliseconds_s(row: Row, name: str) -> float:
    time_ms = number(row, name)
    if not 0 <= time_ms <= _MAX_TIME_MS:
        raise RowError(f"{name} is outside 0 to {_MAX_TIME_MS:g} ms")
    return time_ms * 1e-3


def _table(path: Path, columns: Sequence[str], parse: Callable[[Row], T]) -> tuple[list[tuple[int, T]], int, Rejected]:
    """What `parse` makes of the rows of a table with these columns, with line numbers; the number of rows; the rejected."""
    (_, header), *body = numbered(text_lines(path))
    names, rejected = csv_header(path, header, columns, ";"), Rejected()
    return read_rows(body, lambda line: parse(csv_row(names, line, ";")), rejected), len(body), rejected


def load_uwb(folder: Path, rate_hz: float, unit_m: float) -> list[TaggedRecording]:
    """A UWB tag with stereo-camera tracks: a recording for each long track that `XOVIS_UWB.csv` assigns the tag to.

    Returns nothing without that file, and leaves out tracks in whose time the tag has fewer than two positions. The radial speed is towards a point one metre before the covered floor, from
    positions smoothed over half a second.
    Raises `RecordingError` for missing columns.
    """
    paired = folder / "XOVIS_UWB.csv"
    if not paired.is_file():
        return []
    columns = ("UWB_TIME", "UWB_X", "UWB_Y", "XOVIS_PERSON_ID")

    def row(values: Row) -> tuple[str, tuple[float, float, float]]:
        x_m, y_m = (number(values, name) * 1e-3 for name in columns[1:3])
        if max(abs(x_m), abs(y_m)) > _MAX_UWB_M:
            raise RowError(f"position is more than {_MAX_UWB_M:g} m away: wrong unit?")
        return values[columns[3]], (_milliseconds_s(values, columns[0]), x_m, y_m)

    rows, num_rows, rejected = _table(paired, columns, row)
    rejected.check(paired, num_rows, "time in ms, x and y in mm, and the number of a track")
    path = np.array([sample for _, (_, sample) in rows])
    path = path[np.unique(path[:, 0], return_index=True)[1]]
    tracks = {track_id: np.array(own) for track_id, own in read_xovis(folder / "raw_xovis.csv", unit_m).items()}
    found = []
    for track_id in dict.fromkeys(one for _, (one, _) in rows):
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
        own_path = path[(path[:, 0] > begin) & (path[:, 0] < end)] - origin
        if len(own_path) < 2:
            continue
        speeds = _speeds_of_path(own_path)
        found.append(TaggedRecording(f"xovis-uwb {track_id}", tuple(walks.values()), "uwb", speeds, track_id))
    return found


def _speeds_of_path(path: Float[np.ndarray, "samples 3"]) -> Speeds:
    """Radial speeds towards a point one metre before the floor that a path (s, x, y in metres) covers."""
    low, high = path[:, 1:].min(axis=0), path[:, 1:].max(axis=0)
    antenna_m = np.array([low[0] - 1.0, 0.7 * low[1] + 0.3 * high[1]])
    clock = np.arange(path[0, 0], path[-1, 0], 0.05)
    nearest = np.minimum(np.searchsorted(path[:, 0], clock), len(path) - 1)
    gap_s = np.minimum(np.abs(path[nearest, 0] - clock), np.abs(clock - path[np.maximum(nearest - 1, 0), 0]))
    clock = clock[gap_s < 8 * _SMOOTH_UWB_S]  # beyond, the sum of weights is zero
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
