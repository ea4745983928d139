"""Recordings of several tags before one reader: slotted-ALOHA rounds, antennas in turn, hopping, clocks, noise.

Rates, noise and resolution are those of `reader`; this module adds what only shows with several tags or antennas.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from .._numerics import SPEED_OF_LIGHT_M_S
from ..recording import TagReads
from .channel import Environment, one_way_gain, reported_phase_rad, rssi_from_gain_dbm, two_way_gain
from .reader import (
    DOPPLER_STD_HZ,
    DWELL_S,
    ROUND_BASE_S,
    ROUND_JITTER,
    ROUND_PER_TAG_S,
    RSSI_AT_1M_DBM,
    SENSITIVITY_DBM,
    ReaderSettings,
    ReaderState,
    channel_at,
    noise_sigma_rad,
    quantise_phase,
    quantise_rssi,
)
from .virtual_tag import Track

ROUNDS_PER_ANTENNA = 4
"""Rounds before the next antenna. Logs of 4 antennas stay 0.03 to 0.24 s on one: 1 to 10 rounds of one tag."""

RSSI_NOISE_DB_PER_RAD = 4.0
"""RSSI noise for each radian of phase noise (rail: 0.1 dB at -46 dBm, 0.3 to 0.4 dB at -62 to -68, quantised)."""

CLOCK_OFFSET_S = 0.5
"""Largest offset of a reader's clock that was set (assumed, no log shows it; one never set starts in 1970 or 2000)."""

CLOCK_DRIFT_PPM = (20.0, 50.0)
"""Size of a reader's clock drift, either sign (assumed: a plain quartz)."""

LATENCY_S = (0.005, 0.050)
"""From read to arrival at the host, least and most (assumed for a local network)."""

LATENCY_MEAN_S = 0.006
"""Mean wait on top of the least latency, before reads queue behind each other (assumed)."""

OUTAGE_S = 0.5
"""Mean length of an outage of the whole reader (assumed: garbage collection, network, a person at the antenna)."""

READER_TICK_NS = 1000
"""LLRP's time stamps count microseconds."""


@dataclasses.dataclass(frozen=True)
class InventorySettings:
    """What differs between recordings of several tags. Clock values of None are drawn from the ranges above."""

    region: str = "fcc"
    flip_share: float = 0.05  # 0 for FM0, 0.06 to 0.12 for Miller encodings
    dwell_s: float = DWELL_S
    dropout: float = 0.03  # share of the rounds in which a tag is not heard, beside those too weak
    outages_per_minute: float = 1.0
    rounds_per_antenna: int = ROUNDS_PER_ANTENNA
    rssi_at_1m_dbm: float = RSSI_AT_1M_DBM  # of this set-up in free space
    sensitivity_dbm: float = SENSITIVITY_DBM
    phase_sign: Literal[-1, 1] = 1
    clock_offset_s: float | None = None  # host - reader at the start
    clock_drift_ppm: float | None = None  # host against reader
    latency_s: tuple[float, float] = LATENCY_S  # (0, 0): reads arrive at once

    def __post_init__(self):
        self.reader()
        if not 0 <= self.dropout < 1:
            raise ValueError(f"dropout is {self.dropout}; expected a share from 0 to below 1.")
        if self.rounds_per_antenna < 1:
            raise ValueError(f"rounds_per_antenna is {self.rounds_per_antenna}; an antenna needs at least 1 round.")
        if not 0 <= self.latency_s[0] <= self.latency_s[1]:
            raise ValueError(f"latency_s is {self.latency_s}; expected 0 <= least <= most.")

    def reader(self) -> ReaderSettings:
        """The part that `ReaderState.draw` and `channel_at` go by."""
        return ReaderSettings(region=self.region, flip_share=self.flip_share, dwell_s=self.dwell_s)


@dataclasses.dataclass(frozen=True)
class Schedule:
    """Slots in which tags answer, in order of time: every tag once in every round."""

    time_s: Float[np.ndarray, " slots"]  # true time, strictly increasing
    tag: Int[np.ndarray, " slots"]  # from 0
    antenna: Int[np.ndarray, " slots"]  # from 0
    round: Int[np.ndarray, " slots"]  # from 0


@dataclasses.dataclass(frozen=True)
class Inventory:
    """Reads, and what was true at each of them."""

    reads: TagReads
    time_s: Float[np.ndarray, " reads"]  # when the tag answered, true time
    range_m: Float[np.ndarray, " reads"]  # straight line to the antenna of the read
    position_m: Float[np.ndarray, "reads 3"]
    transmission: Float[np.ndarray, " reads"]
    multipath_rad: Float[np.ndarray, " reads"]  # what reflections and blocking add to the phase of the straight line


