"""Dwell likelihoods of one tag's reads under given distances, and their sums over a memory (docs/ceilings.md).

Within a dwell (consecutive reads of one antenna on one channel) the phase offset is constant and unknown. With von Mises
noise of concentration w_r the reads of a dwell have the phasor and the log likelihood ratio to uniform phases

    S = sum_r w_r exp(j m (phi_r - 4 pi f_r d(t_r) / c)) ,    log I0(|S|) - sum_r log I0(w_r) ,

the flat prior of the offset integrated out; m = 2 takes phases modulo pi. `tagjax.radio.reader_model` accumulates the
same quantity read by read.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Complex, Float, Int
from scipy import special

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...radio.channels import MAX_SLOPE_RAD_HZ
from ...radio.noise import thermal_sigma_rad
from ...recording import TagReads

NUM_SLOPES = 201
"""Slopes over which carried offsets are averaged: two neighbours differ by 0.25 rad over the 25 MHz of FCC's band."""


@dataclasses.dataclass(frozen=True)
class EvidenceSettings:
    """How reads become evidence. `spread_rad` is that of the tracer (conf/tracer/tagattention.yaml)."""

    spread_rad: float = 0.064  # standard deviation of a phase that the motion explains, beside thermal noise
    slack: float = 0.32  # the same as a fraction of the motion since the dwell's first read: reflections
    doubled_angle: bool = True  # phases count modulo pi
    hop_spread_rad: float = 0.4  # of a carried offset, beside the affine term, at each hop

    def __post_init__(self) -> None:
        for name, lowest in (("spread_rad", 1e-3), ("slack", 0.0), ("hop_spread_rad", 0.0)):
            if not getattr(self, name) >= lowest:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {lowest:g}.")

    @property
    def multiple(self) -> int:
        """m: the multiple of the phases that counts."""
        return 2 if self.doubled_angle else 1


@dataclasses.dataclass(frozen=True)
class ReadPhasors:
    """The reads of one tag at one antenna in order of time, under each candidate distance."""

    time_s: Float[np.ndarray, " reads"]
    phasor: Complex[np.ndarray, "candidates reads"]  # w_r exp(j m residual_r)
    start: Int[np.ndarray, " dwells"]  # index of each dwell's first read
    carrier_hz: Float[np.ndarray, " dwells"]

    @property
    def stop(self) -> Int[np.ndarray, " dwells"]:
        """Index after each dwell's last read."""
        return np.append(self.start[1:], len(self.time_s)).astype(np.int64)


def read_phasors(
    reads: TagReads,
    time_s: Float[np.ndarray, " reads"],
    range_m: Float[np.ndarray, "candidates reads"],
    settings: EvidenceSettings,
) -> ReadPhasors:
    """Phasors of reads of one antenna; `range_m` is each candidate's distance at the times of the reads.

    The concentration is w = 1 / (m^2 variance), the variance that of thermal noise, of `spread_rad` and of `slack` times
    the phase moved since the dwell's first read.
    """
    carrier_hz = np.asarray(reads.carrier_hz, np.float64)
    start = np.flatnonzero(np.diff(carrier_hz, prepend=np.nan) != 0)
    dwell = np.searchsorted(start, np.arange(len(carrier_hz)), side="right") - 1
    model_rad = 4 * np.pi / SPEED_OF_LIGHT_M_S * carrier_hz * range_m
    moved_rad = model_rad - (model_rad[:, start[dwell]] if len(start) else 0.0)
    thermal_rad = thermal_sigma_rad(np.asarray(reads.rssi_dbm, np.float64))
    variance = np.square(thermal_rad) + settings.spread_rad**2 + np.square(settings.slack * moved_rad)
    weight = 1.0 / (settings.multiple**2 * variance)
    residual_rad = reads.phase_sign * np.asarray(reads.phase_rad, np.float64) - model_rad
    return ReadPhasors(time_s, weight * np.exp(1j * settings.multiple * residual_rad), start, carrier_hz[start])


