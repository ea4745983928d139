"""An antenna's position from a tag's path where a reader's phase offset is affine in the carrier's frequency, reflections included.

Read r of a tag at p_r has the phase phi_r = 4 pi f_r |p_r - a| / c + o + s f_r + e_r + noise. One offset o and one slope s
(cables and group delays) hold for the whole recording, so that all its reads together give the position a. e_r is what
reflections add. They add alike to reads of near places and carriers; reads are no independent measurements then, and a fit that
takes them for such is far too sure. Here e is a Gaussian process over places and carriers:

    cov(e_r, e_q) = amplitude^2 exp(-|p_r - p_q|^2 / (2 length^2)) exp(-(f_r - f_q)^2 / (2 width^2)),

whose constants maximise the likelihood of each read given all others (Rasmussen and Williams, 2006, section 5.4.2). Starts are the places at which all
reads are most coherent, |sum_r exp(i m (phi_r - 4 pi f_r |p_r - a| / c - s f_r))|, m = 2 where phases count modulo pi.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
import scipy  # `scipy.linalg` is imported at its first use

from ..core.numerics import SPEED_OF_LIGHT_M_S
from .antenna_position import SLOPE_UNIT_RAD_HZ, PathReads

MAX_READS = 1500
"""Of more reads, so many are used, evenly spread: time grows with their number's cube."""

_MAX_SLOPE_RAD_HZ, _NUM_SLOPES = 8e-7, 161  # readers have 3e-7 to 4e-7
_BATCH = 512
_CLIMBS, _SHRINK = 8, 0.6
_NUM_STEPS, _STEP_M = 6, 0.05
_KNEE = 2.5  # surprises beyond it, in standard deviations, count less
_FREEDOM = 3.0  # of Student's t
_NUM_STARTS, _NUM_PEAKS, _FEW_READS = 48, 10, 400
_SAME_M, _RIVAL_M = 0.08, 0.15
_RIVAL = 0.02  # probability
_TEMPER = 0.5  # power of the likelihoods that places are weighed by: reflections are no Gaussian process
_AMPLITUDES_RAD = (0.1, 0.2, 0.3, 0.45)
_LENGTHS_M = (0.03, 0.05, 0.08, 0.12)
_WIDTHS_HZ = (3e6, 6e6, 12e6, 24e6)
_NOISE_FACTORS = (1.0, 2.0)


@dataclasses.dataclass(frozen=True)
class Reflections:
    """Constants of the Gaussian process."""

    amplitude_rad: float = 0.3
    length_m: float = 0.08
    width_hz: float = 12e6
    noise_factor: float = 1.0  # of the noise of each read


@dataclasses.dataclass(frozen=True)
class CoherentPlace:
    """A place of the antenna at which all reads are more coherent than around it."""

    position_m: np.ndarray  # (3,)
    slope_rad_hz: float
    coherence: float  # 0 to 1


@dataclasses.dataclass(frozen=True)
class AffineFit:
    """A fitted position, camera frame, metres."""

    position_m: np.ndarray  # (3,)
    covariance_m2: np.ndarray  # (3, 3)
    slope_rad_hz: float
    log_likelihood: float  # of each read given all others, by Student's t: pi flips and stray reads have little weight
    noise_rad: float  # root mean square of the residuals
    reflections: Reflections


@dataclasses.dataclass(frozen=True)
class AffinePosition:
    """The most likely position, and how sure it is: other places that explain the phases count by their likelihood."""

    best: AffineFit
    covariance_m2: np.ndarray  # (3, 3) about the best one, of all places
    rival_m: np.ndarray | None  # the most likely place far from the best one, where it has some probability


class AffineReads:
    """Reads of a tag with its position at each, as arrays of float64; evenly spread ones of more than `most`."""

    def __init__(self, reads: PathReads, most: int = MAX_READS):
        number = reads.phase_rad.shape[0]
        kept = np.unique(np.linspace(0, number - 1, min(number, most)).astype(int))
        self.phase_rad, self.carrier_hz, self.sigma_rad, self.position_m = (
            np.asarray(values, np.float64)[kept]
            for values in (reads.phase_rad, reads.carrier_hz, reads.sigma_rad, reads.position_m)
        )
        self.multiple = reads.multiple
        self.centred_hz = self.carrier_hz - self.carrier_hz.mean()
        self.wavenumber = 4 * np.pi * self.carrier_hz / SPEED_OF_LIGHT_M_S  # rad a metre of range

    def left_rad(self, position_m: np.ndarray, slope_rad_hz: float) -> np.ndarray:
        """Phases without that of the range and of the slope."""
        range_m = np.linalg.norm(self.position_m - position_m, axis=1)
        return self.phase_rad - self.wavenumber * range_m - slope_rad_hz * self.centred_hz