def draw_schedule(
    start_s: float,
    stop_s: float,
    num_tags: int,
    rng: np.random.Generator,
    *,
    num_antennas: int = 1,
    rounds_per_antenna: int = ROUNDS_PER_ANTENNA,
) -> Schedule:
    """Slotted-ALOHA rounds: `ROUND_BASE_S`, then one slot of `ROUND_PER_TAG_S` for each tag in random order.

    Overhead and slots jitter by `ROUND_JITTER` (gamma), so the mean round is the measured 17.3 + 4.23 N ms; empty and
    collided slots are in it. The antenna changes after `rounds_per_antenna` rounds, in turn.
    """
    if num_tags < 1 or num_antennas < 1:
        raise ValueError(f"{num_tags} tags and {num_antennas} antennas; an inventory needs at least one of each.")
    num_rounds = int((stop_s - start_s) / (ROUND_BASE_S + ROUND_PER_TAG_S * num_tags) * 1.1) + 50
    shape = 1.0 / ROUND_JITTER**2
    slots = rng.gamma(shape, ROUND_PER_TAG_S / shape, (num_rounds, num_tags))
    slots[:, 0] += rng.gamma(shape, ROUND_BASE_S / shape, num_rounds)
    # Start inside a round, so that recordings do not begin with its overhead.
    time_s = start_s - rng.uniform(0, ROUND_BASE_S) + np.cumsum(slots).reshape(slots.shape)
    tag = rng.permuted(np.tile(np.arange(num_tags), (num_rounds, 1)), axis=1)
    number = np.broadcast_to(np.arange(num_rounds)[:, None], slots.shape)
    antenna = number // rounds_per_antenna % num_antennas
    inside = (time_s >= start_s) & (time_s < stop_s)
    return Schedule(time_s[inside], tag[inside], antenna[inside], number[inside])


@eqx.filter_jit
def link_gains(
    environment: Environment,
    tag_m: Float[Array, "reads 3"],
    antenna_m: Float[Array, "reads 3"],
    carrier_hz: Float[Array, " reads"],
    transmission: Float[Array, " reads"],
    dipole: Float[Array, "reads 3"],
    boresight: Float[Array, "reads 3"],
    scatterer_m: Float[Array, "reads scatterers 3"],
) -> tuple[Float[Array, " reads"], Float[Array, " reads"]]:
    """Phase before offsets (rad, growing with distance) and RSSI (dB against free space at 1 m) of many reads."""

    def one(tag, antenna, carrier, factor, axis, ahead, scatterers):
        around = eqx.tree_at(lambda e: e.scatterers.position_m, environment, scatterers)
        link = one_way_gain(tag, antenna, carrier, around, transmission=factor, dipole=axis, boresight=ahead)
        return reported_phase_rad(two_way_gain(link)), rssi_from_gain_dbm(two_way_gain(link), at_1m_dbm=0.0)

    return jax.vmap(one)(tag_m, antenna_m, carrier_hz, transmission, dipole, boresight, scatterer_m)