def dwell_phasors(
    reads: ReadPhasors, frame_s: Float[np.ndarray, " frames"], memory_s: float | None
) -> tuple[Complex[np.ndarray, "candidates frames dwells"], Float[np.ndarray, "candidates frames"]]:
    """S of each dwell from the reads in (frame - memory, frame], or all until the frame; and sum_r log I0(w_r) of these."""
    last = np.searchsorted(reads.time_s, frame_s, side="right")
    first = np.zeros_like(last) if memory_s is None else np.searchsorted(reads.time_s, frame_s - memory_s, side="right")
    begin = np.clip(reads.start[None], first[:, None], last[:, None])
    end = np.clip(reads.stop[None], first[:, None], last[:, None])
    sums = np.pad(np.cumsum(reads.phasor, axis=1), ((0, 0), (1, 0)))
    norms = np.pad(np.cumsum(log_i0(np.abs(reads.phasor)), axis=1), ((0, 0), (1, 0)))
    # An empty dwell is exactly 0: the difference of an element and itself.
    return sums[:, end] - sums[:, begin], norms[:, last] - norms[:, first]


def independent_evidence(
    reads: ReadPhasors, frame_s: Float[np.ndarray, " frames"], memory_s: float | None = None
) -> Float[np.ndarray, "candidates frames"]:
    """sum over dwells of log I0(|S|) - sum_r log I0(w_r), nats: each dwell has an offset of its own."""
    dwells, norm = dwell_phasors(reads, frame_s, memory_s)
    return np.sum(log_i0(np.abs(dwells)), axis=-1) - norm


def carried_evidence(
    reads: ReadPhasors,
    frame_s: Float[np.ndarray, " frames"],
    settings: EvidenceSettings,
    memory_s: float | None = None,
) -> Float[np.ndarray, "candidates frames"]:
    """The same with offsets that go on across hops: c(f) = c0 + slope (f - f0), plus a random walk of `hop_spread_rad` a hop.

    The belief in the offset is von Mises with the phasor P. A hop adds the variance m^2 hop^2, |P'| = |P| / (1 + |P| m^2
    hop^2), and the next dwell is worth log I0(|P' + S|) - log I0(|P'|) - sum_r log I0(w_r); then P = P' + S. An infinite
    spread makes P' = 0, and dwells independent. The slope, a constant of the reader, is unknown: the likelihood is averaged
    over `NUM_SLOPES` slopes of up to `MAX_SLOPE_RAD_HZ`.
    """
    dwells, norm = dwell_phasors(reads, frame_s, memory_s)
    away_hz = reads.carrier_hz - np.mean(reads.carrier_hz) if len(reads.carrier_hz) else reads.carrier_hz
    slope = np.linspace(-MAX_SLOPE_RAD_HZ, MAX_SLOPE_RAD_HZ, NUM_SLOPES)
    variance = (settings.multiple * settings.hop_spread_rad) ** 2
    shape = (NUM_SLOPES, *norm.shape)
    belief, total = np.zeros(shape, np.complex128), np.zeros(shape)
    for number, offset_hz in enumerate(away_hz):
        own = dwells[..., number]
        blurred = belief / (1.0 + np.abs(belief) * variance)
        turned = np.exp(-1j * settings.multiple * slope * offset_hz)[:, None, None] * own
        after = blurred + turned
        total += np.where(own != 0, log_i0(np.abs(after)) - log_i0(np.abs(blurred)), 0.0)
        belief = np.where(own != 0, after, belief)
    return special.logsumexp(total, axis=0) - np.log(NUM_SLOPES) - norm


def log_i0(x: Float[np.ndarray, "*shape"]) -> Float[np.ndarray, "*shape"]:
    """log I0(x) for x >= 0, without overflow."""
    return np.asarray(np.log(special.i0e(x)) + x)
