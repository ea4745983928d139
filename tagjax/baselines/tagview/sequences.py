"""Phase and RSSI of every tag, unwrapped and brought to the times of the frames (Tagview, IV.A-B)."""

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
from ...radio.noise import estimate_flip_probability
from ...recording import TagReads
from ..reads import hop_slope_rad_hz, padded_size, range_phase_rad, usable_reads
from .interpolation import interpolate
from .splicing import pieces, splice_phase

Hops = Literal["ignore", "affine", "break"]

_PAD_READS = 256
_PAD_TAGS = 4
_MIN_FLIP_FRACTION = 0.01
_DEFAULT_CARRIER_HZ = 920e6


@dataclasses.dataclass(frozen=True)
class ReadSettings:
    """How reads become sequences. The paper's reader stays on neighbouring channels and has no pi flips."""

    antenna: int = 1
    hops: Hops = "affine"  # ours: subtract the offset over channels; break: a new piece at each hop; ignore: the paper
    pi_flips: bool | None = None  # ours: unwrap modulo pi; None: estimated from the reads
    break_at_gaps: bool = True  # ours: a phase offset of its own after each gap
    max_gap_s: float = 0.25  # between reads of one piece
    rssi_window_s: float = 0.3  # ours: RSSI is averaged over this time before it is compared

    def __post_init__(self):
        if self.antenna < 1:
            raise ValueError(f"antenna is {self.antenna}; antennas are counted from 1.")
        if self.hops not in ("ignore", "affine", "break"):
            raise ValueError(f"hops is {self.hops!r}; expected ignore, affine or break.")
        if not (self.max_gap_s > 0 and self.rssi_window_s >= 0):
            raise ValueError(
                f"max_gap_s {self.max_gap_s}, rssi_window_s {self.rssi_window_s}; expected a positive time, and one that is "
                "not negative."
            )


class TagSequences(eqx.Module):
    """Phase and RSSI of each tag at the times of the frames."""

    phase_rad: Float[Array, "tags time"]  # unwrapped
    phase_known: Bool[Array, "tags time"]
    piece: Int[Array, "tags time"]  # number of the piece with one phase offset
    rssi_dbm: Float[Array, "tags time"]
    rssi_known: Bool[Array, "tags time"]


@dataclasses.dataclass(frozen=True)
class TagMeasurements:
    """Sequences of all traced tags, and the wavelength of their phases."""

    sequences: TagSequences
    wavelength_m: float


def tag_measurements(
    epcs: Sequence[str],
    reads: TagReads,
    read_time_s: Shaped[np.ndarray, " reads"],
    frame_time_s: Shaped[np.ndarray, " frames"],
    settings: ReadSettings,
) -> TagMeasurements:
    """Sequences of the tags at the frames, in the order of `epcs`; a tag that was not read has no known sample.

    For readers that hop, phi = 4 pi f d / c + c0 + s (f - f0). The slope s, together with the slope of the mean
    distance, is estimated at the hops (median over tags) and subtracted.
    """
    usable = usable_reads(reads, settings.antenna)
    reads, read_time_s = reads[usable], np.asarray(read_time_s, np.float64)[usable]
    carrier_hz, phase_rad = np.asarray(reads.carrier_hz, np.float64), range_phase_rad(reads)
    reference_hz = float(np.median(carrier_hz)) if len(carrier_hz) else _DEFAULT_CARRIER_HZ
    own = [np.flatnonzero(reads.epc == epc) for epc in epcs]
    channel = np.unique(carrier_hz, return_inverse=True)[1].reshape(-1)
    flips = settings.pi_flips
    if flips is None:
        flips = _has_pi_flips(reads, [(phase_rad[index], read_time_s[index], channel[index]) for index in own])
    if settings.hops == "affine":
        slopes = [hop_slope_rad_hz(phase_rad[i], read_time_s[i], carrier_hz[i]) for i in own if len(i)]
        known = [slope for slope in slopes if np.isfinite(slope)]
        phase_rad = phase_rad - (float(np.median(known)) if known else 0.0) * (carrier_hz - reference_hz)
    size = padded_size(max((len(index) for index in own), default=1) or 1, _PAD_READS)
    num_tags = padded_size(max(len(epcs), 1), _PAD_TAGS)

    def padded(column: np.ndarray, kind: type) -> Array:
        out = np.zeros((num_tags, size), kind)
        for row, index in enumerate(own):
            out[row, : len(index)] = column[index]
        return jnp.asarray(out)

    sequences = _sequences(
        padded(read_time_s, np.float32),
        padded(phase_rad, np.float32),
        padded(channel, np.int32),
        padded(np.asarray(reads.rssi_dbm), np.float32),
        padded(np.ones(len(carrier_hz)), np.bool_),
        jnp.asarray(frame_time_s, jnp.float32),
        period_rad=float(np.pi if flips else 2 * np.pi),
        max_gap_s=settings.max_gap_s,
        break_at_gaps=settings.break_at_gaps,
        break_at_hops=settings.hops == "break",
        rssi_window_s=settings.rssi_window_s,
    )
    return TagMeasurements(jax.tree.map(lambda x: x[: len(epcs)], sequences), SPEED_OF_LIGHT_M_S / reference_hz)


