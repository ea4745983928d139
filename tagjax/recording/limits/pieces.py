"""Speed, phase noise and pi flips from reads within a dwell, without unwrapping from read to read.

Within a piece (consecutive reads of one tag, antenna and carrier, at most `PIECE_S` long) the range is nearly quadratic
in time. The likelihood of a speed v is that of its residuals e_r = phi_r - 4 pi f v t_r / c,

    max_o sum_r log [(1 - q) exp(k cos(e_r - o)) + q exp(-k cos(e_r - o))] ,

with von Mises noise of concentration k and pi flips of probability q: reads at irregular times tell speeds apart at which
a regular reader would alias. Speeds of pieces that follow each other differ by a bounded acceleration; the most likely
sequence is found by dynamic programming (Viterbi). A polynomial fitted to the residuals modulo pi then leaves the noise,
and tells which reads have an extra pi.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ..reads import TagReads

PIECE_S = (0.3, 0.5)
"""Longest piece: a hand turns round in twice the first. Of few reads it is that of six gaps, up to the second."""

MIN_READS = 5
"""Fewest reads of a piece: three parameters are fitted."""

MAX_SPEED_M_S = 3.0
"""Highest range rate of the search; TagAttention's fastest experiment moves at 2 m/s."""

_SPEEDS_M_S = np.linspace(-MAX_SPEED_M_S, MAX_SPEED_M_S, 241)
_CONCENTRATION = 12.0  # of a phase about a constant speed: 0.29 rad, with some acceleration
_FLIPS = 0.1
_TYPICAL_M_S = 1.0  # standard deviation of a range rate
_ACCELERATION_M_S2 = 4.0
_JUMP_M_S = 0.1


@dataclasses.dataclass(frozen=True)
class Pieces:
    """One element a piece: of one tag and antenna, in order of time."""

    time_s: np.ndarray  # (pieces,) of its middle
    speed_m_s: np.ndarray  # (pieces,) change of the range, positive away from the antenna
    variance_rad2: np.ndarray  # (pieces,) of the phase about the fit, unbiased
    freedom: np.ndarray  # (pieces,) number of reads less that of fitted parameters
    num_steps: np.ndarray  # (pieces,) pairs of consecutive reads
    num_flips: np.ndarray  # (pieces,) of these, between reads of which one has an extra pi
    gap_s: np.ndarray  # (pieces,) median time between reads
    wavelength_m: np.ndarray  # (pieces,)

    def __len__(self) -> int:
        return len(self.time_s)

    @property
    def covered_s(self) -> float:
        """The time within pieces."""
        return float(np.sum(self.num_steps * self.gap_s))

    @property
    def noise_rad(self) -> float:
        """Standard deviation of the phase: the median over pieces, corrected for its bias; NaN without a piece."""
        if not len(self):
            return float("nan")
        # The median of a chi-square variable over its degrees of freedom (Wilson and Hilferty, 1931).
        median = (1.0 - 2.0 / (9.0 * self.freedom)) ** 3
        return float(np.sqrt(np.median(self.variance_rad2 / median)))

    @property
    def flip_probability(self) -> float:
        """Probability of an extra pi, from the fraction 2 p (1 - p) of steps that change it; NaN with under 20 steps."""
        if self.num_steps.sum() < 20:
            return float("nan")
        transitions = self.num_flips.sum() / self.num_steps.sum()
        return float(0.5 * (1.0 - np.sqrt(max(0.0, 1.0 - 2.0 * transitions))))


def fit_pieces(reads: TagReads, time_s: np.ndarray) -> Pieces:
    """The pieces of one tag's reads through one antenna; `time_s` are the reads' times, seconds (reads,), in order.

    Reads of an unknown carrier belong to no piece.
    """
    parts = _parts(reads, time_s)
    one = [(reads[part], time_s[part]) for part in parts]
    likelihood = np.array([_likelihood(*piece) for piece in one]).reshape(len(one), len(_SPEEDS_M_S))
    middle = np.array([stamps.mean() for _, stamps in one])
    speeds = _most_likely(likelihood, middle).tolist()
    rows = [_fit(piece, stamps, speed) for (piece, stamps), speed in zip(one, speeds, strict=True)]
    columns = np.asarray(rows, float).reshape(len(rows), len(dataclasses.fields(Pieces))).T
    return Pieces(*columns)


