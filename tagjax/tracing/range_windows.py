"""From tag reads to the tracer's radio inputs at every frame: relative ranges over a sliding window, and its reads."""

from __future__ import annotations

import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..core.numerics import SPEED_OF_LIGHT_M_S
from ..radio.bayes_filter import FilteredPath, RadioModel, filter_reads, reference_carrier
from ..radio.channels import estimate_slope
from ..radio.noise import estimate_flip_probability, thermal_sigma_rad
from ..radio.published import published_distance
from ..radio.reads import PhaseReads, RadioWindow
from ..radio.refine import refine_path
from ..radio.resample import resample_polynomial
from ..radio.unwrap import unwrap_paper
from ..recording import TagReads

MAX_GAP_S = 0.5
"""A gap without reads of this length leaves a tag's motion unknown."""

DEFAULT_FLIP_SHARE = 0.05
"""Probability of a pi flip where reads are too sparse to distinguish a flip from motion."""

_LENGTH_STEP = 256
_PAST_KNOTS = 3
_PAST_SPACING_S = 0.1


def host_reads(
    reads: TagReads, epc: str, origin_ns: int, *, length: int | None = None, antenna: int | None = None
) -> PhaseReads:
    """The reads of one tag as a buffer of NumPy arrays; times in seconds from `origin_ns`.

    Reads of unknown carrier are left out, and so are those of other antennas than `antenna` (counted from 1) if it is
    given: ranges are estimated to one antenna at a time. The length is padded to a multiple of 256 unless given, so that
    tags and recordings share compiled code. An EPC that was never read raises `RecordingError`.
    """
    own = reads.select(epc)
    own = own[np.isfinite(own.carrier_hz) & (antenna is None or own.antenna == antenna)]
    count = own.num_reads
    size = length or max(_LENGTH_STEP, -(-count // _LENGTH_STEP) * _LENGTH_STEP)
    if count > size:
        raise ValueError(f"{count} reads of {epc} do not fit a buffer of {size}; give a length of at least {count}.")
    pairs, channel = np.unique(np.stack([own.antenna, own.carrier_hz]), axis=1, return_inverse=True)
    del pairs

    def padded(column: np.ndarray, fill: float | int, dtype: type) -> Any:
        out = np.full(size, fill, dtype)
        out[:count] = column
        return out

    last = float((own.time_ns[-1] - origin_ns) * 1e-9) if count else 0.0
    return PhaseReads(
        time_s=padded((own.time_ns - origin_ns) * 1e-9, last, np.float32),
        phase_rad=padded(np.mod(own.phase_sign * own.phase_rad, 2 * np.pi), 0.0, np.float32),
        carrier_hz=padded(own.carrier_hz, 915e6, np.float32),
        sigma_rad=padded(thermal_sigma_rad(own.rssi_dbm), 1.0, np.float32),
        channel=padded(channel.reshape(-1), -1, np.int32),
        valid=padded(np.ones(count), 0.0, np.bool_),
    )


def phase_reads(
    reads: TagReads, epc: str, origin_ns: int, *, length: int | None = None, antenna: int | None = None
) -> PhaseReads:
    """`host_reads` on the device."""
    return jax.tree.map(jnp.asarray, host_reads(reads, epc, origin_ns, length=length, antenna=antenna))


def radio_model(reads: PhaseReads, **settings: float) -> RadioModel:
    """A `RadioModel` whose pi-flip probability and affine channel offset are estimated from the reads.

    They are constants of reader and tag and are fitted to all given reads: those of a whole recording include later ones.
    For online tracing fit them to an earlier recording of the same reader, or give them as `settings`.
    """
    valid = np.asarray(reads.valid)
    host = {name: np.asarray(getattr(reads, name))[valid] for name in ("phase_rad", "time_s", "channel", "carrier_hz")}
    share = estimate_flip_probability(host["phase_rad"], host["time_s"], host["channel"])
    columns = (host[name] for name in ("phase_rad", "time_s", "channel", "carrier_hz"))
    slope = estimate_slope(*columns, at_first=True)  # from where the filter's distances count
    chosen: dict[str, Any] = {
        "flip_probability": float(np.clip(share, 0.01, 0.45)) if np.isfinite(share) else DEFAULT_FLIP_SHARE,
        "slope_rad_hz": slope.slope_rad_hz,
        "hop_rad": slope.residual_rad,
    }
    return RadioModel(**{**chosen, **settings})


def window_reads(reads: PhaseReads, frame_time_s: Float[Array, " time"], num_window: int, max_reads: int) -> PhaseReads:
    """For every frame the latest `max_reads` reads since the window's first frame (leading time axis)."""
    first = frame_time_s[jnp.maximum(jnp.arange(frame_time_s.shape[0]) - num_window + 1, 0)]
    return jax.vmap(lambda start, end: _reads_between(reads, start, end, max_reads))(first, frame_time_s)


def _reads_between(
    reads: PhaseReads, first_s: Float[Array, ""], last_s: Float[Array, ""], max_reads: int
) -> PhaseReads:
    """The latest `max_reads` reads of [first_s, last_s] in a buffer of that length."""
    stamps = jnp.where(reads.valid, reads.time_s, jnp.inf)
    end = jnp.searchsorted(stamps, last_s, side="right")
    index = end - max_reads + jnp.arange(max_reads, dtype=end.dtype)
    clipped = jnp.clip(index, 0, reads.time_s.shape[0] - 1)
    picked = jax.tree.map(lambda leaf: leaf[clipped], reads)
    inside = (index >= 0) & picked.valid & (picked.time_s >= first_s)
    return PhaseReads(picked.time_s, picked.phase_rad, picked.carrier_hz, picked.sigma_rad, picked.channel, inside)


def _window_times(frame_time_s: Float[Array, " time"], num_window: int) -> Float[Array, "time window"]:
    index = jnp.arange(frame_time_s.shape[0])[:, None] - jnp.arange(num_window - 1, -1, -1)[None, :]
    return frame_time_s[jnp.maximum(index, 0)]


def _causal_path(
    path: FilteredPath, reads: PhaseReads, knot_s: Float[Array, " knots"]
) -> tuple[Float[Array, " knots"], Float[Array, " knots"]]:
    """The filtered path at knots, interpolated between reads and extrapolated after the last, and the gap around each knot."""
    stamps = jnp.where(reads.valid, reads.time_s, jnp.inf)
    until = jnp.searchsorted(stamps, knot_s[-1], side="right")
    upper = jnp.minimum(jnp.searchsorted(stamps, knot_s), until)
    lower = jnp.maximum(upper - 1, 0)
    last = jnp.maximum(until - 1, 0)
    upper = jnp.minimum(upper, last)
    span = reads.time_s[upper] - reads.time_s[lower]
    weight = jnp.clip((knot_s - reads.time_s[lower]) / jnp.where(span > 0, span, 1.0), 0.0, 1.0)
    between = path.distance_m[lower] * (1 - weight) + path.distance_m[upper] * weight
    beyond = jnp.maximum(knot_s - reads.time_s[last], 0.0)
    value = between + jnp.where(until > 0, path.velocity_m_s[last] * beyond, 0.0)
    before = jnp.where(knot_s < reads.time_s[0], jnp.inf, 0.0)
    gap = jnp.where(until > 0, jnp.maximum(span, beyond) + before, jnp.inf)
    return value, gap


def robust_windows(
    reads: PhaseReads, frame_time_s: Float[Array, " time"], num_window: int, model: RadioModel, *, max_reads: int = 128
) -> RadioWindow:
    """Causal estimates over every frame's window: the grid filter resolves the ambiguity, least squares refines the path.

    Only reads up to a frame enter its window. `std_m` combines the variance of the path and that of a possible cycle slip
    across each gap between reads; it is infinite where the window has fewer than two reads or a gap over `MAX_GAP_S`.
    """
    path = filter_reads(reads, model)
    reference = reference_carrier(reads)
    window_s = _window_times(frame_time_s, num_window)
    # Knots before the window let reads before it constrain the path where reads are sparse.
    lead = _PAST_SPACING_S * jnp.arange(_PAST_KNOTS, 0, -1, dtype=frame_time_s.dtype)
    knots = jnp.concatenate([window_s[:, :1] - lead[None, :], window_s], axis=1)
    recent = jax.vmap(lambda first, last: _reads_between(reads, first, last, max_reads))(knots[:, 0], knots[:, -1])
    quarter_m = SPEED_OF_LIGHT_M_S / reference / 4.0
    stamps = jnp.where(reads.valid, reads.time_s, jnp.inf)
    gaps = jnp.diff(reads.time_s, prepend=reads.time_s[:1])
    spread = jnp.concatenate([path.velocity_std_m_s[:1], path.velocity_std_m_s[:-1]]) * gaps
    # A cycle slip needs a prediction error of half of the ambiguity; the ambiguity is half a wavelength.
    slip = jnp.where(reads.valid, jax.scipy.special.erfc(quarter_m / jnp.maximum(spread, 1e-6) / jnp.sqrt(2.0)), 0.0)
    risk = jnp.cumsum(slip)

    def one(knot_s: Float[Array, " knots"], window: PhaseReads) -> RadioWindow:
        start, gap = _causal_path(path, reads, knot_s)
        # Window frames before the first frame are copies of it; least squares needs distinct knots.
        ordered = knot_s + 1e-4 * jnp.arange(knot_s.shape[0], dtype=knot_s.dtype)
        refined = refine_path(window, ordered, start, reference, model)
        own, covariance = refined.relative_m[_PAST_KNOTS:], refined.covariance_m2[_PAST_KNOTS:, _PAST_KNOTS:]
        variance = jnp.diagonal(covariance) + covariance[0, 0] - 2.0 * covariance[0]
        frames = knot_s[_PAST_KNOTS:]
        at = jnp.clip(jnp.searchsorted(stamps, frames, side="right") - 1, 0, reads.time_s.shape[0] - 1)
        slipped = (risk[at] - risk[at[0]]) * jnp.square(2.0 * quarter_m)
        known = (jnp.sum(window.valid) >= 2) & jnp.all(gap[_PAST_KNOTS:] < MAX_GAP_S) & (frames[-1] > frames[0])
        std = jnp.sqrt(jnp.maximum(variance + slipped, 0.0) + 1e-12)
        return RadioWindow(
            jnp.where(known, own - own[0], 0.0),
            jnp.where(known, std, jnp.inf).at[0].set(jnp.where(known, 0.0, jnp.inf)),
        )

    return jax.vmap(one)(knots, recent)


def literal_windows(reads: PhaseReads, frame_time_s: Float[Array, " time"], num_window: int) -> RadioWindow:
    """Range estimation of TagAttention (III.B-C), term by term: threshold unwrapping, acceleration rule, polynomial resampling.

    The paper interpolates offline, so a frame also uses the reads right after it. `std_m` is 0 between the first and the
    last read and infinite outside: the paper estimates no uncertainty.
    """
    distance = unwrap_paper(reads)
    count = jnp.sum(reads.valid).astype(reads.time_s.dtype)
    value, inside = resample_polynomial(reads.time_s, distance, count, frame_time_s)
    return _windows_of(value, inside, num_window)


def published_windows(
    reads: PhaseReads, frame_time_s: Float[Array, " time"], num_window: int, *, causal: bool = False
) -> RadioWindow:
    """Range estimation of TagAttention (III.B-C) as of `published_distance`; `std_m` is 0 where known, infinite elsewhere.

    The fit at a frame uses reads up to 0.07 s after it, 0.2 s where reads are few, and none after it with `causal`.
    """
    value, known = published_distance(reads, frame_time_s, causal=causal)
    return _windows_of(value, known, num_window)


def _windows_of(value: Float[Array, " time"], known: Bool[Array, " time"], num_window: int) -> RadioWindow:
    """The windows of a path; a window of which one distance is unknown is unknown."""
    index = jnp.maximum(jnp.arange(value.shape[0])[:, None] - jnp.arange(num_window - 1, -1, -1)[None, :], 0)
    relative = value[index] - value[index[:, :1]]
    complete = jnp.all(known[index], axis=1, keepdims=True) & (jnp.arange(value.shape[0])[:, None] >= num_window - 1)
    return RadioWindow(jnp.where(complete, relative, 0.0), jnp.where(complete, jnp.zeros_like(relative), jnp.inf))


def radio_windows(
    reads: PhaseReads,
    frame_time_s: Float[Array, " time"],
    num_window: int,
    estimator: Literal["robust", "published", "published_causal", "literal"] = "robust",
    model: RadioModel | None = None,
) -> RadioWindow:
    """Ranges over the last `num_window` frames, (time, window), metres relative to each window's first frame.

    Their standard deviations are infinite where the range is unknown. `model` None takes `radio_model(reads)`. Raises
    `ValueError` for an unknown estimator.
    """
    if estimator in _OF_THE_PAPER:
        return _OF_THE_PAPER[estimator](reads, frame_time_s, num_window)
    if estimator != "robust":
        known = ", ".join(("robust", *_OF_THE_PAPER))
        raise ValueError(f"Unknown radio estimator {estimator!r}; expected one of {known}.")
    return _robust_jit(reads, frame_time_s, num_window, radio_model(reads) if model is None else model)


_OF_THE_PAPER = {
    "published": jax.jit(published_windows, static_argnums=2),
    "published_causal": jax.jit(functools.partial(published_windows, causal=True), static_argnums=2),
    "literal": jax.jit(literal_windows, static_argnums=2),
}
_robust_jit = jax.jit(robust_windows, static_argnums=2)
