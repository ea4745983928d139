"""Evidence of reads for each (tag, segment): `radio.reader_model`, `tagattention.segments.dwell`, `.free_path` and `.detection`.

Reads of different tags are added at once: first each tag's first read of the frame, then each one's second, and so on.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import expit, i0e

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...radio.noise import UNKNOWN_RSSI_DBM
from ...radio.reader_model import ReaderModel
from ...tagattention.segments import dwell as original
from ...tagattention.segments import free_path as original_free
from ...tagattention.segments.detection import Detection
from ...tagattention.segments.free_path import FreePath

Reads = dict[str, np.ndarray]
"""The fields of a frame's `Arrivals`."""


class Reader:
    """The noise model of phases; see `ReaderModel`."""

    def __init__(self, model: ReaderModel) -> None:
        self.slope, self.intercept = np.float32(model.slope_per_dbm.value), np.float32(model.intercept)
        names = "floor_rad", "spread_rad", "still_spread_rad", "moving_m_s", "drift_m", "outlier"
        self.value = {name: np.float32(getattr(model, name).value) for name in names}
        self.multiple = np.float32(model.multiple)

    def concentration(self, rssi_dbm: Float[np.ndarray, " read"], speed_m_s: np.ndarray) -> np.ndarray:
        """Of reads (read, segment), by the speeds (read, segment)."""
        rssi = np.where(np.isfinite(rssi_dbm), rssi_dbm, np.float32(UNKNOWN_RSSI_DBM))
        by_rssi = np.exp(np.log(np.float32(10)) * (self.slope * rssi + self.intercept))
        thermal = np.square(self.value["floor_rad"]) + np.square(by_rssi)
        square, (still, spread) = (
            np.square(speed_m_s),
            np.square([self.value["still_spread_rad"], self.value["spread_rad"]]),
        )
        beside = still + (spread - still) * square / (square + np.square(self.value["moving_m_s"]))
        return 1 / (np.square(self.multiple) * (thermal[:, None] + beside))

    def moved(self, phasor: np.ndarray, moved_m: np.ndarray, depth_m: np.ndarray, carrier_hz: np.ndarray) -> np.ndarray:
        """Complex phasors (read, segment) after motions of what is `depth_m` (segment) away."""
        wave = (self.multiple * np.float32(4 * np.pi / SPEED_OF_LIGHT_M_S) * carrier_hz)[:, None]
        error_m2 = self.value["drift_m"] * np.square(depth_m) * np.abs(moved_m)
        variance = np.square(wave) * error_m2
        turn = wave * moved_m
        return phasor / (1 + np.abs(phasor) * variance) * (np.cos(turn) + 1j * np.sin(turn))

    def add(
        self, phasor: np.ndarray, concentration: np.ndarray, phase_rad: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The log likelihood ratios of reads (read, segment), nats, and the phasors after them."""
        angle = (self.multiple * phase_rad)[:, None]
        own = concentration * (np.cos(angle) + 1j * np.sin(angle))
        before, after = np.abs(phasor), np.abs(phasor + own)
        product, both = phasor * np.conj(own), before * concentration
        along, across = np.real(product), np.imag(product)
        agree = along > 0
        apart = np.where(agree, np.square(across) / np.where(agree, both + along, 1), both - along)
        lost = 2 * apart / (after + before + concentration)
        ratio = np.exp(-lost) * i0e(after) / (i0e(before) * i0e(concentration))
        outlier = self.value["outlier"]
        inlier = (1 - outlier) * ratio
        return np.log(inlier + outlier), phasor + inlier / (inlier + outlier) * own


class Dwells:
    """What the reads so far amount to, in place; see `DwellState`."""

    def __init__(
        self, settings: original.DwellEvidence, model: ReaderModel, num_tags: int, num_antennas: int, num: int
    ) -> None:
        self.reader, self.memory_s = Reader(model), np.float32(settings.memory_s.value)
        self.phasor = np.zeros((num_tags, num_antennas, num), np.complex64)
        self.read_m = np.zeros((num_tags, num_antennas, num), np.float32)
        self.distance_m = np.zeros((num_antennas, num), np.float32)
        self.channel = np.full((num_tags, num_antennas), -1, np.int32)
        self.log_likelihood = np.zeros((num_tags, num), np.float32)

    def step(
        self,
        arrivals: Reads,
        increment_m: Float[np.ndarray, "antenna segment"],
        depth_m: Float[np.ndarray, " segment"],
        source: Int[np.ndarray, " segment"],
        since_s: np.float32,
        now_s: np.float32,
        exists: Bool[np.ndarray, " segment"],
    ) -> Float[np.ndarray, "tag segment"]:
        """The evidence after a frame, nats: the state's own array."""
        new = np.flatnonzero(source > -2)
        new = new[new > 0]
        old = np.maximum(source[new], 0)
        for table in (self.phasor, self.read_m, self.distance_m, self.log_likelihood):
            table[..., new] = table[..., old]
        self.log_likelihood *= np.exp(-(now_s - since_s) / self.memory_s)
        unknown = new[source[new] <= 0]
        self.log_likelihood[:, unknown] = np.maximum(self.log_likelihood[:, unknown], 0)
        increment_m = increment_m.copy()
        increment_m[:, 0] = 0
        # A frame without depth shows no segment, but they are there.
        slots = np.union1d(0, np.flatnonzero(exists)) if exists.any() else np.arange(len(source))
        for at in _rounds(arrivals["tag"], arrivals["valid"]):
            self._add(at, slots, arrivals, increment_m, depth_m, since_s, now_s)
        self.distance_m += increment_m
        return self.log_likelihood

    def _add(
        self,
        at: np.ndarray,
        slots: np.ndarray,
        arrivals: Reads,
        increment_m: np.ndarray,
        depth_m: np.ndarray,
        since_s: np.float32,
        now_s: np.float32,
    ) -> None:
        """Add the reads `at`, all of different tags, at the segments `slots`."""
        tag, antenna, time_s = arrivals["tag"][at], arrivals["antenna"][at], arrivals["time_s"][at]
        carrier_hz, rssi_dbm = arrivals["carrier_hz"][at], arrivals["rssi_dbm"][at]
        span_s = max(now_s - since_s, np.float32(original._SHORTEST_FRAME_S))
        part = np.clip((time_s - since_s) / span_s, 0, 1).astype(np.float32)
        distance_m = self.distance_m[:, slots][antenna] + part[:, None] * increment_m[:, slots][antenna]
        rows = tag[:, None], antenna[:, None], slots
        goes_on = (arrivals["channel"][at] == self.channel[tag, antenna])[:, None]
        phasor = np.where(goes_on, self.phasor[rows], np.complex64(0))
        moved_m = np.where(goes_on, distance_m - self.read_m[rows], np.float32(0))
        concentration = self.reader.concentration(rssi_dbm, increment_m[:, slots][antenna] / span_s)
        phasor = self.reader.moved(phasor, moved_m, depth_m[slots], carrier_hz)
        evidence, phasor = self.reader.add(phasor, concentration, arrivals["phase_rad"][at])
        self.phasor[rows], self.read_m[rows] = phasor, distance_m
        self.channel[tag, antenna] = arrivals["channel"][at]
        fresh = np.exp(-np.maximum(now_s - time_s, 0) / self.memory_s)
        self.log_likelihood[tag[:, None], slots] += fresh[:, None] * evidence


def _rounds(tag: Int[np.ndarray, " read"], valid: Bool[np.ndarray, " read"]) -> list[np.ndarray]:
    """Indices of reads: each tag's first, each tag's second, ... in order of time."""
    at = np.flatnonzero(valid)
    order = at[np.argsort(tag[at], kind="stable")]
    if not len(order):
        return []
    begins = np.flatnonzero(np.diff(tag[order], prepend=-1))
    rank = np.arange(len(order)) - np.repeat(begins, np.diff(begins, append=len(order)))
    return [order[rank == number] for number in range(rank.max() + 1)]


class FreePaths:
    """Evidence for paths that nothing in view follows, in place; see `FreePath`."""

    def __init__(self, settings: FreePath, model: ReaderModel, num_tags: int, num_antennas: int) -> None:
        self.reader, self.walk = Reader(model), np.float32(settings.walk_m2_s3)
        self.speed_m_s = np.linspace(-settings.max_speed_m_s, settings.max_speed_m_s, settings.num_speeds).astype("f4")
        self.apart2 = np.square(self.speed_m_s[:, None] - self.speed_m_s)
        rows = num_tags, num_antennas, settings.num_speeds
        self.phasor = np.zeros(rows, np.complex64)
        self.probability = np.full(rows, 1 / settings.num_speeds, np.float32)
        self.time_s = np.full(rows[:2], np.nan, np.float32)
        self.channel = np.full(rows[:2], -1, np.int32)
        self.log_likelihood = np.zeros(num_tags, np.float32)

    def step(self, arrivals: Reads, memory_s: np.float32, since_s: np.float32, now_s: np.float32) -> np.ndarray:
        """What a frame's reads add to the evidence of each tag, nats."""
        added = np.zeros_like(self.log_likelihood)
        for at in _rounds(arrivals["tag"], arrivals["valid"]):
            tag, antenna, time_s = arrivals["tag"][at], arrivals["antenna"][at], arrivals["time_s"][at]
            last_s = self.time_s[tag, antenna]
            gap_s = np.where(np.isfinite(last_s), np.maximum(time_s - last_s, 0), np.float32(0))
            walk_m_s = np.maximum(np.sqrt(self.walk * gap_s), np.float32(original_free._SHORTEST_WALK_M_S))
            spread = np.exp(-0.5 * self.apart2 / np.square(walk_m_s)[:, None, None])
            spread /= spread.sum(axis=1, keepdims=True)
            probability = np.einsum("rij,rj->ri", spread, self.probability[tag, antenna])
            goes_on = (arrivals["channel"][at] == self.channel[tag, antenna])[:, None]
            phasor = np.where(goes_on, self.phasor[tag, antenna], np.complex64(0))
            moved_m, depth_m = gap_s[:, None] * self.speed_m_s, np.full(1, original_free._DEPTH_M, np.float32)
            phasor = self.reader.moved(phasor, moved_m, depth_m, arrivals["carrier_hz"][at])
            speeds = np.broadcast_to(self.speed_m_s, moved_m.shape)
            concentration = self.reader.concentration(arrivals["rssi_dbm"][at], speeds)
            evidence, phasor = self.reader.add(phasor, concentration, arrivals["phase_rad"][at])
            explained = probability * np.exp(evidence)
            total = explained.sum(axis=1)
            self.phasor[tag, antenna], self.probability[tag, antenna] = phasor, explained / total[:, None]
            self.time_s[tag, antenna], self.channel[tag, antenna] = time_s, arrivals["channel"][at]
            added[tag] += np.exp(-np.maximum(now_s - time_s, 0) / memory_s) * np.log(total)
        self.log_likelihood = np.exp(-(now_s - since_s) / memory_s) * self.log_likelihood + added
        return added


class Confidence:
    """Recent reads, and the confidence that a tag is on its body; see `Detection`."""

    def __init__(self, settings: Detection, num_tags: int) -> None:
        self.settings, self.fresh_s = settings, np.float32(settings.fresh_s.value)
        self.threshold, self.num_reads = np.float32(settings.threshold), np.zeros(num_tags, np.float32)
        self.recent_free_nats = np.zeros(num_tags, np.float32)

    def received(
        self,
        arrivals: Reads,
        added_free_nats: np.ndarray,
        since_s: np.float32,
        now_s: np.float32,
    ) -> None:
        """Count a frame's reads, and what they add to the evidence for a free path."""
        fresh = np.exp(-np.maximum(now_s - arrivals["time_s"], 0) / self.fresh_s)
        new = np.bincount(arrivals["tag"], np.where(arrivals["valid"], fresh, 0), len(self.num_reads))
        kept = np.exp(-(now_s - since_s) / self.fresh_s)
        self.num_reads = self.num_reads * kept + new.astype(np.float32)
        self.recent_free_nats = self.recent_free_nats * kept + added_free_nats

    def of(self, body_nats: np.ndarray, stationary_nats: np.ndarray, free_nats: np.ndarray) -> np.ndarray:
        """The confidence of each tag, from the evidence (tag) for each explanation of its reads."""
        one = self.settings
        some_path, none = np.maximum(body_nats, free_nats), np.maximum(stationary_nats, 0)
        moves = (some_path - none) / np.float32(one.moves_nats.value) - float(one.moves_level)
        better = body_nats - float(one.stationary) * np.minimum(stationary_nats, 0)
        free, free_recent = np.maximum(free_nats, 0), np.maximum(self.recent_free_nats, 0)
        better -= float(one.free) * free + float(one.free_recent) * free_recent
        odds = better / np.float32(one.temperature_nats.value) - float(one.level)
        return expit(moves) * expit(odds) * -np.expm1(-self.num_reads)
