"""The radio links between antennas and moving tags: at the times of replies, and which tags are in range when."""

from __future__ import annotations

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ...radio.reader import ReaderSettings, ReaderState, channel_at
from ...recording.virtual_tags import Track
from ..world.rotation import unit
from .channel import one_way_gain, reported_phase_rad, rssi_from_gain_dbm, two_way_gain
from .environment import Environment

REACH_EVERY_S = 0.1
"""Sampling period of which tags are in an antenna's range: half a dwell."""


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


@dataclasses.dataclass(frozen=True)
class Links:
    """The radio links of replies whose tag position is known; one row a reply."""

    time_s: np.ndarray
    tag: np.ndarray
    antenna: np.ndarray
    channel: np.ndarray
    position_m: np.ndarray
    transmission: np.ndarray
    phase_rad: np.ndarray
    rssi_dbm: np.ndarray


@dataclasses.dataclass(frozen=True)
class SetUp:
    """Everything that the channel between antennas and tags depends on. Lists have one element per tag."""

    paths: tuple[Track, ...]
    antennas_m: np.ndarray
    environment: Environment
    settings: ReaderSettings
    state: ReaderState
    rssi_at_1m_dbm: float  # in free space
    transmission: list[np.ndarray | None]
    dipole: list[np.ndarray | None]
    boresight: np.ndarray
    scatterer_path: tuple[np.ndarray, np.ndarray] | None

    def links(self, time_s: np.ndarray, tag: np.ndarray, antenna: np.ndarray) -> Links:
        """The links at given times of tags and antennas given by index. Times without a known tag position are left out."""
        position, passed = np.full((len(time_s), 3), np.nan), np.ones(len(time_s))
        axis = np.zeros((len(time_s), 3))
        for number, (path, factor, dipole) in enumerate(zip(self.paths, self.transmission, self.dipole, strict=True)):
            mine = np.flatnonzero(tag == number)
            when = time_s[mine]
            position[mine] = path.at(when)
            if factor is not None:
                every = interpolate(when, path.time_s, factor)
                several = every.ndim > 1
                passed[mine] = every[np.arange(len(mine)), antenna[mine] % every.shape[1]] if several else every
            if dipole is not None:
                axis[mine] = unit(interpolate(when, path.time_s, dipole))
        known = np.all(np.isfinite(position), axis=1)
        time_s, tag, antenna, position, passed = (x[known] for x in (time_s, tag, antenna, position, passed))
        channel = channel_at(time_s, self.state, self.settings)
        scatterers_m = self.environment.scatterers.position_m
        around = np.broadcast_to(scatterers_m, (len(time_s), *scatterers_m.shape))
        if self.scatterer_path is not None:
            around = interpolate(time_s, *self.scatterer_path)
        carrier, place = self.state.hop_table_hz[channel], self.antennas_m[antenna]
        phase, rssi = padded_gains(
            self.environment, position, place, carrier, passed, axis[known], self.boresight[antenna], around
        )
        return Links(time_s, tag, antenna, channel, position, passed, phase, rssi + self.rssi_at_1m_dbm)

    def tags_in_range(self, start_s: float, stop_s: float, min_dbm: float) -> tuple[np.ndarray, np.ndarray]:
        """Times, and which tags are in each antenna's range from each time on, (samples, tags, antennas)."""
        when = np.arange(start_s, stop_s, REACH_EVERY_S)
        shape = (len(when), len(self.paths), len(self.antennas_m))
        sample, tag, antenna = (grid.ravel() for grid in np.indices(shape))
        link = self.links(when[sample], tag, antenna)
        in_range = np.zeros(shape, bool)
        at = np.searchsorted(when, link.time_s)
        in_range[at, link.tag, link.antenna] = link.rssi_dbm >= min_dbm
        return when, in_range

    def speed_m_s(self, time_s: np.ndarray, tag: np.ndarray, antenna: np.ndarray) -> np.ndarray:
        """Rate of change of each range; 0 at the ends of a path, where it is unknown."""
        speed = np.zeros(len(time_s))
        for number, path in enumerate(self.paths):
            mine = np.flatnonzero(tag == number)
            place = self.antennas_m[antenna[mine]]
            ahead, behind = (np.linalg.norm(path.at(time_s[mine] + step) - place, axis=1) for step in (1e-3, -1e-3))
            speed[mine] = np.nan_to_num((ahead - behind) / 2e-3)
        return speed


def interpolate(when, time_s, values) -> np.ndarray:
    """Values (samples, ...) at other times, linear between samples, (len(when), ...)."""
    values = np.asarray(values, float)
    out = np.zeros((len(when), values[0].size))
    for number, column in enumerate(values.reshape(len(time_s), -1).T):
        out[:, number] = np.interp(when, time_s, column)
    return out.reshape(len(when), *values.shape[1:])


def padded_gains(environment, *columns) -> tuple[np.ndarray, np.ndarray]:
    """`link_gains` of any number of reads, padded to a power of two so that few sizes are compiled."""
    count = len(columns[0])
    if count == 0:
        return np.zeros(0), np.zeros(0)
    size = max(256, 1 << (count - 1).bit_length())
    # The last read is repeated: a row of zeros would place a tag at its antenna.
    rows = np.minimum(np.arange(size), count - 1)
    phase, rssi = link_gains(environment, *(jnp.asarray(np.asarray(c)[rows], jnp.float32) for c in columns))
    return np.asarray(phase, float)[:count], np.asarray(rssi, float)[:count]
