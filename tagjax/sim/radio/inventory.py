"""Inventory of several tags by one reader: slotted-ALOHA rounds, antennas in turn, hopping, clocks, noise.

Rates, noise and resolution are those of `reader`; this module adds the effects of several tags and antennas.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...radio.reader import (
    DOPPLER_STD_HZ,
    DWELL_S,
    RSSI_AT_1M_DBM,
    SENSITIVITY_DBM,
    ReaderSettings,
    ReaderState,
    noise_sigma_rad,
    quantise_phase,
    quantise_rssi,
)
from ...recording import TagReads
from ...recording.virtual_tags import Track
from ..world.rotation import unit
from .environment import Environment
from .links import SetUp
from .rounds import ROUNDS_PER_ANTENNA, draw_schedule, in_outage

RSSI_NOISE_DB_PER_RAD = 4.0
"""RSSI noise for each radian of phase noise (rail: 0.1 dB at -46 dBm, 0.3 to 0.4 dB at -62 to -68, quantised)."""

CLOCK_OFFSET_S = 0.5
"""Largest offset of a reader's clock that has been set (assumed; a clock never set starts in 1970 or 2000)."""

CLOCK_DRIFT_PPM = (20.0, 50.0)
"""Magnitude of a reader's clock drift, of either sign (assumed: a plain quartz)."""

LATENCY_S = (0.005, 0.050)
"""Smallest and largest delay from a read to its arrival at the host (assumed for a local network)."""

LATENCY_MEAN_S = 0.006
"""Mean delay in addition to the smallest latency, without queueing (assumed)."""

READER_TICK_NS = 1000
"""LLRP's time stamps count microseconds."""


@dataclasses.dataclass(frozen=True)
class InventorySettings:
    """Settings of the reader. Clock values of None are drawn from the ranges above."""

    region: str = "fcc"
    flip_probability: float = 0.08  # 0 for FM0, 0.06 to 0.12 for Miller encodings (11 to 21 % of the steps in logs)
    dwell_s: float = DWELL_S
    dropout: float = 0.03  # probability that a tag is not read in a round, apart from weak replies
    outages_per_minute: float = 1.0
    rounds_per_antenna: int = ROUNDS_PER_ANTENNA
    rssi_at_1m_dbm: float = RSSI_AT_1M_DBM  # in free space, for this reader, antenna and tag
    sensitivity_dbm: float = SENSITIVITY_DBM
    phase_sign: Literal[-1, 1] = 1
    clock_offset_s: float | None = None  # host - reader at the start
    clock_drift_ppm: float | None = None  # host against reader
    latency_s: tuple[float, float] = LATENCY_S  # (0, 0): reads arrive at once

    def __post_init__(self):
        self.reader()
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout is {self.dropout}; expected a probability from 0 to below 1.")
        if self.rounds_per_antenna < 1:
            raise ValueError(f"rounds_per_antenna is {self.rounds_per_antenna}; expected at least 1.")
        if not 0 <= self.latency_s[0] <= self.latency_s[1]:
            raise ValueError(f"latency_s is {self.latency_s}; expected 0 <= smallest <= largest.")

    def reader(self) -> ReaderSettings:
        """The settings that `ReaderState.draw` and `channel_at` need."""
        return ReaderSettings(region=self.region, flip_probability=self.flip_probability, dwell_s=self.dwell_s)


@dataclasses.dataclass(frozen=True)
class Inventory:
    """Reads, and the ground truth of each."""

    reads: TagReads
    time_s: Float[np.ndarray, " reads"]  # true time of the reply
    range_m: Float[np.ndarray, " reads"]  # straight line to the antenna of the read
    position_m: Float[np.ndarray, "reads 3"]
    transmission: Float[np.ndarray, " reads"]
    multipath_rad: Float[np.ndarray, " reads"]  # phase that reflections and blocking add to that of the straight line


def clock_stamps(
    time_s: Float[np.ndarray, " reads"], settings: InventorySettings, rng: np.random.Generator, *, origin_ns: int = 0
) -> tuple[Int[np.ndarray, " reads"], Int[np.ndarray, " reads"]]:
    """Arrival at the host and the reader's own stamp of reads at increasing true times, both int64 ns.

    host = reader + offset + drift * (reader - start), as in `ClockAudit`. Arrivals are delayed by the smallest latency
    plus an exponential delay, limited to the largest; reads stay in order.
    """
    offset, drift = settings.clock_offset_s, settings.clock_drift_ppm
    if offset is None:
        offset = float(rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S))
    if drift is None:
        drift = float(rng.choice([-1.0, 1.0]) * rng.uniform(*CLOCK_DRIFT_PPM))
    smallest, largest = settings.latency_s
    wait = np.minimum(rng.exponential(LATENCY_MEAN_S, len(time_s)), largest - smallest)
    host = np.maximum.accumulate(origin_ns + np.rint((time_s + smallest + wait) * 1e9).astype(np.int64))
    ticks = np.rint(time_s / (1 + drift * 1e-6) * (1e9 / READER_TICK_NS)).astype(np.int64)
    start = (origin_ns - round(offset * 1e9)) // READER_TICK_NS
    return host, (start + ticks) * READER_TICK_NS