def _parts(reads: TagReads, time_s: np.ndarray) -> list[slice]:
    known = np.isfinite(reads.carrier_hz)
    parts, start = [], 0
    longest_s = float(np.clip(6.0 * np.median(np.diff(time_s)), *PIECE_S)) if len(time_s) > 1 else 0.0
    for end in range(1, len(time_s) + 1):
        ends = end == len(time_s) or not known[end] or reads.carrier_hz[end] != reads.carrier_hz[start]
        if ends or time_s[end] - time_s[start] > longest_s:
            if end - start >= MIN_READS and known[start]:
                parts.append(slice(start, end))
            start = end
    return parts


def _wave(reads: TagReads) -> float:
    """Radians a metre of range."""
    return float(4 * np.pi * reads.carrier_hz[0] / SPEED_OF_LIGHT_M_S)


def _multiple(reads: TagReads) -> float:
    """m: phases times m do not change by a flip, and not by the reader's own period."""
    return max(2.0, 2 * np.pi / reads.phase_period_rad)


def _likelihood(reads: TagReads, time_s: np.ndarray) -> np.ndarray:
    """Log likelihood of every speed, nats, up to a constant."""
    multiple, phase = _multiple(reads), reads.phase_sign * reads.phase_rad
    left = phase - _wave(reads) * _SPEEDS_M_S[:, None] * (time_s - time_s.mean())
    offset = np.angle(np.exp(1j * multiple * left).sum(axis=1, keepdims=True)) / multiple
    if reads.phase_period_rad < 6:
        return _CONCENTRATION / multiple**2 * np.cos(multiple * (left - offset)).sum(axis=1)
    towards = _CONCENTRATION * np.cos(left - offset)
    either = [np.logaddexp(np.log1p(-_FLIPS) + one, np.log(_FLIPS) - one).sum(axis=1) for one in (towards, -towards)]
    return np.maximum(*either)


def _most_likely(likelihood: np.ndarray, time_s: np.ndarray) -> np.ndarray:
    """The most likely speed of every piece, (pieces,) m/s, under Gaussian priors of speed and acceleration."""
    if not len(likelihood):
        return np.zeros(0)
    score = likelihood - 0.5 * (_SPEEDS_M_S / _TYPICAL_M_S) ** 2
    apart = 0.5 * (_SPEEDS_M_S[:, None] - _SPEEDS_M_S[None, :]) ** 2
    before, best = [], score[0]
    for gap, own in zip(np.diff(time_s), score[1:], strict=True):
        through = best[:, None] - apart / ((_ACCELERATION_M_S2 * gap) ** 2 + _JUMP_M_S**2)
        before.append(through.argmax(axis=0))
        best = through.max(axis=0) + own
    path = [int(best.argmax())]
    for came in reversed(before):
        path.append(int(came[path[-1]]))
    return _SPEEDS_M_S[path[::-1]]


def _fit(reads: TagReads, time_s: np.ndarray, speed_m_s: float) -> tuple[float, ...]:
    """The values of a piece, from a polynomial about a motion at a given speed."""
    wave, multiple = _wave(reads), _multiple(reads)
    phase, x = reads.phase_sign * reads.phase_rad, time_s - time_s.mean()
    order = 2 if len(x) > MIN_READS else 1
    basis = np.vander(x / max(np.ptp(x), 1e-6), order + 1)
    fitted = wave * speed_m_s * x
    fitted = fitted + np.angle(np.exp(1j * multiple * (phase - fitted)).sum()) / multiple
    for _ in range(3):
        left = _wrapped(multiple * (phase - fitted)) / multiple
        fitted = fitted + basis @ np.linalg.lstsq(basis, left, rcond=None)[0]
    left = _wrapped(multiple * (phase - fitted)) / multiple
    freedom = len(x) - order - 1
    flipped = np.cos(phase - fitted) < 0
    flips = np.sum(flipped[1:] != flipped[:-1]) if reads.phase_period_rad > 6 else 0
    return (
        float(time_s.mean()),
        float(np.polyfit(x, fitted, 1)[0] / wave),
        float(np.sum(left**2) / freedom),
        float(freedom),
        float(len(x) - 1),
        float(flips),
        float(np.median(np.diff(time_s))),
        4 * np.pi / wave,
    )


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2 * np.pi) - np.pi
