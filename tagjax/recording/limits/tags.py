"""What is measured of each tag: reads per second, gaps, phase noise, flips, speed and RSSI."""

from __future__ import annotations

import dataclasses

import numpy as np

from ..recording import Recording
from .pieces import Pieces, fit_pieces

FAST_PERCENTILE = 95.0
"""The speed of a tag is this percentile over its pieces."""


@dataclasses.dataclass(frozen=True)
class TagLimits:
    """Values of one tag, of its reads through the antenna that read it most. NaN where there are too few reads."""

    epc: str
    antenna: int
    num_reads: int  # of all antennas
    time_s: np.ndarray  # (reads,) of that antenna, from the first frame
    rssi: np.ndarray  # (reads,) dBm
    pieces: Pieces
    reads_per_s: float
    gap_fraction: float  # of the video's time in gaps longer than the threshold `gap_s`
    longest_gap_s: float
    reads_per_dwell: float  # median; NaN where the reader stays on one channel
    rssi_dbm: float  # median
    flips: bool  # phases count modulo pi only

    @property
    def speed_m_s(self) -> float:
        """The 95th percentile of the range rate; NaN where it was not measured."""
        return _percentile(np.abs(self.pieces.speed_m_s))

    @property
    def ambiguity(self) -> float:
        """Way between two reads over the way at which a phase difference is ambiguous, 95th percentile.

        That way is lambda / 4, for a reader with pi flips lambda / 8.
        """
        limit_m = self.pieces.wavelength_m / (8.0 if self.flips else 4.0)
        return _percentile(np.abs(self.pieces.speed_m_s) * self.pieces.gap_s / limit_m)

    @property
    def fastest_m_s(self) -> float:
        """The speed at which phase differences become ambiguous at this tag's read rate, m/s."""
        wavelength_m = float(np.median(self.pieces.wavelength_m)) if len(self.pieces) else 0.326
        return wavelength_m / (8.0 if self.flips else 4.0) * self.reads_per_s


def _percentile(values: np.ndarray) -> float:
    return float(np.percentile(values, FAST_PERCENTILE)) if values.size else float("nan")


def measure_tag(recording: Recording, epc: str, *, gap_s: float, flip_limit: float) -> TagLimits:
    """The values of one tag. Above the probability `flip_limit` of a flip, phases count modulo pi.

    Raises `RecordingError` for an EPC that was never read.
    """
    every = recording.reads.select(epc)
    ports, counts = np.unique(every.antenna, return_counts=True)
    antenna = int(ports[np.argmax(counts)])
    reads = every[every.antenna == antenna]
    time_s = (reads.time_ns - recording.time_ns[0]) * 1e-9
    end_s = max(float(recording.frame_time_s()[-1]), 1e-3)
    inside = time_s[(time_s >= 0) & (time_s <= end_s)]
    gaps = np.diff(np.concatenate([[0.0], inside, [end_s]]))
    pieces = fit_pieces(reads, time_s)
    rssi = reads.rssi_dbm[np.isfinite(reads.rssi_dbm)]
    found = pieces.flip_probability
    flips = found > flip_limit or reads.phase_period_rad < 6 or (bool(reads.pi_flips) and not np.isfinite(found))
    return TagLimits(
        epc=epc,
        antenna=antenna,
        num_reads=every.num_reads,
        time_s=time_s,
        rssi=np.asarray(reads.rssi_dbm, float),
        pieces=pieces,
        reads_per_s=len(inside) / end_s,
        gap_fraction=float(gaps[gaps > gap_s].sum() / end_s),
        longest_gap_s=float(gaps.max()),
        reads_per_dwell=_reads_per_dwell(reads.carrier_hz, time_s),
        rssi_dbm=float(np.median(rssi)) if rssi.size else float("nan"),
        flips=bool(flips),
    )


def _reads_per_dwell(carrier_hz: np.ndarray, time_s: np.ndarray) -> float:
    """The median number of reads of a dwell; the reads of one dwell and of the next are of different carriers."""
    known = np.isfinite(carrier_hz)
    carriers = carrier_hz[known]
    if len(np.unique(carriers)) < 2:
        return float("nan")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(carriers) != 0, [True]]))
    return float(np.median(np.diff(starts)[1:-1])) if len(starts) > 3 else float("nan")


def dwell_s(recording: Recording) -> float:
    """The median time that the reader stays on one channel, s, from the reads of all tags; NaN without two changes."""
    reads = recording.reads[np.isfinite(recording.reads.carrier_hz)]
    at_s = (reads.time_ns - recording.time_ns[0]) * 1e-9
    changes = at_s[1:][np.diff(reads.carrier_hz) != 0]
    return float(np.median(np.diff(changes))) if len(changes) > 1 else float("nan")