def simulate_inventory(
    paths: Mapping[str, Track],
    antennas_m: Float[np.ndarray, "antennas 3"],
    environment: Environment,
    settings: InventorySettings | None = None,
    *,
    seed: int,
    transmission: Mapping[str, np.ndarray] | None = None,
    dipole: Mapping[str, np.ndarray] | None = None,
    boresight: Float[np.ndarray, "antennas 3"] | None = None,
    scatterer_path: tuple[np.ndarray, np.ndarray] | None = None,
    origin_ns: int = 0,
    reader: ReaderState | None = None,
) -> Inventory:
    """Reads of all tags on their paths by one reader, with the truth of each read.

    Paths by EPC, antennas and environment are in one frame, metres; times count from `origin_ns`. On each path's own
    samples, by EPC and linear in between: `transmission` (samples,) or (samples, antennas), the ratio of fields that the
    line of sight keeps (default 1), and `dipole` (samples, 3), the tag's axis (default isotropic). `boresight`: axes of
    the antennas (default isotropic). `scatterer_path` moves the environment's scatterers: times (samples,) and places
    (samples, scatterers, 3).
    Phase: channel, affine offset over channels, constant by tag and antenna, noise by RSSI, pi flips, 12-bit steps.
    A tag takes part in the rounds while it is in the antenna's range; reads at unknown positions, below the sensitivity
    or in an outage are lost. Time stamps are arrivals; see `clock_stamps`. Unknown EPCs and wrong sizes raise
    `ValueError`. The same seed gives the same reads.
    """
    settings = settings or InventorySettings()
    epcs = list(paths)
    _check(paths, len(antennas_m), environment, transmission, dipole, scatterer_path)
    rng = np.random.default_rng(seed)
    state = reader or ReaderState.draw(settings.reader(), rng)
    start = min(float(path.time_s[0]) for path in paths.values())
    stop = max(float(path.time_s[-1]) for path in paths.values())
    turn = {"num_antennas": len(antennas_m), "rounds_per_antenna": settings.rounds_per_antenna}
    setup = SetUp(
        tuple(paths.values()),
        np.asarray(antennas_m, float),
        environment,
        settings.reader(),
        state,
        settings.rssi_at_1m_dbm,
        [(transmission or {}).get(epc) for epc in epcs],
        [(dipole or {}).get(epc) for epc in epcs],
        unit(np.zeros_like(antennas_m) if boresight is None else np.asarray(boresight, float)),
        scatterer_path,
    )
    reach = setup.tags_in_range(start, stop, settings.sensitivity_dbm)
    slots = draw_schedule(start, stop, len(epcs), rng, **turn, in_range=reach)
    kept = rng.random(len(slots.time_s)) >= settings.dropout
    kept &= ~in_outage(slots.time_s, start, stop, settings.outages_per_minute, rng)
    link = setup.links(slots.time_s[kept], slots.tag[kept], slots.antenna[kept])
    time_s, tag, antenna, index = link.time_s, link.tag, link.antenna, link.channel
    position, phase, rssi, passed = link.position_m, link.phase_rad, link.rssi_dbm, link.transmission
    carrier, place = state.hop_table_hz[index], antennas_m[antenna]
    speed = setup.speed_m_s(time_s, tag, antenna)
    range_m = np.linalg.norm(position - place, axis=1)
    straight = 4 * np.pi * carrier * range_m / SPEED_OF_LIGHT_M_S
    # The fitted noise grows without bound: below the sensitivity it would lift weak reads above the threshold.
    sigma = noise_sigma_rad(np.maximum(rssi, settings.sensitivity_dbm), state.floor_rad)
    measured = rssi + RSSI_NOISE_DB_PER_RAD * sigma * rng.normal(size=len(rssi))
    constant = rng.uniform(0, 2 * np.pi, (len(epcs), len(antennas_m)))
    noisy = (
        phase
        + state.offset_rad[index]
        + constant[tag, antenna]
        + sigma * rng.normal(size=len(rssi))
        + np.pi * (rng.random(len(rssi)) < settings.flip_probability)
    )
    doppler = -2 * speed * carrier / SPEED_OF_LIGHT_M_S + rng.normal(0, DOPPLER_STD_HZ, len(rssi))
    host_ns, reader_ns = clock_stamps(time_s, settings, rng, origin_ns=origin_ns)
    reads = TagReads(
        epc=np.asarray(epcs)[tag],
        time_ns=host_ns,
        antenna=(antenna + 1).astype(np.int16),
        carrier_hz=carrier,
        phase_rad=quantise_phase(settings.phase_sign * noisy),
        rssi_dbm=quantise_rssi(measured),
        doppler_hz=doppler.astype(np.float32),
        reader_time_ns=reader_ns,
        channel_index=(index + 1).astype(np.int16),
        hop_table_hz=tuple(float(f) for f in state.hop_table_hz),
        phase_sign=settings.phase_sign,
        pi_flips=settings.flip_probability > 0,
    )
    multipath = (phase - straight + np.pi) % (2 * np.pi) - np.pi
    read = measured >= settings.sensitivity_dbm
    return Inventory(reads[read], time_s[read], range_m[read], position[read], passed[read], multipath[read])


def _check(paths, num_antennas, environment, transmission, dipole, scatterer_path) -> None:
    if not paths:
        raise ValueError("No path is given; expected one for each of at least one tag.")
    for name, given, widths in (
        ("transmission", transmission, ((), (1,), (num_antennas,))),
        ("dipole", dipole, ((3,),)),
    ):
        for epc, values in (given or {}).items():
            if epc not in paths:
                raise ValueError(f"{name} of EPC {epc!r}, which has no path; expected one of {', '.join(paths)}.")
            expected = [(len(paths[epc].time_s), *width) for width in widths]
            if np.shape(values) not in expected:
                raise ValueError(f"{name} of EPC {epc!r} has shape {np.shape(values)}; expected one of {expected}.")
    if scatterer_path is not None:
        when, places = scatterer_path
        expected = (len(when), len(environment.scatterers.rcs_m2), 3)
        if places.shape != expected:
            raise ValueError(f"scatterer_path has places of shape {places.shape}; expected {expected}.")
