"""Reads of every tag, spliced and brought to the times of the frames (Tagview, IV.A-B)."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...radio.channels import MAX_SLOPE_RAD_HZ, estimate_slope
from ...radio.noise import pi_flip_share
from ...recording import TagReads
from ._hermite import interpolate
from ._phase import pieces, splice_phase

Hops = Literal["ignore", "affine", "break"]

_PAD_READS = 256
_PAD_TAGS = 4
_FLIP_SHARE = 0.01


@dataclasses.dataclass(frozen=True)
class ReadSettings:
    """How reads become sequences. The paper's reader stays on neighbouring channels and has no flips."""

    antenna: int = 1
    hops: Hops = "affine"  # ours: take the offset over channels off; break: a new piece at each hop; ignore: the paper
    flips: bool | None = None  # ours: splice modulo pi; None asks the reads
    break_at_gaps: bool = True  # ours: a phase constant of its own after each gap
    max_gap_s: float = 0.25  # between reads around a frame that count as one piece
    smooth_s: float = 0.3  # ours: strengths are averaged over this time before they are compared

    def __post_init__(self):
        if self.antenna < 1:
            raise ValueError(f"antenna is {self.antenna}; antennas are counted from 1.")
        if self.hops not in ("ignore", "affine", "break"):
            raise ValueError(f"hops is {self.hops!r}; expected ignore, affine or break.")
        if not (self.max_gap_s > 0 and self.smooth_s >= 0):
            raise ValueError(
                f"max_gap_s {self.max_gap_s}, smooth_s {self.smooth_s}; expected positive, and not negative."
            )


class TagSequences(eqx.Module):
    """What each tag said, at the times of the frames."""

    phase_rad: Float[Array, "tags time"]  # spliced
    heard: Bool[Array, "tags time"]
    piece: Int[Array, "tags time"]
    rssi_dbm: Float[Array, "tags time"]
    strong: Bool[Array, "tags time"]  # the strength is known


@dataclasses.dataclass(frozen=True)
class Heard:
    """Sequences of all tags asked for, and the wavelength that their phases are counted in."""

    sequences: TagSequences
    wavelength_m: float


def useful_reads(reads: TagReads, antenna: int) -> Bool[np.ndarray, " reads"]:
    """Reads of the antenna with a known carrier."""
    return np.asarray((reads.antenna == antenna) & np.isfinite(reads.carrier_hz))