def _has_pi_flips(reads: TagReads, columns: Sequence[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> bool:
    """Whether the reader's phases have pi flips: its own statement, or the median over tags of (phase, time,
    channel).
    """
    if reads.pi_flips is not None:
        return bool(reads.pi_flips)
    fractions = [estimate_flip_probability(*one) for one in columns]
    known = [fraction for fraction in fractions if np.isfinite(fraction)]
    return bool(known) and float(np.median(known)) > _MIN_FLIP_FRACTION


@functools.partial(
    jax.jit, static_argnames=("period_rad", "max_gap_s", "break_at_gaps", "break_at_hops", "rssi_window_s")
)
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
    rssi_window_s: float,
) -> TagSequences:
    """The sequences of padded reads."""

    def one_tag(time_s, phase_rad, channel, rssi_dbm, valid):
        unwrapped = splice_phase(phase_rad, valid, period_rad)
        gap_s = max_gap_s if break_at_gaps else float("inf")
        part = pieces(time_s, channel, valid, max_gap_s=gap_s, break_at_hops=break_at_hops)
        valid_s = jnp.where(valid, time_s, jnp.inf)
        after = jnp.searchsorted(valid_s, frame_time_s, side="left").astype(jnp.int32)
        before = jnp.maximum(after - 1, 0)
        after = jnp.minimum(after, time_s.shape[0] - 1)
        inside = (valid_s[before] <= frame_time_s) & (valid_s[after] >= frame_time_s)
        near = inside & (valid_s[after] - valid_s[before] <= max_gap_s)
        # Both reads around a frame must belong to one piece: nothing is interpolated over a break.
        phase_known = near & (part[before] == part[after])
        # Numbers of pieces within the frames, as `fit_line` needs them.
        first = jnp.min(jnp.where(phase_known, part[after], part[-1]))
        piece = jnp.minimum(part[after] - first, frame_time_s.shape[0] - 1)
        phase = interpolate(time_s, unwrapped, valid, frame_time_s)
        has_rssi = valid & jnp.isfinite(rssi_dbm)
        reach_s = 0.5 * jnp.maximum(jnp.asarray(rssi_window_s, time_s.dtype), 1e-3)
        counts = has_rssi[None, :] & (jnp.abs(time_s[None, :] - frame_time_s[:, None]) <= reach_s)
        number = jnp.sum(counts, axis=1).astype(time_s.dtype)
        mean_dbm = jnp.sum(jnp.where(counts, rssi_dbm[None, :], 0.0), axis=1) / jnp.maximum(number, 1.0)
        return phase, phase_known, jnp.where(phase_known, piece, 0), mean_dbm, number > 0

    return TagSequences(*jax.vmap(one_tag)(time_s, phase_rad, channel, rssi_dbm, valid))