def clock_stamps(
    time_s: Float[np.ndarray, " reads"], settings: InventorySettings, rng: np.random.Generator, *, origin_ns: int = 0
) -> tuple[Int[np.ndarray, " reads"], Int[np.ndarray, " reads"]]:
    """Arrival at the host and the reader's own stamp of reads at increasing true times, both int64 ns.

    host = reader + offset + drift * (reader - start), as in `ClockAudit`. Arrivals are late by the least latency and an
    exponential wait, cut at the most; a read does not overtake another.
    """
    offset, drift = settings.clock_offset_s, settings.clock_drift_ppm
    if offset is None:
        offset = float(rng.uniform(-CLOCK_OFFSET_S, CLOCK_OFFSET_S))
    if drift is None:
        drift = float(rng.choice([-1.0, 1.0]) * rng.uniform(*CLOCK_DRIFT_PPM))
    least, most = settings.latency_s
    wait = np.minimum(rng.exponential(LATENCY_MEAN_S, len(time_s)), most - least)
    host = np.maximum.accumulate(origin_ns + np.rint((time_s + least + wait) * 1e9).astype(np.int64))
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

    Paths by EPC, antennas and environment share one frame, metres; times count from `origin_ns`. On each path's own
    samples, by EPC and linear in between: `transmission` (samples,) or (samples, antennas), the ratio of fields that the
    line of sight keeps (default 1), and `dipole` (samples, 3), the tag's axis (default isotropic). `boresight`: axes of
    the antennas (default isotropic). `scatterer_path` moves the environment's scatterers: times (samples,) and places
    (samples, scatterers, 3).
    Phase: channel, affine offset over channels, constant by tag and antenna, noise by RSSI, pi flips, 12-bit steps.
    Reads out of view, below the sensitivity or in an outage are lost. Time stamps are arrivals; see `clock_stamps`.
    Unknown EPCs and wrong sizes raise `ValueError`. The same seed gives the same reads.
    """
    settings = settings or InventorySettings()
    epcs = list(paths)
    _check(paths, len(antennas_m), environment, transmission, dipole, scatterer_path)
    rng = np.random.default_rng(seed)
    state = reader or ReaderState.draw(settings.reader(), rng)
    start = min(float(path.time_s[0]) for path in paths.values())
    stop = max(float(path.time_s[-1]) for path in paths.values())
    turn = {"num_antennas": len(antennas_m), "rounds_per_antenna": settings.rounds_per_antenna}
    slots = draw_schedule(start, stop, len(epcs), rng, **turn)
    kept = (rng.random(len(slots.time_s)) >= settings.dropout) & ~_in_outage(slots.time_s, start, stop, settings, rng)
    time_s, tag, antenna = slots.time_s[kept], slots.tag[kept], slots.antenna[kept]

    position, speed = np.full((len(time_s), 3), np.nan), np.zeros(len(time_s))
    passed, axis = np.ones(len(time_s)), np.zeros((len(time_s), 3))
    for number, epc in enumerate(epcs):
        mine = np.flatnonzero(tag == number)
        when, path, port = time_s[mine], paths[epc], antenna[mine]
        position[mine] = path.at(when)
        ahead, behind = (np.linalg.norm(path.at(when + step) - antennas_m[port], axis=1) for step in (1e-3, -1e-3))
        speed[mine] = np.nan_to_num((ahead - behind) / 2e-3)  # at a path's very ends the speed is not known
        if transmission is not None and epc in transmission:
            every = _interpolate(when, path.time_s, transmission[epc])
            passed[mine] = every if every.ndim == 1 else every[np.arange(len(mine)), port % every.shape[1]]
        if dipole is not None and epc in dipole:
            axis[mine] = _unit(_interpolate(when, path.time_s, dipole[epc]))
    seen = np.all(np.isfinite(position), axis=1)
    time_s, tag, antenna, position = time_s[seen], tag[seen], antenna[seen], position[seen]
    speed, passed, axis = speed[seen], passed[seen], axis[seen]

    index = channel_at(time_s, state, settings.reader())
    carrier, place = state.hop_table_hz[index], antennas_m[antenna]
    facing = _unit(np.zeros_like(antennas_m) if boresight is None else boresight)[antenna]
    around = np.broadcast_to(environment.scatterers.position_m, (len(time_s), *environment.scatterers.position_m.shape))
    if scatterer_path is not None:
        around = _interpolate(time_s, *scatterer_path)
    phase, rssi = _padded_gains(environment, position, place, carrier, passed, axis, facing, around)
    rssi = rssi + settings.rssi_at_1m_dbm
    range_m = np.linalg.norm(position - place, axis=1)
    straight = 4 * np.pi * carrier * range_m / SPEED_OF_LIGHT_M_S
    # The fitted noise grows without bound: below the sensitivity it would lift hopeless reads above it.
    sigma = noise_sigma_rad(np.maximum(rssi, settings.sensitivity_dbm), state.floor_rad)
    measured = rssi + RSSI_NOISE_DB_PER_RAD * sigma * rng.normal(size=len(rssi))
    constant = rng.uniform(0, 2 * np.pi, (len(epcs), len(antennas_m)))
    noisy = (
        phase
        + state.offset_rad[index]
        + constant[tag, antenna]
        + sigma * rng.normal(size=len(rssi))
        + np.pi * (rng.random(len(rssi)) < settings.flip_share)
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
        pi_flips=settings.flip_share > 0,
    )
    multipath = (phase - straight + np.pi) % (2 * np.pi) - np.pi
    heard = measured >= settings.sensitivity_dbm
    return Inventory(reads[heard], time_s[heard], range_m[heard], position[heard], passed[heard], multipath[heard])


def _in_outage(time_s, start, stop, settings, rng) -> np.ndarray:
    """Which slots fall into an outage of the reader; outages are a Poisson process with exponential lengths."""
    begins = rng.uniform(start, stop, rng.poisson(settings.outages_per_minute * (stop - start) / 60))
    ends = begins + rng.exponential(OUTAGE_S, len(begins))
    return np.any((time_s[:, None] >= begins) & (time_s[:, None] < ends), axis=1)


def _interpolate(when, time_s, values) -> np.ndarray:
    """Values (samples, ...) at other times, linear between samples, (len(when), ...)."""
    values = np.asarray(values, float)
    out = np.zeros((len(when), values[0].size))
    for number, column in enumerate(values.reshape(len(time_s), -1).T):
        out[:, number] = np.interp(when, time_s, column)
    return out.reshape(len(when), *values.shape[1:])


def _unit(x) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-9)


def _padded_gains(environment, *columns) -> tuple[np.ndarray, np.ndarray]:
    """`link_gains` of any number of reads, padded to a power of two so that few sizes are ever compiled."""
    count = len(columns[0])
    if count == 0:
        return np.zeros(0), np.zeros(0)
    size = max(256, 1 << (count - 1).bit_length())
    # The last read is repeated: a row of zeros would put a tag onto its antenna.
    rows = np.minimum(np.arange(size), count - 1)
    phase, rssi = link_gains(environment, *(jnp.asarray(np.asarray(c)[rows], jnp.float32) for c in columns))
    return np.asarray(phase, float)[:count], np.asarray(rssi, float)[:count]


def _check(paths, num_antennas, environment, transmission, dipole, scatterer_path) -> None:
    if not paths:
        raise ValueError("No path; an inventory needs at least one tag.")
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
