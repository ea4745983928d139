"""Tagview's identification of all traces (V.E): fit, match, prune, compare strengths, solve."""

from __future__ import annotations

import dataclasses
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Shaped

from ._agreement import agreement, shared_times
from ._fit import LineFit, fit_pairs, translating_factor
from ._graph import (
    Coefficient,
    Spread,
    cliques,
    edge_agreement,
    keep_edges,
    likelihood_weight,
    match_graph,
    shared_coefficient,
    slope_log_odds,
)
from ._programme import Selection, select_edges
from ._reads import Heard, TagSequences

Origin = Literal["principal", "antenna"]
Weigh = Literal["r_squared", "likelihood"]

_PAD_TRACES = 8


@dataclasses.dataclass(frozen=True)
class MatchSettings:
    """The defaults are the paper's, where it says; what goes beyond it is marked ours."""

    threshold: float = 3.0  # eta, of the z-score; the paper does not give it
    mu: float = 0.5  # weight of the agreement; 0 leaves strengths out
    weigh: Weigh = "r_squared"  # ours: likelihood weighs fits and agreement by how much was seen, in nats
    independent_s: float = 0.5  # ours, of likelihood: errors this far apart count as independent
    slope_spread: float | None = (
        None  # ours, of likelihood: of right pairs' log slopes, in place of the z-score's pruning
    )
    named_nats: float = (
        0.0  # ours, with slope_spread: log odds that a trace is a tagged thing's; above 8 all are taken for
    )
    programme: bool = True  # False ends with the Hungarian matching of V.A
    spread: Spread = "std"  # ours: mad
    least_spread: float = 0.5  # ours: of the shared coefficient, as a share of it; short traces scatter so much
    positive: bool = True  # ours: phases grow with distance, so a falling line is no fit (R^2 0)
    least_r_squared: float = 0.0  # ours: an edge below is pruned, so that a thing without a tag stays unnamed
    least_samples: int = 8  # ours: a pair that shares fewer has weight 0
    overlap_s: float = 0.2  # ours: two traces of one tag may overlap by so much
    origin: Origin = "principal"  # ours: antenna measures S from where a known antenna looks down on
    time_limit_s: float = 10.0  # for the programme

    def __post_init__(self):
        if self.spread not in ("std", "mad"):
            raise ValueError(f"spread is {self.spread!r}; expected std or mad.")
        if self.origin not in ("principal", "antenna"):
            raise ValueError(f"origin is {self.origin!r}; expected principal or antenna.")
        if self.weigh not in ("r_squared", "likelihood"):
            raise ValueError(f"weigh is {self.weigh!r}; expected r_squared or likelihood.")
        if not self.independent_s > 0:
            raise ValueError(f"independent_s is {self.independent_s}; expected a positive time.")
        if not (self.threshold > 0 and self.mu >= 0 and self.least_spread >= 0 and self.time_limit_s > 0):
            raise ValueError(
                f"threshold {self.threshold}, mu {self.mu}, least_spread {self.least_spread}, time_limit_s "
                f"{self.time_limit_s}; expected positive ones (mu and least_spread: not negative)."
            )
        if self.slope_spread is not None and not (self.slope_spread > 0 and self.weigh == "likelihood"):
            raise ValueError(
                f"slope_spread is {self.slope_spread} with weigh {self.weigh}; expected a positive spread, of likelihood."
            )
        if self.named_nats and self.slope_spread is None:
            raise ValueError(f"named_nats is {self.named_nats} without slope_spread, of which it is a part.")
        if self.weigh == "likelihood" and not self.programme:
            raise ValueError(
                "weigh is likelihood without the programme; the Hungarian matching of V.A goes by r_squared."
            )
        if self.least_samples < 3:
            raise ValueError(f"least_samples is {self.least_samples}; two points always lie on a line: at least 3.")


