"""Real tags on people: the radial speed of a tag, from a reader or a UWB receiver, against the tracks of a depth camera.

`kinect-rfid` holds radial speeds that a reader computed from phases, `xovis-uwb` positions of a UWB tag, from which a
distance to a fixed point is computed. Neither holds the position of the antenna among the tracks, the offset between the
two clocks, or phases. So the measured speed is compared with a track's speed towards an antenna position that is estimated
from the other recordings, at the clock offset of the highest correlation, and by scores that do not depend on scale.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy.ndimage
import scipy.optimize
from jaxtyping import Array, Float

from ...recording.importers.tagged_walks import MIN_READS, SMOOTH_S, Speeds, TaggedRecording, Walk
from ...tagattention.attention import att_corr

SCORES = ("TagAttention, Eq. 5", "Tagview, R^2", "correlation of speeds")
"""Scores that do not depend on scale: correlation of relative distances over k frames, and of distances and of speeds.

Eq. 4, TagVision and coherence need distances to scale or raw phases; Goller et al. need RSSI at several antennas.
"""

_NUM_WINDOW = 5  # TagAttention's k
_LONGEST_LAG_S = 20.0
_LAG_STEP_S = 0.1
_REACH_M, _GRID_M = 6.0, 0.5  # search range around the tracks for the antenna, and its grid step


@dataclasses.dataclass(frozen=True)
class Alignment:
    """The best alignment of a tag's speeds with a track."""

    lag_s: float  # to be added to the tag's clock
    antenna_m: tuple[float, float]
    correlation: float  # of the speeds, over the frames that both cover
    slope: float  # the tag's speed in units of the track's


def measured_speed(speeds: Speeds, time_s: Float[np.ndarray, " frames"]) -> Float[np.ndarray, " frames"]:
    """A tag's speed towards the antenna at these times, a Gaussian average over time; NaN where there are too few reads."""
    weight = np.exp(-0.5 * np.square((time_s[:, None] - speeds.time_s[None]) / SMOOTH_S))
    count = weight.sum(axis=1)
    return np.where(count >= MIN_READS, weight @ speeds.towards_m_s / np.maximum(count, 1e-9), np.nan)


