"""A recording of ten seconds and more in which one tag is moved by starts and stops, without fault; and faults, one at a time."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

import numpy as np

from tagjax.core.camera import Intrinsics
from tagjax.radio.reader import ReaderSettings
from tagjax.recording import Recording, TagReads
from tagjax.recording.virtual_tags import Track, virtual_reads

EPC = "E28011000000000000000001"
RATE_HZ, SECONDS = 20.0, 15.0
_HEIGHT, _WIDTH = 48, 64
_TURN_S, _MOVING_S = 3.0, 2.0
READER = ReaderSettings(region="etsi", dwell_s=2.0, flip_probability=0.0, multipath_rad=0.02, dropout=0.0)


def moved(time_s: np.ndarray) -> np.ndarray:
    """Fraction of the way, 0 to 1 and back: two seconds of motion, one of rest, with sin^2 speed."""
    turn, within = np.divmod(time_s, _TURN_S)
    u = np.clip(within / _MOVING_S, 0.0, 1.0)
    there = u - np.sin(2 * np.pi * u) / (2 * np.pi)
    return np.where(turn % 2 == 0, there, 1.0 - there)


def reads_of(way_m: float, *, seed: int = 1) -> TagReads:
    """Reads of the tag as it moves 1.5 m before the camera by `way_m` and back, along the optical axis."""
    time_s = np.arange(0, SECONDS, 0.01)
    path = np.zeros((len(time_s), 3))
    path[:, 2] = 1.5 + way_m * moved(time_s)
    return virtual_reads(Track(time_s, path), EPC, READER, seed=seed, antenna_m=np.zeros(3))


@functools.cache
def faultless() -> Recording:
    """No line of its check is worse than good."""
    rng = np.random.default_rng(0)
    time_s = np.arange(0, SECONDS, 1 / RATE_HZ)
    background, thing = rng.integers(60, 120, (_HEIGHT, _WIDTH, 3)), rng.integers(130, 250, (12, 12, 3))
    colour = np.repeat(background[None], len(time_s), axis=0).astype(np.uint8)
    depth = np.full((len(time_s), _HEIGHT, _WIDTH), 3000, np.uint16)
    for frame, fraction in enumerate(moved(time_s)):
        left = 8 + round(35 * float(fraction))
        colour[frame, 18:30, left : left + 12] = thing
        depth[frame, 18:30, left : left + 12] = 1500 + 300 * fraction
    return Recording(
        colour=colour,
        depth=depth,
        time_ns=np.rint(time_s * 1e9).astype(np.int64),
        intrinsics=Intrinsics(fx_px=60.0, fy_px=60.0, cx_px=31.5, cy_px=23.5, width=_WIDTH, height=_HEIGHT),
        reads=reads_of(0.35),
        name="shaken",
    )


def _reads(change: Callable[[TagReads, np.random.Generator], TagReads]) -> Callable[[Recording], Recording]:
    return lambda one: one.with_reads(change(one.reads, np.random.default_rng(3)))


def _wrapped(reads: TagReads, added_rad: np.ndarray) -> TagReads:
    return dataclasses.replace(reads, phase_rad=(reads.phase_rad + added_rad) % (2 * np.pi))


def _frames(recording: Recording, kept: np.ndarray) -> Recording:
    arrays = {name: np.asarray(getattr(recording, name))[kept] for name in ("colour", "depth", "time_ns")}
    return dataclasses.replace(recording, **arrays)


def _without_depth(recording: Recording) -> Recording:
    depth = np.array(recording.depth)
    depth[:, :, ::2] = 0
    return dataclasses.replace(recording, depth=depth)


def _dropped(recording: Recording) -> Recording:
    return _frames(recording, np.random.default_rng(4).random(recording.num_frames) > 0.08)


FAULTS: dict[str, Callable[[Recording], Recording]] = {
    "read_rate": _reads(lambda reads, _: reads[::4]),
    "gaps": _reads(lambda reads, _: reads[(reads.time_ns < 6_000_000_000) | (reads.time_ns > 8_000_000_000)]),
    "phase_noise": _reads(lambda reads, rng: _wrapped(reads, rng.normal(0, 0.2, reads.num_reads))),
    "pi_flips": _reads(lambda reads, rng: _wrapped(reads, np.pi * (rng.random(reads.num_reads) < 0.08))),
    "hopping": _reads(
        lambda reads, rng: dataclasses.replace(
            reads, carrier_hz=np.where(rng.random(reads.num_reads) < 0.1, np.nan, reads.carrier_hz)
        )
    ),
    "speed": lambda one: one.with_reads(reads_of(2.7)),
    "rssi": _reads(lambda reads, _: dataclasses.replace(reads, rssi_dbm=reads.rssi_dbm - 20)),
    "clock": _reads(lambda reads, _: dataclasses.replace(reads, time_ns=reads.time_ns + 300_000_000)),
    "depth": _without_depth,
    "frame_rate": lambda one: _frames(one, np.arange(one.num_frames) % 3 == 0),
    "dropped_frames": _dropped,
}
"""By the name of a line: the fault that only this line reports."""
