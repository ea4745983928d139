"""Real tags on real people: how fast a tag came nearer, by a reader or a UWB receiver, beside the tracks of a depth camera.

`kinect-rfid` holds radial speeds that a reader made of phases, `xovis-uwb` a UWB tag's positions, of which the distance to a
place is taken. Neither tells where that place is among the tracks, nor how far apart the two clocks are, nor are there phases. So a speed is
compared with a track's speed towards a place that comes from the other recordings, at the clock offset that suits the track
best, and by scores that ask for no scale.
"""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.optimize
from jaxtyping import Array, Float

from ..attention import att_corr
from ..recording import RecordingError

SCORES = ("TagAttention, Eq. 5", "Tagview, R^2", "correlation of speeds")
"""Those that ask for no scale: correlation of relative distances over k frames, and of distances and of speeds over the window.

Eq. 4, TagVision and coherence need distances to scale or raw phases, Goller et al. RSSI at several antennas.
"""

_NUM_WINDOW = 5  # TagAttention's k
_SMOOTH_S = 0.2  # of positions and speeds: reads come some 30 a second, with 0.15 m/s of noise each
_SMOOTH_UWB_S = 0.5  # of UWB positions: five a second, off by some decimetres
_LEAST_TRACK_S, _LEAST_OTHER_S = 60.0, 5.0  # of a UWB tag's own tracks, and of those beside
_LEAST_READS = 2.0  # within the smoothing, for a speed to be known
_LONGEST_LAG_S = 20.0
_LAG_STEP_S = 0.1
_REACH_M, _GRID_M = 6.0, 0.5  # how far from the tracks an antenna is looked for, and how finely
_STAMP = "%Y-%m-%d %H:%M:%S:%f"


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


@dataclasses.dataclass(frozen=True)
class Alignment:
    """How a tag's speeds suit a track best."""

    lag_s: float  # to be added to the tag's clock
    antenna_m: tuple[float, float]
    correlation: float  # of the speeds, over the frames that both cover
    slope: float  # the tag's speed in units of the track's


Rows = Mapping[str, Sequence[tuple[float, float, float]]]


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
    known = count >= _LEAST_READS
    return Speeds(clock[known], speed[known])


def _walk(name: str, rows: Float[np.ndarray, "samples 3"], rate_hz: float) -> Walk:
    seconds, first = np.unique(rows[:, 0], return_index=True)
    clock = np.arange(seconds[0], seconds[-1], 1.0 / rate_hz)
    place = np.stack([np.interp(clock, seconds, rows[first, axis]) for axis in (1, 2)], axis=1)
    return Walk(name, clock, scipy.ndimage.gaussian_filter1d(place, _SMOOTH_S * rate_hz, axis=0))


def heard_speed(speeds: Speeds, time_s: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " frames"]:
    """A tag's speed towards the antenna at these times, weighted by nearness; NaN where it is hardly read."""
    weight = np.exp(-0.5 * np.square((time_s[:, None] - speeds.time_s[None]) / _SMOOTH_S))
    count = weight.sum(axis=1)
    return np.where(count >= _LEAST_READS, weight @ speeds.towards_m_s / np.maximum(count, 1e-9), np.nan)


class _Pair:
    """One tag against one track, at any offset of the clocks."""

    def __init__(self, walk: Walk, speeds: Speeds):
        self.walk = walk
        step = float(np.median(np.diff(walk.time_s)))
        begin, end = walk.time_s[0] - _LONGEST_LAG_S, walk.time_s[-1] + _LONGEST_LAG_S
        self._clock = np.arange(begin, end + step, step)
        self._heard = heard_speed(speeds, self._clock)
        both = min(len(walk.time_s), int(np.isfinite(self._heard).sum()))
        self._least = max(both // 2, _NUM_WINDOW)

    def fit(
        self, lag_s: Float[np.ndarray, " lags"], places_m: Float[np.ndarray, "places 2"]
    ) -> tuple[Float[np.ndarray, "places lags"], Float[np.ndarray, "places lags"]]:
        """Correlation of the tag's speed and the track's towards each place, and slope; 0 where they share less than half."""
        heard = np.stack([np.interp(self.walk.time_s - lag, self._clock, self._heard) for lag in lag_s])
        known = np.isfinite(heard)
        count = np.maximum(known.sum(axis=1), 1)
        mean = np.where(known, heard, 0.0).sum(axis=1) / count
        said = np.where(known, heard - mean[:, None], 0.0)
        seen = np.stack([self.walk.towards_m_s(place) for place in places_m])
        member = known.astype(np.float64).T
        power = np.maximum(np.square(seen) @ member - np.square(seen @ member) / count, 0.0)
        both = seen @ said.T  # `said` has no mean left
        usable = (known.sum(axis=1) >= self._least) & (said.any(axis=1)) & (power > 1e-9)
        power = np.where(usable, power, 1.0)
        own = np.where(usable, np.square(said).sum(axis=1), 1.0)
        return np.where(usable, both / np.sqrt(power * own), 0.0), np.where(usable, both / power, 0.0)

    def aligned(self, lag_s: float, place_m: Sequence[float] | np.ndarray) -> Alignment:
        x, z = (float(value) for value in np.asarray(place_m))
        correlation, slope = self.fit(np.array([lag_s]), np.array([[x, z]]))
        return Alignment(float(lag_s), (x, z), float(correlation[0, 0]), float(slope[0, 0]))


_LAGS_S = np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S + _LAG_STEP_S / 2, _LAG_STEP_S)