@dataclasses.dataclass(frozen=True)
class Traces:
    """What the camera followed: undistorted directions (x / z, y / z) of the boxes' middles at the frames."""

    number: tuple[int, ...]
    time_s: Float[np.ndarray, " frames"]
    direction: Float[np.ndarray, "traces frames 2"]
    seen: Bool[np.ndarray, "traces frames"]

    def spans_s(self) -> Float[np.ndarray, "traces 2"]:
        """First and last time each trace was seen."""
        rows = [np.flatnonzero(one) for one in self.seen]
        return np.array([(self.time_s[row[0]], self.time_s[row[-1]]) for row in rows]).reshape(-1, 2)

    def step_s(self) -> float:
        """Time from frame to frame, the median; 1 where there is none."""
        steps = np.diff(self.time_s)
        return float(np.median(steps[steps > 0])) if np.any(steps > 0) else 1.0


@dataclasses.dataclass(frozen=True)
class Identification:
    """Which tag each trace carries (index into the tags, -1 = none), and how that came about."""

    tag_of: Int[np.ndarray, " traces"]
    matched: Int[np.ndarray, " traces"]  # by the Hungarian matching alone
    slope: Float[np.ndarray, "traces tags"]
    r_squared: Float[np.ndarray, "traces tags"]
    weight: Float[np.ndarray, "traces tags"]
    kept: Bool[np.ndarray, "traces tags"]
    shared: Coefficient | None
    selection: Selection | None
    height_m: float  # of the antenna over the plane, wavelength * a / 4 pi; NaN where nothing matched


def identify(
    traces: Traces,
    heard: Heard,
    focal_px: float,
    antenna_m: Shaped[np.ndarray, " 3"],
    settings: MatchSettings,
) -> Identification:
    """Name the traces. No trace, no tag, or nothing that fits: all stay unnamed.

    `heard` is at the frames of `traces`. More tags than traces: some tags go unused. More traces than tags: a tag may
    have several that do not overlap; what overlaps stays unnamed. Equal traces share their weights; which of them gets
    a tag is then the solver's choice. `antenna_m` (camera frame) is used by `origin` antenna only: with the height
    that the paper's fit gives, S is measured anew from the antenna's foot.
    """
    num_traces, num_tags = len(traces.number), heard.sequences.phase_rad.shape[0]
    empty = np.zeros((num_traces, num_tags))
    unnamed = np.full(num_traces, -1)
    if not num_traces or not num_tags:
        return Identification(unnamed, unnamed, empty, empty, empty, empty.astype(bool), None, None, float("nan"))
    foot = np.zeros(2)
    fit, _ = _fits(traces, heard.sequences, focal_px, foot, with_agreement=False)
    apart = max(settings.independent_s / traces.step_s(), 1.0)  # frames
    matched, weight, worth, shared = _matched(fit, settings, apart)
    if settings.origin == "antenna" and shared is not None and shared.mean > 0:
        foot = np.asarray(antenna_m[:2], np.float64) / _height_m(shared, heard.wavelength_m)
        fit, _ = _fits(traces, heard.sequences, focal_px, foot, with_agreement=False)
        matched, weight, worth, shared = _matched(fit, settings, apart)
    slope, r_squared = np.asarray(fit.slope, np.float64), np.asarray(fit.r_squared, np.float64)
    kept = keep_edges(slope, shared, settings.threshold) & (weight > 0) & (r_squared >= settings.least_r_squared)
    selection, tag_of = None, matched
    if settings.programme:
        if settings.slope_spread is not None and shared is not None:
            worth = worth + slope_log_odds(slope, shared, settings.slope_spread) + settings.named_nats
            enough = np.asarray(fit.count) >= settings.least_samples
            kept = enough & (worth > 0) & (weight >= settings.least_r_squared)
        trace, tag = np.nonzero(kept)
        quadratic = np.zeros((len(trace), len(trace)))
        if settings.mu > 0 and len(trace):
            _, compared = _fits(traces, heard.sequences, focal_px, foot, with_agreement=True)
            assert compared is not None
            agreed, times = (np.asarray(each, np.float64) for each in compared)
            together = times / apart if settings.weigh == "likelihood" else None
            quadratic = settings.mu * edge_agreement(agreed, trace, tag, together)
        rows = cliques(trace, tag, traces.spans_s(), tolerance_s=settings.overlap_s)
        selection = select_edges(worth[trace, tag], quadratic, rows, time_limit_s=settings.time_limit_s)
        tag_of = unnamed.copy()
        tag_of[trace[selection.chosen]] = tag[selection.chosen]
    height_m = float("nan") if shared is None else _height_m(shared, heard.wavelength_m)
    return Identification(tag_of, matched, slope, r_squared, weight, kept, shared, selection, height_m)


