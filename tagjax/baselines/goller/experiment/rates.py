"""The outcome of every tag, and detection and false alarm rates with 95 % intervals (Goller et al., IV)."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float
from scipy.stats import binomtest

from ..alarm import Roc, best_threshold, operating_point, roc_curve
from ..calibration import Calibration
from ..offline import Observations, estimate, peak
from ..settings import GollerSettings
from ..truth import Kind, TrueTags
from .paper import PAPER_TABLE_1, PAPER_TABLE_2, SIMPLE

Rule = Literal["fused", "rfid"]


@dataclasses.dataclass(frozen=True)
class Example:
    """One recording of a scenario: its variant, the observations and the truth."""

    variant: str
    observed: Observations
    truth: TrueTags


@dataclasses.dataclass(frozen=True)
class TagOutcome:
    """One tag of one recording: what it did, and the peak score of each rule."""

    recording: str
    variant: str
    epc: str
    kind: Kind
    fused: float  # peak of `exit_score`
    rfid: float  # peak of `rssi_score`, dBm
    read: bool  # at least once


def outcomes(calibration: Calibration, examples: Sequence[Example], settings: GollerSettings) -> list[TagOutcome]:
    """Every tag of some recordings, including those that were never read."""
    found = []
    for example in examples:
        observed = example.observed
        estimates = estimate(calibration, observed, settings) if observed.epcs else None
        fused = {} if estimates is None else dict(zip(observed.epcs, peak(estimates.exit_score), strict=True))
        rfid = {} if estimates is None else dict(zip(observed.epcs, peak(estimates.rssi_score), strict=True))
        found += tag_outcomes(example, settings, fused, rfid)
    return found


def tag_outcomes(
    example: Example, settings: GollerSettings, fused: dict[str, Any], rfid: dict[str, Any]
) -> list[TagOutcome]:
    """Outcomes from the scores of the read tags; a tag without a score has 0 (fused) and -inf (RFID only)."""
    return [
        TagOutcome(
            recording=example.observed.name,
            variant=example.variant,
            epc=epc,
            kind=example.truth.kind(tag, settings.exit_x_m),
            fused=float(fused.get(epc, 0.0)),
            rfid=float(rfid.get(epc, -np.inf)),
            read=epc in example.observed.epcs,
        )
        for tag, epc in enumerate(example.truth.epcs)
    ]


@dataclasses.dataclass(frozen=True)
class Rates:
    """Detection and false alarm rates; NaN where there was no tag of that kind."""

    num_runs: int  # recordings in which a tag leaves
    num_leaves: int
    num_still: int
    num_stays: int
    detected_run: float  # P_D,run: at least one leaving tag alarmed
    detected: float  # P_D
    false_alarm: float  # P_FA, of still tags
    false_alarm_stays: float  # of tags that are carried around and stay; not in the paper

    def to_json(self) -> dict[str, Any]:
        """Plain values, None in place of NaN."""
        values: dict[str, Any] = dataclasses.asdict(self)
        return {key: None if isinstance(value, float) and np.isnan(value) else value for key, value in values.items()}


def rates(found: Sequence[TagOutcome], rule: Rule, threshold: float) -> Rates:
    """Rates at a threshold: a tag is alarmed where its score is at or above it."""
    alarmed = np.array([getattr(one, rule) >= threshold for one in found], bool)
    kind = np.array([one.kind for one in found], dtype=object)
    run = np.array([one.recording for one in found], dtype=object)
    leaves, still, stays = (kind == name for name in ("leaves", "still", "stays"))
    runs = sorted(set(run[leaves]))
    detected_run = [bool(np.any(alarmed[leaves & (run == name)])) for name in runs]
    return Rates(
        num_runs=len(runs),
        num_leaves=int(leaves.sum()),
        num_still=int(still.sum()),
        num_stays=int(stays.sum()),
        detected_run=_mean(detected_run),
        detected=_mean(alarmed[leaves]),
        false_alarm=_mean(alarmed[still]),
        false_alarm_stays=_mean(alarmed[stays]),
    )


def _mean(values: Sequence[bool] | Bool[np.ndarray, " some"]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def rate_with_interval(rate: float, count: int) -> str | None:
    """A rate of `count` tags with Wilson's 95 % interval; None of no tag."""
    if count == 0:
        return None
    interval = binomtest(round(rate * count), count).proportion_ci(0.95, method="wilson")
    return f"{rate:.3f} ({interval.low:.2f} to {interval.high:.2f}) of {count}"


def simple_scenario(found: Sequence[TagOutcome]) -> list[TagOutcome]:
    """The outcomes of the scenario of Table I; none where it has no leaving or no still tag."""
    simple = [one for one in found if one.variant == SIMPLE]
    return simple if {"leaves", "still"} <= {one.kind for one in simple} else []


def rule_roc(found: Sequence[TagOutcome], rule: Rule, *, stays: bool) -> Roc:
    """The ROC of a rule: leaving tags against still ones, and against carried tags that stay if `stays`."""
    kept = [one for one in found if stays or one.kind != "stays"]
    return roc_curve(np.array([getattr(one, rule) for one in kept]), np.array([one.kind == "leaves" for one in kept]))


def thresholds(found: Sequence[TagOutcome]) -> tuple[float, float]:
    """The best fused and RFID-only threshold on training and validation recordings.

    The fused rule's is for all variants. The RFID-only rule's is, as in Table I, for leaving against still tags of the
    simple scenario, or of all variants where that was not recorded.
    """
    rfid = rule_roc(simple_scenario(found) or found, "rfid", stays=False)
    return best_threshold(rule_roc(found, "fused", stays=True)), best_threshold(rfid)


def simple_rates(found: Sequence[TagOutcome], fused: float, rfid: float) -> dict[str, Rates]:
    """Table I: both rules on the simple scenario."""
    simple = [one for one in found if one.variant == SIMPLE]
    return {"rfid": rates(simple, "rfid", rfid), "fused": rates(simple, "fused", fused)}


def rates_at_paper_false_alarms(found: Sequence[TagOutcome]) -> dict[str, tuple[float, float]]:
    """P_D and P_FA of both rules on the simple scenario at no more false alarms than the paper's; empty without it."""
    simple = simple_scenario(found)
    return {
        rule: operating_point(rule_roc(simple, rule, stays=False), PAPER_TABLE_1[rule][1])
        for rule in (("rfid", "fused") if simple else ())
    }


def scenario_rates(found: Sequence[TagOutcome], fused: float) -> dict[str, Rates]:
    """Table II: the fused rule on each of the paper's scenarios that was recorded."""
    recorded = {one.variant for one in found}
    return {
        name: rates([one for one in found if one.variant == name], "fused", fused)
        for name in PAPER_TABLE_2
        if name in recorded
    }


def location_error_m(
    calibration: Calibration, examples: Sequence[Example], settings: GollerSettings
) -> Float[np.ndarray, " errors"]:
    """Error of every located tag along the line of antennas, at every frame since it was first received."""
    errors = []
    for example in examples:
        if not example.observed.epcs:
            continue
        location = estimate(calibration, example.observed, settings).location
        for row, epc in enumerate(example.observed.epcs):
            path = example.truth.position_m[example.truth.epcs.index(epc), :, 0]
            known = np.asarray(location.known[row])
            errors.append(np.abs(np.asarray(location.position_m[row, :, 0]) - path)[known])
    return np.concatenate(errors) if errors else np.zeros(0)