def places_around(walks: Sequence[Walk]) -> Float[np.ndarray, "places 2"]:
    """Where an antenna is looked for: a grid of 0.5 m, up to 6 m from the tracks."""
    position = np.concatenate([walk.position_m for walk in walks])
    axes = [
        np.arange(low - _REACH_M, high + _REACH_M, _GRID_M)
        for low, high in zip(position.min(0), position.max(0), strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def align(pairs: Sequence[tuple[Walk, Speeds]], places_m: Float[np.ndarray, "places 2"]) -> list[Alignment]:
    """The clock offsets and the one place of the antenna at which speeds and tracks correlate best, by the sum over pairs.

    The best of these places and of offsets up to 20 s, of clocks that share at least half of what they could; several places
    are refined.
    """
    each = [_Pair(walk, speeds) for walk, speeds in pairs]
    found = [one.fit(_LAGS_S, places_m)[0] for one in each]
    place = int(np.argmax(sum(one.max(axis=1) for one in found)))
    start = np.array([*places_m[place], *(_LAGS_S[np.argmax(one[place])] for one in found)])
    if len(places_m) > 1:

        def worse(values: np.ndarray) -> float:
            return -sum(float(one.fit(values[2 + i : 3 + i], values[None, :2])[0][0, 0]) for i, one in enumerate(each))

        step = np.array([_GRID_M / 2] * 2 + [_LAG_STEP_S / 2] * len(each))
        simplex = np.vstack([start, start + np.diag(step)])
        start = scipy.optimize.minimize(worse, start, method="Nelder-Mead", options={"initial_simplex": simplex}).x
    return [one.aligned(float(lag), start[:2]) for one, lag in zip(each, start[2:], strict=True)]


@dataclasses.dataclass(frozen=True)
class Association:
    """How a tag's speeds suit every candidate: first the recording's own tracks, then those of others."""

    tagged: TaggedRecording
    candidates: tuple[Walk, ...]
    found: tuple[Alignment, ...]  # of each candidate, with the antenna where the other recordings put it
    own: Alignment  # of the own track that suits best, wherever the antenna is

    @property
    def carrier(self) -> int:
        """Which of the recording's own tracks suits best."""
        return int(np.argmax([one.correlation for one in self.found[: len(self.tagged.walks)]]))

    def heard_m_s(self) -> Float[np.ndarray, " frames"]:
        """The tag's speed towards the antenna as it was filed, at the times of its carrier's track; NaN where it is hardly read."""
        clock = self.candidates[self.carrier].time_s
        return heard_speed(self.tagged.speeds, clock - self.found[self.carrier].lag_s)

    def plain(self) -> dict[str, Any]:
        """For a JSON file."""
        here = len(self.tagged.walks)
        return {
            "recording": self.tagged.name,
            "epc": self.tagged.epc,
            "antenna_m": list(self.found[0].antenna_m),
            "own_antenna_m": list(self.own.antenna_m),
            "candidates": [
                {
                    "track": walk.name,
                    "own": number < here,
                    "carrier": None if self.tagged.carrier is None else walk.name == self.tagged.carrier,
                    **dataclasses.asdict(one),
                }
                for number, (walk, one) in enumerate(zip(self.candidates, self.found, strict=True))
            ],
        }


@dataclasses.dataclass(frozen=True)
class SpeedWindow:
    """A stretch of one tag's speeds beside the candidates' distances to the antenna."""

    time_s: Float[np.ndarray, " frames"]
    distance_m: Float[np.ndarray, "people frames"]
    towards_m_s: Float[np.ndarray, " frames"]
    carrier: int


def speed_windows(one: Association, length_s: float, least_move_m: float) -> list[SpeedWindow]:
    """Windows in which the tag is heard throughout and its carrier's distance changes, half overlapping.

    The clocks are apart as the carrier's whole track says.
    """
    carrier = one.carrier
    walk, aligned = one.candidates[carrier], one.found[carrier]
    clock, step = walk.time_s, float(np.median(np.diff(walk.time_s)))

    def distance_of(other: Walk) -> np.ndarray:
        return np.interp(clock, other.time_s, other.distance_m(aligned.antenna_m), left=np.nan, right=np.nan)

    distance = np.stack([distance_of(other) for other in one.candidates])
    heard = one.heard_m_s()
    num = round(length_s / step)
    found = []
    for start in range(0, len(clock) - num + 1, max(num // 2, 1)):
        span = slice(start, start + num)
        here = np.all(np.isfinite(distance[:, span]), axis=1)
        if not np.isfinite(heard[span]).all() or here.sum() < 2 or np.ptp(distance[carrier, span]) < least_move_m:
            continue
        found.append(
            SpeedWindow(clock[span] - clock[start], distance[here][:, span], heard[span], int(here[:carrier].sum()))
        )
    return found


def speed_scores(window: SpeedWindow) -> dict[str, Float[np.ndarray, " people"]]:
    """Each of `SCORES` of every candidate."""
    step = float(np.median(np.diff(window.time_s)))
    gone = -np.cumsum(window.towards_m_s) * step
    speed = -np.gradient(window.distance_m, step, axis=1)
    each = _windowed_correlation(jnp.asarray(window.distance_m, jnp.float32), jnp.asarray(gone, jnp.float32))
    over = lambda rows, one: np.nan_to_num([np.corrcoef(row, one)[0, 1] if np.ptp(row) else 0.0 for row in rows])  # noqa: E731
    line = np.square(np.maximum(over(window.distance_m, gone), 0.0))
    return dict(zip(SCORES, (np.asarray(each, np.float64), line, over(speed, window.towards_m_s)), strict=True))


@jax.jit
def _windowed_correlation(
    distance_m: Float[Array, "people frames"], gone_m: Float[Array, " frames"]
) -> Float[Array, " people"]:
    """Att_corr (Eq. 5) of every k frames, averaged."""
    index = jnp.arange(_NUM_WINDOW - 1, gone_m.shape[0])[:, None] - jnp.arange(_NUM_WINDOW - 1, -1, -1)[None, :]
    rho = distance_m[:, index] - distance_m[:, index[:, :1]]
    rd = jnp.broadcast_to((gone_m[index] - gone_m[index[:, :1]])[None], rho.shape)
    return jnp.mean(att_corr(rho, rd, jnp.ones(rho.shape, bool)), axis=1)


def associate(recordings: Sequence[TaggedRecording]) -> list[Association]:
    """Who carries each recording's tag: how well its speeds suit each track at its best clock offset.

    The antenna's place is the one that suits the other recordings, of each the track that suits its tag best, wherever the
    antenna is; its own where there is no other. The tracks of other recordings are candidates, too, as if they began with this one.
    """
    places = places_around([walk for one in recordings for walk in one.walks])
    best = []
    for one in recordings:
        found = [((walk, one.speeds), align([(walk, one.speeds)], places)[0]) for walk in one.walks]
        best.append(max(found, key=lambda pair: pair[1].correlation))
    out = []
    for number, one in enumerate(recordings):
        others = [pair for other, (pair, _) in zip(recordings, best, strict=True) if other.name != one.name]
        antenna_m = np.array([align(others or [best[number][0]], places)[0].antenna_m])
        start = one.walks[0].time_s[0]
        elsewhere = [
            dataclasses.replace(walk, time_s=walk.time_s - walk.time_s[0] + start)
            for walk in other_walks(recordings, one.name)
        ]
        candidates = (*one.walks, *elsewhere)
        found = tuple(align([(walk, one.speeds)], antenna_m)[0] for walk in candidates)
        out.append(Association(one, candidates, found, best[number][1]))
    return out


def other_walks(recordings: Sequence[TaggedRecording], name: str) -> list[Walk]:
    """The tracks of the recordings of other names."""
    return [walk for one in {r.name: r for r in recordings}.values() if one.name != name for walk in one.walks]