class _Pair:
    """One tag against one track, at any offset of the clocks."""

    def __init__(self, walk: Walk, speeds: Speeds):
        self.walk = walk
        step = float(np.median(np.diff(walk.time_s)))
        begin, end = walk.time_s[0] - _LONGEST_LAG_S, walk.time_s[-1] + _LONGEST_LAG_S
        self._clock = np.arange(begin, end + step, step)
        self._measured = measured_speed(speeds, self._clock)
        both = min(len(walk.time_s), int(np.isfinite(self._measured).sum()))
        self._min_frames = max(both // 2, _NUM_WINDOW)

    def fit(
        self, lag_s: Float[np.ndarray, " lags"], places_m: Float[np.ndarray, "places 2"]
    ) -> tuple[Float[np.ndarray, "places lags"], Float[np.ndarray, "places lags"]]:
        """Correlation of the tag's speed and the track's towards each place, and slope; 0 where less than half of their frames overlap."""
        measured = np.stack([np.interp(self.walk.time_s - lag, self._clock, self._measured) for lag in lag_s])
        known = np.isfinite(measured)
        count = np.maximum(known.sum(axis=1), 1)
        mean = np.where(known, measured, 0.0).sum(axis=1) / count
        centred = np.where(known, measured - mean[:, None], 0.0)
        speed = np.stack([self.walk.towards_m_s(place) for place in places_m])
        member = known.astype(np.float64).T
        power = np.maximum(np.square(speed) @ member - np.square(speed @ member) / count, 0.0)
        both = speed @ centred.T  # `centred` has zero mean
        usable = (known.sum(axis=1) >= self._min_frames) & (centred.any(axis=1)) & (power > 1e-9)
        power = np.where(usable, power, 1.0)
        own = np.where(usable, np.square(centred).sum(axis=1), 1.0)
        return np.where(usable, both / np.sqrt(power * own), 0.0), np.where(usable, both / power, 0.0)

    def aligned(self, lag_s: float, place_m: Sequence[float] | np.ndarray) -> Alignment:
        x, z = (float(value) for value in np.asarray(place_m))
        correlation, slope = self.fit(np.array([lag_s]), np.array([[x, z]]))
        return Alignment(float(lag_s), (x, z), float(correlation[0, 0]), float(slope[0, 0]))


_LAGS_S = np.arange(-_LONGEST_LAG_S, _LONGEST_LAG_S + _LAG_STEP_S / 2, _LAG_STEP_S)


def places_around(walks: Sequence[Walk]) -> Float[np.ndarray, "places 2"]:
    """The candidate positions of the antenna: a grid of 0.5 m, up to 6 m from the tracks."""
    position = np.concatenate([walk.position_m for walk in walks])
    axes = [
        np.arange(low - _REACH_M, high + _REACH_M, _GRID_M)
        for low, high in zip(position.min(0), position.max(0), strict=True)
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def align(pairs: Sequence[tuple[Walk, Speeds]], places_m: Float[np.ndarray, "places 2"]) -> list[Alignment]:
    """The clock offsets and the one place of the antenna at which speeds and tracks correlate best, by the sum over pairs.

    The search covers these places and offsets up to 20 s at which at least half of the frames overlap. With several places
    the best is refined by Nelder-Mead.
    """
    each = [_Pair(walk, speeds) for walk, speeds in pairs]
    correlations = [one.fit(_LAGS_S, places_m)[0] for one in each]
    place = int(np.argmax(sum(one.max(axis=1) for one in correlations)))
    start = np.array([*places_m[place], *(_LAGS_S[np.argmax(one[place])] for one in correlations)])
    if len(places_m) > 1:

        def worse(values: np.ndarray) -> float:
            return -sum(float(one.fit(values[2 + i : 3 + i], values[None, :2])[0][0, 0]) for i, one in enumerate(each))

        step = np.array([_GRID_M / 2] * 2 + [_LAG_STEP_S / 2] * len(each))
        simplex = np.vstack([start, start + np.diag(step)])
        start = scipy.optimize.minimize(worse, start, method="Nelder-Mead", options={"initial_simplex": simplex}).x
    return [one.aligned(float(lag), start[:2]) for one, lag in zip(each, start[2:], strict=True)]


@dataclasses.dataclass(frozen=True)
class Association:
    """The alignment of a tag's speeds with every candidate: first the recording's own tracks, then those of others."""

    tagged: TaggedRecording
    candidates: tuple[Walk, ...]
    alignments: tuple[
        Alignment, ...
    ]  # of each candidate, with the antenna position estimated from the other recordings
    own: Alignment  # of the own track with the highest correlation, with its own best antenna position

    @property
    def carrier(self) -> int:
        """Index of the recording's own track with the highest correlation."""
        return int(np.argmax([one.correlation for one in self.alignments[: len(self.tagged.walks)]]))

    def measured_m_s(self) -> Float[np.ndarray, " frames"]:
        """The tag's measured speed towards the antenna at the times of its carrier's track; NaN where there are too few reads."""
        clock = self.candidates[self.carrier].time_s
        return measured_speed(self.tagged.speeds, clock - self.alignments[self.carrier].lag_s)

    def plain(self) -> dict[str, Any]:
        """For a JSON file."""
        here = len(self.tagged.walks)
        return {
            "recording": self.tagged.name,
            "epc": self.tagged.epc,
            "antenna_m": list(self.alignments[0].antenna_m),
            "own_antenna_m": list(self.own.antenna_m),
            "candidates": [
                {
                    "track": walk.name,
                    "own": number < here,
                    "carrier": None if self.tagged.carrier is None else walk.name == self.tagged.carrier,
                    **dataclasses.asdict(one),
                }
                for number, (walk, one) in enumerate(zip(self.candidates, self.alignments, strict=True))
            ],
        }


@dataclasses.dataclass(frozen=True)
class SpeedWindow:
    """A window of one tag's speeds, and the candidates' distances to the antenna."""

    time_s: Float[np.ndarray, " frames"]
    distance_m: Float[np.ndarray, "people frames"]
    towards_m_s: Float[np.ndarray, " frames"]
    carrier: int


def speed_windows(one: Association, length_s: float, min_move_m: float) -> list[SpeedWindow]:
    """Half-overlapping windows in which the tag is read throughout and its carrier's distance changes.

    The clock offset is that of the carrier's whole track.
    """
    carrier = one.carrier
    walk, aligned = one.candidates[carrier], one.alignments[carrier]
    clock, step = walk.time_s, float(np.median(np.diff(walk.time_s)))

    def resampled_m(other: Walk) -> np.ndarray:
        return np.interp(clock, other.time_s, other.distance_m(aligned.antenna_m), left=np.nan, right=np.nan)

    distance = np.stack([resampled_m(other) for other in one.candidates])
    measured = one.measured_m_s()
    num = round(length_s / step)
    windows = []
    for start in range(0, len(clock) - num + 1, max(num // 2, 1)):
        span = slice(start, start + num)
        here = np.all(np.isfinite(distance[:, span]), axis=1)
        if not np.isfinite(measured[span]).all() or here.sum() < 2 or np.ptp(distance[carrier, span]) < min_move_m:
            continue
        windows.append(
            SpeedWindow(clock[span] - clock[start], distance[here][:, span], measured[span], int(here[:carrier].sum()))
        )
    return windows


def speed_scores(window: SpeedWindow) -> dict[str, Float[np.ndarray, " people"]]:
    """Each of `SCORES` of every candidate."""
    step = float(np.median(np.diff(window.time_s)))
    moved_m = -np.cumsum(window.towards_m_s) * step
    speed = -np.gradient(window.distance_m, step, axis=1)
    each = _windowed_correlation(jnp.asarray(window.distance_m, jnp.float32), jnp.asarray(moved_m, jnp.float32))
    over = lambda rows, one: np.nan_to_num([np.corrcoef(row, one)[0, 1] if np.ptp(row) else 0.0 for row in rows])  # noqa: E731
    line = np.square(np.maximum(over(window.distance_m, moved_m), 0.0))
    return dict(zip(SCORES, (np.asarray(each, np.float64), line, over(speed, window.towards_m_s)), strict=True))


@jax.jit
def _windowed_correlation(
    distance_m: Float[Array, "people frames"], moved_m: Float[Array, " frames"]
) -> Float[Array, " people"]:
    """Att_corr (Eq. 5) of every k frames, averaged."""
    index = jnp.arange(_NUM_WINDOW - 1, moved_m.shape[0])[:, None] - jnp.arange(_NUM_WINDOW - 1, -1, -1)[None, :]
    rho = distance_m[:, index] - distance_m[:, index[:, :1]]
    rd = jnp.broadcast_to((moved_m[index] - moved_m[index[:, :1]])[None], rho.shape)
    return jnp.mean(att_corr(rho, rd, jnp.ones(rho.shape, bool)), axis=1)


def associate(recordings: Sequence[TaggedRecording]) -> list[Association]:
    """The carrier of each recording's tag: alignment of its speeds with each track at the best clock offset.

    The antenna position is estimated from the other recordings, from each one's best aligned track; from the recording
    itself where there is no other. The tracks of other recordings are candidates as well, shifted to start with this one.
    """
    places = places_around([walk for one in recordings for walk in one.walks])
    best = []
    for one in recordings:
        aligned = [((walk, one.speeds), align([(walk, one.speeds)], places)[0]) for walk in one.walks]
        best.append(max(aligned, key=lambda pair: pair[1].correlation))
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
        alignments = tuple(align([(walk, one.speeds)], antenna_m)[0] for walk in candidates)
        out.append(Association(one, candidates, alignments, best[number][1]))
    return out


def other_walks(recordings: Sequence[TaggedRecording], name: str) -> list[Walk]:
    """The tracks of the recordings of other names."""
    return [walk for one in {r.name: r for r in recordings}.values() if one.name != name for walk in one.walks]