def hear(
    epcs: Sequence[str],
    reads: TagReads,
    read_time_s: Shaped[np.ndarray, " reads"],
    frame_time_s: Shaped[np.ndarray, " frames"],
    settings: ReadSettings,
) -> Heard:
    """Sequences of the tags at the frames, in the order of `epcs`; a tag that was not read has nothing heard.

    Where readers hop, phi = 4 pi f d / c + c0 + s (f - f0): the slope s, with what the mean distance adds to it, shows
    at the hops (`rf.channels.estimate_slope`, the median over tags) and is taken off.
    """
    useful = useful_reads(reads, settings.antenna)
    reads, read_time_s = reads[useful], np.asarray(read_time_s, np.float64)[useful]
    carrier = np.asarray(reads.carrier_hz, np.float64)
    reference_hz = float(np.median(carrier)) if len(carrier) else 920e6
    phase = np.mod(reads.phase_sign * np.asarray(reads.phase_rad, np.float64), 2 * np.pi)
    channel = np.unique(carrier, return_inverse=True)[1].reshape(-1)
    own = [np.flatnonzero(reads.epc == epc) for epc in epcs]
    flips = settings.flips
    if flips is None:
        flips = _has_flips(reads, own, phase, read_time_s, channel)
    if settings.hops == "affine":
        phase = phase - _hop_slope(own, phase, read_time_s, channel, carrier) * (carrier - reference_hz)
    longest = max((len(index) for index in own), default=0)
    size = max(_PAD_READS, -(-longest // _PAD_READS) * _PAD_READS)
    tags = max(_PAD_TAGS, -(-len(epcs) // _PAD_TAGS) * _PAD_TAGS)

    def padded(column: np.ndarray, kind: type) -> Array:
        out = np.zeros((tags, size), kind)
        for row, index in enumerate(own):
            out[row, : len(index)] = column[index]
        return jnp.asarray(out)

    said = _sequences(
        padded(read_time_s, np.float32),
        padded(phase, np.float32),
        padded(channel, np.int32),
        padded(np.asarray(reads.rssi_dbm), np.float32),
        padded(np.ones(len(carrier)), np.bool_),
        jnp.asarray(frame_time_s, jnp.float32),
        period_rad=float(np.pi if flips else 2 * np.pi),
        max_gap_s=settings.max_gap_s,
        break_at_gaps=settings.break_at_gaps,
        break_at_hops=settings.hops == "break",
        smooth_s=settings.smooth_s,
    )
    return Heard(jax.tree.map(lambda x: x[: len(epcs)], said), SPEED_OF_LIGHT_M_S / reference_hz)


def _has_flips(reads: TagReads, own, phase, time_s, channel) -> bool:
    if reads.pi_flips is not None:
        return bool(reads.pi_flips)
    shares = [pi_flip_share(phase[index], time_s[index], channel[index]) for index in own]
    known = [share for share in shares if np.isfinite(share)]
    return bool(known) and float(np.median(known)) > _FLIP_SHARE


def _hop_slope(own, phase, time_s, channel, carrier) -> float:
    """The slope over carriers that the tags' hops agree on, rad/Hz; 0 where they show none."""
    found = [estimate_slope(phase[i], time_s[i], channel[i], carrier[i]) for i in own if len(i)]
    settled = [
        one.slope_rad_hz for one in found if one.residual_rad < np.pi and abs(one.slope_rad_hz) < MAX_SLOPE_RAD_HZ
    ]
    return float(np.median(settled)) if settled else 0.0


@functools.partial(jax.jit, static_argnames=("period_rad", "max_gap_s", "break_at_gaps", "break_at_hops", "smooth_s"))
def _sequences(
    time_s: Float[Array, "tags reads"],
    phase_rad: Float[Array, "tags reads"],
    channel: Int[Array, "tags reads"],
    rssi_dbm: Float[Array, "tags reads"],
    valid: Bool[Array, "tags reads"],
    frame_time_s: Float[Array, " time"],
    *,
    period_rad: float,
    max_gap_s: float,
    break_at_gaps: bool,
    break_at_hops: bool,
    smooth_s: float,
) -> TagSequences:
    def one(time_s, phase_rad, channel, rssi_dbm, valid):
        spliced = splice_phase(phase_rad, valid, period_rad)
        gap_s = max_gap_s if break_at_gaps else float("inf")
        part = pieces(time_s, channel, valid, max_gap_s=gap_s, break_at_hops=break_at_hops)
        known = jnp.where(valid, time_s, jnp.inf)
        after = jnp.searchsorted(known, frame_time_s, side="left").astype(jnp.int32)
        before = jnp.maximum(after - 1, 0)
        after = jnp.minimum(after, time_s.shape[0] - 1)
        inside = (known[before] <= frame_time_s) & (known[after] >= frame_time_s)
        near = inside & (known[after] - known[before] <= max_gap_s)
        # The last valid read in the frame's piece may be far from the next piece's first: nothing spans a break.
        heard = near & (part[before] == part[after])
        # Numbers of pieces within the frames, as `fit_line` takes them.
        piece = jnp.minimum(part[after] - jnp.min(jnp.where(heard, part[after], part[-1])), frame_time_s.shape[0] - 1)
        phase = interpolate(time_s, spliced, valid, frame_time_s)
        told = valid & jnp.isfinite(rssi_dbm)
        reach = 0.5 * jnp.maximum(jnp.asarray(smooth_s, time_s.dtype), 1e-3)
        share = told[None, :] & (jnp.abs(time_s[None, :] - frame_time_s[:, None]) <= reach)
        number = jnp.sum(share, axis=1).astype(time_s.dtype)
        strength = jnp.sum(jnp.where(share, rssi_dbm[None, :], 0.0), axis=1) / jnp.maximum(number, 1.0)
        return phase, heard, jnp.where(heard, piece, 0), strength, number > 0

    return TagSequences(*jax.vmap(one)(time_s, phase_rad, channel, rssi_dbm, valid))