def _height_m(shared: Coefficient, wavelength_m: float) -> float:
    """h of a = 4 pi h / wavelength."""
    return shared.mean * wavelength_m / (4 * np.pi)


def _matched(
    fit: LineFit, settings: MatchSettings, apart: float
) -> tuple[
    Int[np.ndarray, " traces"], Float[np.ndarray, "traces tags"], Float[np.ndarray, "traces tags"], Coefficient | None
]:
    """The Hungarian matching, R squared, what each pair is worth, and the coefficient that the matched ones share.

    Worth is R squared as in the paper, or by `weigh` likelihood how much was seen, in nats, errors `apart` frames being
    independent: a line through four samples is no coefficient.
    """
    slope = np.asarray(fit.slope, np.float64)
    weight = np.asarray(fit.r_squared, np.float64)
    weight = np.where(np.asarray(fit.count) >= settings.least_samples, weight, 0.0)
    if settings.positive:
        weight = np.where(slope > 0, weight, 0.0)
    by_likelihood = settings.weigh == "likelihood"
    worth = likelihood_weight(weight, np.asarray(fit.count, np.float64) / apart) if by_likelihood else weight
    matched = match_graph(worth)
    shared = shared_coefficient(
        slope,
        matched,
        spread=settings.spread,
        least_share=settings.least_spread,
        weight=worth if by_likelihood else None,
    )
    return matched, weight, worth, shared


def _fits(
    traces: Traces, said: TagSequences, focal_px: float, foot: Shaped[np.ndarray, " 2"], *, with_agreement: bool
) -> tuple[LineFit, tuple[Array, Array] | None]:
    """Fits of all pairs, and if asked for their agreements and of how many times those are.

    Traces are padded, so that few shapes are compiled.
    """
    num = len(traces.number)
    pad = max(_PAD_TRACES, -(-num // _PAD_TRACES) * _PAD_TRACES) - num
    direction = np.pad(np.where(traces.seen[..., None], traces.direction, 0.0), ((0, pad), (0, 0), (0, 0)))
    seen = np.pad(traces.seen, ((0, pad), (0, 0)))
    fit, compared = _score(
        jnp.asarray(direction, jnp.float32),
        jnp.asarray(seen),
        said,
        jnp.asarray(focal_px, jnp.float32),
        jnp.asarray(foot, jnp.float32),
        with_agreement=with_agreement,
    )
    return jax.tree.map(lambda x: x[:num], fit), jax.tree.map(lambda x: x[:num, :num], compared)


@eqx.filter_jit
def _score(
    direction: Float[Array, "traces time 2"],
    seen: Bool[Array, "traces time"],
    said: TagSequences,
    focal_px: Float[Array, ""],
    foot: Float[Array, " 2"],
    *,
    with_agreement: bool,
) -> tuple[LineFit, tuple[Array, Array] | None]:
    distance_px = focal_px * jnp.sqrt(jnp.sum((direction - foot[None, None, :]) ** 2, axis=-1))
    gamma = translating_factor(distance_px, focal_px)
    fit = fit_pairs(gamma, seen, said.phase_rad, said.heard, said.piece)
    if not with_agreement:
        return fit, None
    return fit, (agreement(said.rssi_dbm, said.strong, distance_px, seen), shared_times(said.strong, seen))
