"""Tagview's identification of all traces (V.E): fit, match, prune, compare RSSI, solve."""

from __future__ import annotations

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from ..reads import padded_size
from .graph import (
    Coefficient,
    SpreadEstimator,
    cliques,
    edge_agreement,
    keep_edges,
    likelihood_weight,
    match_graph,
    shared_coefficient,
    slope_log_odds,
)
from .line_fit import LineFit, fit_pairs, translating_factor
from .quadratic_programme import Selection, select_edges
from .rssi_agreement import agreement, shared_times
from .sequences import TagMeasurements, TagSequences

Origin = Literal["principal", "antenna"]
EdgeWeight = Literal["r_squared", "likelihood"]

_PAD_TRACES = 8


@dataclasses.dataclass(frozen=True)
class MatchSettings:
    """The defaults are the paper's where it gives them; additions to the paper are marked ours."""

    max_z_score: float = 3.0  # eta, of a slope; the paper does not give it
    mu: float = 0.5  # weight of the RSSI agreement in Eq. 10; 0 ignores RSSI
    edge_weight: EdgeWeight = "r_squared"  # ours: likelihood weights by the log likelihood ratio of the fit, nats
    correlation_time_s: float = 0.5  # ours, for likelihood: errors this far apart are independent
    log_slope_std: float | None = None  # ours, for likelihood: of matching pairs; replaces the pruning by z-score
    prior_log_odds: float = 0.0  # ours, with log_slope_std: that a trace belongs to a tagged object, nats
    programme: bool = True  # False stops after the Hungarian matching of V.A
    spread_estimator: SpreadEstimator = "std"  # ours: mad
    min_relative_spread: float = 0.5  # ours: of the shared coefficient; slopes of short traces scatter by so much
    positive_slope: bool = True  # ours: phases grow with distance, so a falling line has R^2 0
    min_r_squared: float = 0.0  # ours: an edge below is pruned, so that an object without a tag stays unidentified
    min_samples: int = 8  # ours: a pair with fewer common samples has weight 0
    max_overlap_s: float = 0.2  # ours: of two traces of one tag
    origin: Origin = "principal"  # ours: antenna measures S from the point below an antenna of known position
    time_limit_s: float = 10.0  # of the programme

    def __post_init__(self):
        for name, allowed in (
            ("spread_estimator", ("std", "mad")),
            ("origin", ("principal", "antenna")),
            ("edge_weight", ("r_squared", "likelihood")),
        ):
            if getattr(self, name) not in allowed:
                raise ValueError(f"{name} is {getattr(self, name)!r}; expected {' or '.join(allowed)}.")
        for name in ("max_z_score", "correlation_time_s", "time_limit_s"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected a positive number.")
        for name in ("mu", "min_relative_spread"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} is {getattr(self, name)}; expected 0 or more.")
        likelihood = self.edge_weight == "likelihood"
        if self.log_slope_std is not None and not (self.log_slope_std > 0 and likelihood):
            raise ValueError(
                f"log_slope_std is {self.log_slope_std} with edge_weight {self.edge_weight}; expected a positive number with "
                "edge_weight likelihood."
            )
        if self.prior_log_odds and self.log_slope_std is None:
            raise ValueError(
                f"prior_log_odds is {self.prior_log_odds} without log_slope_std; expected both or neither."
            )
        if likelihood and not self.programme:
            raise ValueError(
                "edge_weight is likelihood without the programme; the Hungarian matching of V.A uses r_squared."
            )
        if self.min_samples < 3:
            raise ValueError(
                f"min_samples is {self.min_samples}; expected at least 3, as two points always lie on a line."
            )


@dataclasses.dataclass(frozen=True)
class Traces:
    """The tracked objects: undistorted directions (x / z, y / z) of the boxes' centres at the frames."""

    number: tuple[int, ...]
    time_s: Float[np.ndarray, " frames"]
    direction: Float[np.ndarray, "traces frames 2"]
    seen: Bool[np.ndarray, "traces frames"]

    def spans_s(self) -> Float[np.ndarray, "traces 2"]:
        """First and last time each trace was seen."""
        rows = [np.flatnonzero(one) for one in self.seen]
        return np.array([(self.time_s[row[0]], self.time_s[row[-1]]) for row in rows]).reshape(-1, 2)

    def frame_interval_s(self) -> float:
        """Median time between frames; 1 where there is none."""
        steps = np.diff(self.time_s)
        return float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0


@dataclasses.dataclass(frozen=True)
class Identification:
    """The tag of each trace (index into the tags, -1 = none), and the quantities that led to it."""

    tag_of: Int[np.ndarray, " traces"]
    matched: Int[np.ndarray, " traces"]  # by the Hungarian matching alone
    slope: Float[np.ndarray, "traces tags"]
    r_squared: Float[np.ndarray, "traces tags"]
    fit: Float[np.ndarray, "traces tags"]  # R squared of the accepted pairs, 0 of the others
    kept: Bool[np.ndarray, "traces tags"]
    shared: Coefficient | None
    selection: Selection | None
    height_m: float  # of the antenna over the plane, wavelength * a / 4 pi; NaN without a match


@dataclasses.dataclass(frozen=True)
class _Matching:
    """The Hungarian matching of V.A with its edge weights, and the coefficient of the matched pairs."""

    tag_of: Int[np.ndarray, " traces"]
    fit: Float[np.ndarray, "traces tags"]
    weight: Float[np.ndarray, "traces tags"]
    shared: Coefficient | None


def identify(
    traces: Traces,
    measured: TagMeasurements,
    focal_px: float,
    antenna_m: Shaped[np.ndarray, " 3"],
    settings: MatchSettings,
) -> Identification:
    """Identify the traces. Without traces, tags or a fitting pair all stay unidentified.

    `measured` is at the frames of `traces`. With more tags than traces some tags are not used. With more traces than
    tags a tag may have several traces that do not overlap; overlapping ones stay unidentified. Equal traces have equal
    weights; the solver chooses which of them gets a tag. `antenna_m` (camera frame) is used with `origin` antenna only:
    with the height of the paper's fit, S is measured again from the point below the antenna.
    """
    num_traces, num_tags = len(traces.number), measured.sequences.phase_rad.shape[0]
    empty, unidentified = np.zeros((num_traces, num_tags)), np.full(num_traces, -1)
    if not num_traces or not num_tags:
        nan = float("nan")
        return Identification(unidentified, unidentified, empty, empty, empty, empty.astype(bool), None, None, nan)
    below = np.zeros(2)
    independent_frames = max(settings.correlation_time_s / traces.frame_interval_s(), 1.0)
    line, _ = _fit(traces, measured.sequences, focal_px, below, with_agreement=False)
    matching = _match(line, settings, independent_frames)
    shared = matching.shared
    if settings.origin == "antenna" and shared is not None and shared.mean > 0:
        below = np.asarray(antenna_m[:2], np.float64) / _height_m(shared, measured.wavelength_m)
        line, _ = _fit(traces, measured.sequences, focal_px, below, with_agreement=False)
        matching = _match(line, settings, independent_frames)
        shared = matching.shared
    kept, weight = _candidate_edges(line, matching, settings)
    selection, tag_of = None, matching.tag_of
    if settings.programme:
        trace, tag = np.nonzero(kept)
        quadratic = np.zeros((len(trace), len(trace)))
        if settings.mu > 0 and len(trace):
            _, compared = _fit(traces, measured.sequences, focal_px, below, with_agreement=True)
            assert compared is not None
            agreed, times = (np.asarray(each, np.float64) for each in compared)
            num_shared = times / independent_frames if settings.edge_weight == "likelihood" else None
            quadratic = settings.mu * edge_agreement(agreed, trace, tag, num_shared)
        rows = cliques(trace, tag, traces.spans_s(), tolerance_s=settings.max_overlap_s)
        selection = select_edges(weight[trace, tag], quadratic, rows, time_limit_s=settings.time_limit_s)
        tag_of = unidentified.copy()
        tag_of[trace[selection.chosen]] = tag[selection.chosen]
    slope, r_squared = np.asarray(line.slope, np.float64), np.asarray(line.r_squared, np.float64)
    height_m = float("nan") if shared is None else _height_m(shared, measured.wavelength_m)
    return Identification(tag_of, matching.tag_of, slope, r_squared, matching.fit, kept, shared, selection, height_m)


def _height_m(shared: Coefficient, wavelength_m: float) -> float:
    """h of a = 4 pi h / wavelength."""
    return shared.mean * wavelength_m / (4 * np.pi)


def _match(line: LineFit, settings: MatchSettings, independent_frames: float) -> _Matching:
    """The Hungarian matching by R squared, as in the paper, or by the likelihood ratio of the line."""
    slope, count = np.asarray(line.slope, np.float64), np.asarray(line.count, np.float64)
    fit = np.where(count >= settings.min_samples, np.asarray(line.r_squared, np.float64), 0.0)
    if settings.positive_slope:
        fit = np.where(slope > 0, fit, 0.0)
    likelihood = settings.edge_weight == "likelihood"
    weight = likelihood_weight(fit, count / independent_frames) if likelihood else fit
    tag_of = match_graph(weight)
    shared = shared_coefficient(
        slope,
        tag_of,
        estimator=settings.spread_estimator,
        min_relative_spread=settings.min_relative_spread,
        weight=weight if likelihood else None,
    )
    return _Matching(tag_of, fit, weight, shared)


def _candidate_edges(
    line: LineFit, matching: _Matching, settings: MatchSettings
) -> tuple[Bool[np.ndarray, "traces tags"], Float[np.ndarray, "traces tags"]]:
    """The edges of the programme, and their weights: pruned by z-score (V.B), or with the likelihood of the slope."""
    slope, shared = np.asarray(line.slope, np.float64), matching.shared
    if settings.programme and settings.log_slope_std is not None and shared is not None:
        weight = matching.weight + slope_log_odds(slope, shared, settings.log_slope_std) + settings.prior_log_odds
        enough = np.asarray(line.count) >= settings.min_samples
        return enough & (weight > 0) & (matching.fit >= settings.min_r_squared), weight
    strong = (matching.fit > 0) & (np.asarray(line.r_squared, np.float64) >= settings.min_r_squared)
    return keep_edges(slope, shared, settings.max_z_score) & strong, matching.weight


def _fit(
    traces: Traces,
    sequences: TagSequences,
    focal_px: float,
    below: Shaped[np.ndarray, " 2"],
    *,
    with_agreement: bool,
) -> tuple[LineFit, tuple[Array, Array] | None]:
    """Line fits of all pairs, and if asked for their RSSI agreements and numbers of common times.

    Traces are padded, so that few shapes are compiled.
    """
    num = len(traces.number)
    pad = padded_size(num, _PAD_TRACES) - num
    direction = np.pad(np.where(traces.seen[..., None], traces.direction, 0.0), ((0, pad), (0, 0), (0, 0)))
    seen = np.pad(traces.seen, ((0, pad), (0, 0)))
    line, compared = _compiled_fit(
        jnp.asarray(direction, jnp.float32),
        jnp.asarray(seen),
        sequences,
        jnp.asarray(focal_px, jnp.float32),
        jnp.asarray(below, jnp.float32),
        with_agreement=with_agreement,
    )
    return jax.tree.map(lambda x: x[:num], line), jax.tree.map(lambda x: x[:num, :num], compared)


@eqx.filter_jit
def _compiled_fit(
    direction: Float[Array, "traces time 2"],
    seen: Bool[Array, "traces time"],
    sequences: TagSequences,
    focal_px: Float[Array, ""],
    below: Float[Array, " 2"],
    *,
    with_agreement: bool,
) -> tuple[LineFit, tuple[Array, Array] | None]:
    """Fits and agreements of padded traces; `below` is the direction of the point below the antenna."""
    distance_px = focal_px * jnp.sqrt(jnp.sum((direction - below[None, None, :]) ** 2, axis=-1))
    gamma = translating_factor(distance_px, focal_px)
    line = fit_pairs(gamma, seen, sequences.phase_rad, sequences.phase_known, sequences.piece)
    if not with_agreement:
        return line, None
    rssi_dbm, known = sequences.rssi_dbm, sequences.rssi_known
    return line, (agreement(rssi_dbm, known, distance_px, seen), shared_times(known, seen))