def coherences(reads: AffineReads, positions_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Coherence of all reads with each of (candidates, 3) positions, 0 to 1, at its best slope; and that slope."""
    carriers, channel = np.unique(reads.centred_hz, return_inverse=True)
    of_channel = np.zeros((len(channel), len(carriers)), np.complex64)
    of_channel[np.arange(len(channel)), channel.reshape(-1)] = 1 / len(channel)
    slopes = np.linspace(-_MAX_SLOPE_RAD_HZ, _MAX_SLOPE_RAD_HZ, _NUM_SLOPES)
    turn = np.exp(-1j * reads.multiple * carriers[:, None] * slopes).astype(np.complex64)
    found = []
    for begin in range(0, len(positions_m), _BATCH):
        range_m = np.linalg.norm(reads.position_m - positions_m[begin : begin + _BATCH, None], axis=-1)
        phasor = np.exp(1j * reads.multiple * (reads.phase_rad - reads.wavenumber * range_m)).astype(np.complex64)
        found.append(np.abs(phasor @ of_channel @ turn))
    every = np.concatenate(found)
    return every.max(axis=1), slopes[every.argmax(axis=1)]


def climb(reads: AffineReads, start_m: np.ndarray, step_m: float) -> CoherentPlace:
    """The most coherent place near a start."""
    place = np.asarray(start_m, np.float64)
    around = np.stack(np.meshgrid(*3 * [np.arange(-2, 3)], indexing="ij"), axis=-1).reshape(-1, 3)
    value, slope = 0.0, 0.0
    for _ in range(_CLIMBS):
        near = place + 0.5 * step_m * around
        every, slopes = coherences(reads, near)
        best = int(np.argmax(every))
        place, value, slope = near[best], float(every[best]), float(slopes[best])
        step_m *= _SHRINK
    return CoherentPlace(place, slope, value)


def fit_affine(
    reads: AffineReads, start_m: np.ndarray, slope_rad_hz: float, reflections: Reflections
) -> AffineFit | None:
    """The position near a start by generalised least squares; None where the matrix has no Cholesky factor."""
    number, sigma = len(reads.phase_rad), reads.sigma_rad * reflections.noise_factor
    common = _covariance(reads, reflections)
    place, slope = np.asarray(start_m, np.float64).copy(), slope_rad_hz
    weight, predicted, inverse = np.ones(number), np.zeros(number), np.eye(5)
    error = surprise = own_std = predicted
    level = _direction(reads, reads.left_rad(place, slope))
    for step in range(_NUM_STEPS):
        error = predicted + _wrapped(reads, reads.left_rad(place, slope) - level - predicted)
        away = (place - reads.position_m) / np.linalg.norm(place - reads.position_m, axis=1, keepdims=True)
        jacobian = np.column_stack(
            [reads.wavenumber[:, None] * away, np.ones(number), SLOPE_UNIT_RAD_HZ * reads.centred_hz]
        )
        matrix = common.copy()
        matrix[np.diag_indices(number)] += sigma**2 / weight
        try:
            factor = scipy.linalg.cholesky(matrix, lower=True, check_finite=False)
        except np.linalg.LinAlgError:
            return None
        precision = scipy.linalg.cho_solve((factor, True), np.eye(number), check_finite=False)
        inverse = np.linalg.inv(jacobian.T @ precision @ jacobian)
        change = inverse @ (jacobian.T @ (precision @ error))
        rest = error - jacobian @ change
        # Each read beside what all others predict of it (Rasmussen and Williams, 5.10 to 5.12).
        own_std = 1 / np.sqrt(np.diagonal(precision))
        surprise = (precision @ rest) * own_std**2
        if step < _NUM_STEPS - 1:  # the last step only evaluates
            place = place + np.clip(change[:3], -_STEP_M, _STEP_M)
            level, slope = level + change[3], slope + SLOPE_UNIT_RAD_HZ * change[4]
            surprise = _wrapped(reads, surprise)
            predicted = rest - surprise
            weight = 1 / (1 + np.square(surprise / (_KNEE * own_std)))
    likelihood = -np.log(own_std) - 0.5 * (_FREEDOM + 1) * np.log1p(np.square(surprise / own_std) / _FREEDOM)
    return AffineFit(
        position_m=place,
        covariance_m2=inverse[:3, :3],
        slope_rad_hz=slope,
        log_likelihood=float(likelihood.sum()),
        noise_rad=float(np.sqrt(np.mean(_wrapped(reads, error) ** 2))),
        reflections=reflections,
    )


def likely_reflections(
    reads: AffineReads, start_m: np.ndarray, slope_rad_hz: float, start: Reflections | None = None
) -> AffineFit | None:
    """The fit with the constants of the largest likelihood: one constant after the other."""
    best = fit_affine(reads, start_m, slope_rad_hz, start or Reflections())
    for name, values in _GRID.items():
        for value in values:
            if best is not None and getattr(best.reflections, name) == value:
                continue
            tried = dataclasses.replace(best.reflections if best is not None else Reflections(), **{name: value})
            fit = fit_affine(reads, start_m, slope_rad_hz, tried)
            if fit is not None and (best is None or fit.log_likelihood > best.log_likelihood):
                best = fit
    return best


def coherent_places(reads: PathReads, places_m: np.ndarray) -> list[CoherentPlace]:
    """The most coherent ones first, from (candidates, 3) places no farther apart than half a wavelength or so."""
    own = AffineReads(reads)
    found, _ = coherences(own, places_m)
    step_m = float(np.max(np.abs(places_m[1] - places_m[0])))
    peaks: list[CoherentPlace] = []
    for start in places_m[np.argsort(-found)[:_NUM_STARTS]]:
        peak = climb(own, start, step_m)
        if all(np.linalg.norm(peak.position_m - other.position_m) > _SAME_M for other in peaks):
            peaks.append(peak)
    return sorted(peaks, key=lambda one: -one.coherence)[:_NUM_PEAKS]


def find_position(reads: PathReads, peaks: Sequence[CoherentPlace]) -> AffinePosition | None:
    """The position from the reads' `coherent_places`, by fits that take far longer; None where none succeeds."""
    own = AffineReads(reads)
    # Which peak it is, by fewer reads: each peak with the constants that suit it.
    few = AffineReads(reads, _FEW_READS)
    tried = [likely_reflections(few, peak.position_m, peak.slope_rad_hz) for peak in peaks]
    every = sorted((one for one in tried if one is not None), key=lambda one: -one.log_likelihood)
    if not every:
        return None
    start = every[0]
    top = likely_reflections(own, start.position_m, start.slope_rad_hz, start.reflections)
    if top is None:
        return None
    likely = np.array([one.log_likelihood for one in every])
    weight = np.exp(_TEMPER * (likely - likely.max()))
    weight /= weight.sum()
    away = [one.position_m - start.position_m for one in every]
    own_m2 = [top.covariance_m2, *(one.covariance_m2 for one in every[1:])]
    spread = [one_m2 + np.outer(apart, apart) for one_m2, apart in zip(own_m2, away, strict=True)]
    far = [
        (share, one)
        for share, one, apart in zip(weight, every, away, strict=True)
        if np.linalg.norm(apart) > _RIVAL_M and share > _RIVAL
    ]
    rival = max(far, key=lambda one: one[0])[1].position_m if far else None
    return AffinePosition(top, np.einsum("k,kij->ij", weight, np.array(spread)), rival)


_GRID: dict[str, Sequence[float]] = {
    "amplitude_rad": _AMPLITUDES_RAD,
    "length_m": _LENGTHS_M,
    "width_hz": _WIDTHS_HZ,
    "noise_factor": _NOISE_FACTORS,
}


def _covariance(reads: AffineReads, reflections: Reflections) -> np.ndarray:
    square = np.sum(reads.position_m**2, axis=1)
    apart = (
        np.maximum(square[:, None] + square - 2 * reads.position_m @ reads.position_m.T, 0) / reflections.length_m**2
    )
    apart += np.square((reads.centred_hz[:, None] - reads.centred_hz) / reflections.width_hz)
    return reflections.amplitude_rad**2 * np.exp(-0.5 * apart)


def _direction(reads: AffineReads, angle_rad: np.ndarray) -> float:
    return float(np.angle(np.exp(1j * reads.multiple * angle_rad).mean())) / reads.multiple


def _wrapped(reads: AffineReads, angle_rad: np.ndarray) -> np.ndarray:
    return np.angle(np.exp(1j * reads.multiple * angle_rad)) / reads.multiple
