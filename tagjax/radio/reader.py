"""A UHF RFID reader: which tag is read when, on which channel, and what phase and RSSI it reports.

Constants were measured on public logs of Impinj R420 readers (rail: an antenna on a rail, China, 8 channels;
counted: 1 to 25 tags, Taiwan; hopping: FCC, 50 channels).
"""

from __future__ import annotations

import dataclasses

import numpy as np

ROUND_BASE_S = 17.3e-3
"""Inventory round of no tag (counted): a round of N tags lasts ROUND_BASE_S + N * ROUND_PER_TAG_S, rms error 2 ms."""

ROUND_PER_TAG_S = 4.23e-3
"""Time that each further tag adds to a round (counted)."""

ROUND_JITTER = 0.25
"""Relative standard deviation of a tag's gaps: median 55 ms, 90 % below 76 to 100 ms (counted)."""

DWELL_S = 0.203
"""Time on one channel (counted and hopping: median 0.203 s, 0.195 to 0.215)."""

CODES_PER_TURN = 4096
CODE_STEP = 2
"""Phases are reported in multiples of 2 of 4096 codes (hopping; the rail's reader has 4)."""

RSSI_STEP_DB = 0.5
"""Resolution of the reported RSSI."""

SENSITIVITY_DBM = -77.5
"""Weakest read in the logs."""

NOISE_SLOPE_PER_DBM = -0.0374
NOISE_INTERCEPT = -3.56
"""log10(phase noise / rad) = slope * RSSI + intercept (rail)."""

NOISE_FLOOR_RAD = (0.012, 0.02)
"""Noise that a strong signal keeps; it differs between recordings."""

SLOPE_RAD_HZ = (0.30e-6, 0.43e-6)
"""Size of the affine phase offset over channels, either sign: cable and group delay (rail +0.42, counted -0.31)."""

CHANNEL_EPSILON_RAD = 0.005
"""What the affine offset leaves (rail: 0.003 to 0.006 rad)."""

RSSI_AT_1M_DBM = -45.0
"""Typical of the logs at 0.9 to 1 m."""

RSSI_PER_DECADE_DB = 21.0
"""Measured fall with distance (hopping, 0.3 to 2.1 m); free space would give 40."""

RSSI_RIPPLE_DB = 2.0
"""Standard deviation that multipath gives along a path (rail: 4 to 6 dB peak to peak a metre)."""

DOPPLER_STD_HZ = 12.0
"""Standard deviation of the reader's Doppler at a strong signal (hopping): useless per read."""

HOP_TABLES_HZ: dict[str, tuple[float, ...]] = {
    "fcc": tuple(902.75e6 + 0.5e6 * k for k in range(50)),
    "china": tuple(920.625e6 + 0.25e6 * k for k in range(16)),
    "taiwan": tuple(922.25e6 + 0.5e6 * k for k in range(12)),
    "etsi": (865.7e6, 866.3e6, 866.9e6, 867.5e6),
    "fixed": (920.625e6,),
}
"""Channels by region; a reader visits them in an order of its own."""


@dataclasses.dataclass(frozen=True)
class ReaderSettings:
    """What differs between readers and set-ups. `num_tags` sets the round time: 1 gives 46 reads/s, 12 give 15."""

    region: str = "china"
    num_tags: int = 1
    flip_probability: float = 0.05
    multipath_rad: float = 0.1  # slow ripple of the phase along the path: the rail shows 0.13 to 0.23 rad
    dwell_s: float = DWELL_S
    dropout: float = 0.03  # share of the rounds in which a tag is not heard

    def __post_init__(self):
        if self.region not in HOP_TABLES_HZ:
            raise ValueError(f"Unknown region {self.region!r}; expected one of {', '.join(HOP_TABLES_HZ)}.")
        if self.num_tags < 1:
            raise ValueError(f"num_tags is {self.num_tags}; at least 1 tag must be there.")
        if not 0 <= self.flip_probability <= 0.5:
            raise ValueError(f"flip_probability is {self.flip_probability}; expected a share between 0 and 0.5.")

    @property
    def round_s(self) -> float:
        """Mean time between two reads of one tag."""
        return ROUND_BASE_S + ROUND_PER_TAG_S * self.num_tags


@dataclasses.dataclass(frozen=True)
class ReaderState:
    """What one reader keeps over a recording: order of channels, phase offsets, noise floor."""

    hop_table_hz: np.ndarray
    offset_rad: np.ndarray  # of each entry of the hop table
    floor_rad: float
    first_dwell_s: float

    @classmethod
    def draw(cls, settings: ReaderSettings, rng: np.random.Generator) -> ReaderState:
        """Draw a reader; several tags of a recording share one."""
        table = rng.permutation(np.asarray(HOP_TABLES_HZ[settings.region]))
        slope = rng.choice([-1.0, 1.0]) * rng.uniform(*SLOPE_RAD_HZ)
        offset = slope * (table - table.mean()) + rng.normal(0, CHANNEL_EPSILON_RAD, len(table))
        return cls(table, offset, rng.uniform(*NOISE_FLOOR_RAD), rng.uniform(0, settings.dwell_s))


def read_times(start_s: float, stop_s: float, settings: ReaderSettings, rng: np.random.Generator) -> np.ndarray:
    """Times at which one tag is read between start and stop, seconds: a jittered renewal process with dropouts."""
    count = int((stop_s - start_s) / settings.round_s * 1.5) + 20
    shape = 1.0 / ROUND_JITTER**2
    gaps = rng.gamma(shape, settings.round_s / shape, count)
    times = start_s + rng.uniform(0, settings.round_s) + np.cumsum(gaps)
    heard = rng.random(count) >= settings.dropout
    return times[heard & (times < stop_s)]


def channel_at(time_s: np.ndarray, state: ReaderState, settings: ReaderSettings) -> np.ndarray:
    """Index into the hop table at each time."""
    return ((time_s + state.first_dwell_s) // settings.dwell_s).astype(np.int64) % len(state.hop_table_hz)


def rssi_at(range_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """RSSI of a tag along its path, dBm, before quantisation: fall with distance and a slow multipath ripple."""
    ripple = RSSI_RIPPLE_DB * np.sqrt(2) * np.sin(range_m * rng.uniform(4, 12) + rng.uniform(0, 2 * np.pi))
    return RSSI_AT_1M_DBM - RSSI_PER_DECADE_DB * np.log10(np.maximum(range_m, 0.1)) + ripple


def noise_sigma_rad(rssi_dbm: np.ndarray, floor_rad: float) -> np.ndarray:
    """Phase noise at an RSSI: the measured line, above the recording's floor."""
    return np.hypot(floor_rad, 10.0 ** (NOISE_SLOPE_PER_DBM * rssi_dbm + NOISE_INTERCEPT))


def quantise_rssi(rssi_dbm: np.ndarray) -> np.ndarray:
    """RSSI as reported, float32 dBm: in steps of `RSSI_STEP_DB`."""
    return (np.rint(rssi_dbm / RSSI_STEP_DB) * RSSI_STEP_DB).astype(np.float32)


def quantise_phase(phase_rad: np.ndarray) -> np.ndarray:
    """Phase as reported: modulo 2 pi, in steps of `CODE_STEP` codes."""
    step = 2 * np.pi * CODE_STEP / CODES_PER_TURN
    turn = CODES_PER_TURN // CODE_STEP
    return (np.rint(phase_rad / step) % turn) * step
