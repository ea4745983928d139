"""The lag between reads and frames, from a recording in which tags are moved by starts and stops (a shake).

While a tag moves, its phases change and so do pixels. The lag is that at which the tag's speed and the picture's motion
correlate most. It is measured only where the two agree well, at one lag much better than at others, and over dwells
of `_MIN_COVERED_S` seconds in all: with one tag shaken before a camera that does not move. Of shorter recordings, with several people in motion,
the best lag is often wrong.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from .tags import TagLimits

MAX_LAG_S = 1.5
MIN_CORRELATION = 0.7
MIN_CONTRAST = 0.2
"""The correlation must exceed those at lags farther than `_APART_S` from the best by so much."""

_STEP_S = 0.01
_APART_S = 0.35
_SMOOTH_S = 0.2
_PEAK = 0.1
_MIN_PIECES = 12
_MIN_COVERED_S = 6.0


@dataclasses.dataclass(frozen=True)
class Lag:
    """A lag, positive where reads are stamped later than the frames of the same moment, and the correlation there."""

    lag_s: float
    correlation: float
    epc: str


def find_lag(tags: list[TagLimits], frame_s: np.ndarray, motion: np.ndarray) -> Lag | None:
    """The lag of the tag whose speed agrees best with the picture's motion; None where none agrees well.

    `frame_s` and `motion` are by frame (frames,), seconds and any unit.
    """
    found = [lag for tag in tags if (lag := _lag_of(tag, frame_s, motion)) is not None]
    return max(found, key=lambda lag: lag.correlation) if found else None


def _lag_of(tag: TagLimits, frame_s: np.ndarray, motion: np.ndarray) -> Lag | None:
    pieces = tag.pieces
    if len(pieces) < _MIN_PIECES or pieces.covered_s < _MIN_COVERED_S or len(motion) < 10:
        return None
    lags = np.arange(-MAX_LAG_S, MAX_LAG_S + _STEP_S / 2, _STEP_S)
    # A piece's speed is a mean over some 0.2 s; so is the picture's motion about its middle.
    rate = _smoothed(frame_s, np.sqrt(motion), pieces.time_s[None, :] - lags[:, None])
    speed = np.minimum(np.abs(pieces.speed_m_s), np.percentile(np.abs(pieces.speed_m_s), 95))
    inside = np.isfinite(rate)
    found = np.array([_correlation(speed[there], one[there]) for one, there in zip(rate, inside, strict=True)])
    best = int(np.argmax(found))
    elsewhere = found[np.abs(lags - lags[best]) > _APART_S]
    if found[best] < MIN_CORRELATION or found[best] - elsewhere.max() < MIN_CONTRAST or best in (0, len(lags) - 1):
        return None
    # The middle of the peak: noise moves that less than its highest point.
    peak = (found > found[best] - _PEAK) & (np.abs(lags - lags[best]) <= _APART_S)
    return Lag(float(np.mean(lags[peak])), float(found[best]), tag.epc)


def _smoothed(frame_s: np.ndarray, motion: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """The mean of the picture's motion over `_SMOOTH_S` about each time; NaN outside of the video."""
    # A frame's motion happened in the step before it: the integral is linear between frames.
    total = np.concatenate([[0.0], np.cumsum(motion[1:] * np.diff(frame_s[: len(motion)]))])
    stamps, half = frame_s[: len(motion)], _SMOOTH_S / 2
    mean = (np.interp(at_s + half, stamps, total) - np.interp(at_s - half, stamps, total)) / _SMOOTH_S
    return np.where((at_s >= stamps[0]) & (at_s <= stamps[-1]), mean, np.nan)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if len(a) < _MIN_PIECES or np.std(a) < 1e-9 or np.std(b) < 1e-9:
        return -1.0
    return float(np.corrcoef(a, b)[0, 1])
