"""Goller et al.'s tables: what became of every tag, detection and false alarm rates, the paper's figures beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from ...baselines.goller import (
    Calibration,
    Carried,
    GollerSettings,
    Observations,
    Roc,
    best_threshold,
    decide,
    operating_point,
    peak,
    roc_curve,
)

Kind = Literal["leaves", "stays", "still"]

SIMPLE = "sp_st_still"
"""The variant of Table I: one moving tag, two still ones."""

PAPER_TABLE_1 = {"rfid": (0.86, 0.40), "fused": (0.96, 0.0)}
"""P_D and P_FA of RFID only and of RFID + CV."""

PAPER_TABLE_2: dict[str, tuple[str, float, float, float | None]] = {
    "sp_st": ("SP-ST", 0.9733, 0.9733, None),
    "sp_mt_2": ("SP-MT, 2 moving", 1.0, 0.9750, None),
    "sp_mt_4": ("SP-MT, 4 moving", 1.0, 0.9125, None),
    "sp_mt_still": ("SP-MT, 2 moving, 4 still", 1.0, 0.9312, 0.0188),
    "mp_mt_still": ("MP-MT, 2 moving, 4 still", 1.0, 0.8438, 0.0219),
}
"""Label, P_D,run, P_D and P_FA by variant."""


@dataclasses.dataclass(frozen=True)
class TagOutcome:
    """One tag of one recording: what it did, and how strongly each rule spoke for an alarm."""

    recording: str
    variant: str
    epc: str
    kind: Kind
    fused: float  # peak of `exit_score`
    rfid: float  # peak of `rssi_score`, dBm
    read: bool  # at all


def outcomes(
    calibration: Calibration, variant: str, seen: Observations, truth: Carried, settings: GollerSettings
) -> list[TagOutcome]:
    """Every tag of a recording, the unread ones too. A tag leaves if it is ever in the exit region."""
    decision = decide(calibration, seen, settings) if seen.epcs else None
    fused = {} if decision is None else dict(zip(seen.epcs, peak(decision.exit_score), strict=True))
    rfid = {} if decision is None else dict(zip(seen.epcs, peak(decision.rssi_score), strict=True))
    found = []
    for row, epc in enumerate(truth.epcs):
        kind: Kind = "still" if truth.still[row] else "leaves" if truth.leaves(row, settings.exit_x_m) else "stays"
        score = float(fused.get(epc, 0.0)), float(rfid.get(epc, -np.inf))
        found.append(TagOutcome(seen.name, variant, epc, kind, *score, epc in seen.epcs))
    return found


@dataclasses.dataclass(frozen=True)
class Rates:
    """Detection and false alarm rates; NaN where there was nothing to detect, or to take for it."""

    num_runs: int  # in which a tag leaves
    num_leaves: int
    num_still: int
    num_stays: int
    detected_run: float  # P_D,run: at least one leaving tag alarmed
    detected: float  # P_D
    false_alarm: float  # P_FA, of still tags
    false_alarm_stays: float  # of tags that are carried about and stay; the paper has none


def rates(found: Sequence[TagOutcome], rule: Literal["fused", "rfid"], threshold: float) -> Rates:
    """Rates at a threshold: alarmed is who scores at or above it."""
    alarmed = np.array([getattr(one, rule) >= threshold for one in found], bool)
    kind = np.array([one.kind for one in found], dtype=object)
    run = np.array([one.recording for one in found], dtype=object)
    leaves, still, stays = (kind == name for name in ("leaves", "still", "stays"))
    runs = sorted(set(run[leaves]))
    hit = [bool(np.any(alarmed[leaves & (run == name)])) for name in runs]
    return Rates(
        num_runs=len(runs),
        num_leaves=int(leaves.sum()),
        num_still=int(still.sum()),
        num_stays=int(stays.sum()),
        detected_run=_mean(hit),
        detected=_mean(alarmed[leaves]),
        false_alarm=_mean(alarmed[still]),
        false_alarm_stays=_mean(alarmed[stays]),
    )


def _mean(values: Sequence[bool] | Bool[np.ndarray, " some"]) -> float:
    return float(np.mean(values)) if len(values) else float("nan")


def interval(share: float, count: int, z: float = 1.96) -> tuple[float, float]:
    """Wilson's interval of a share of `count` (95 %); NaN of nothing."""
    if count == 0:
        return float("nan"), float("nan")
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * np.sqrt(share * (1 - share) / count + z**2 / (4 * count**2))
    return float(max(middle - half, 0.0)), float(min(middle + half, 1.0))


def rule_roc(found: Sequence[TagOutcome], rule: Literal["fused", "rfid"], *, stays: bool) -> Roc:
    """The curve of a rule: leaving tags against still ones, and against those that are carried about if `stays`."""
    kept = [one for one in found if stays or one.kind != "stays"]
    return roc_curve(np.array([getattr(one, rule) for one in kept]), np.array([one.kind == "leaves" for one in kept]))


def thresholds(found: Sequence[TagOutcome]) -> tuple[float, float]:
    """The fused and the RFID-only threshold that tagged recordings (not the test's) ask for.

    The fused rule answers for all variants; the RFID-only one, as in Table I, for moving against still tags of `SIMPLE`,
    or of all variants where there is none of it.
    """
    simple = [one for one in found if one.variant == SIMPLE]
    kinds = {one.kind for one in simple}
    chosen = simple if {"leaves", "still"} <= kinds else found
    return best_threshold(rule_roc(found, "fused", stays=True)), best_threshold(rule_roc(chosen, "rfid", stays=False))


def table_1(found: Sequence[TagOutcome], fused: float, rfid: float) -> dict[str, Rates]:
    """Both rules on the simple scenario."""
    simple = [one for one in found if one.variant == SIMPLE]
    return {"rfid": rates(simple, "rfid", rfid), "fused": rates(simple, "fused", fused)}


def at_papers_false_alarms(found: Sequence[TagOutcome]) -> dict[str, tuple[float, float]]:
    """P_D and P_FA of both rules on the simple scenario where they alarm as many still tags as the paper's, at most.

    Empty where that scenario has no leaving or no still tag.
    """
    simple = [one for one in found if one.variant == SIMPLE]
    if not {"leaves", "still"} <= {one.kind for one in simple}:
        return {}
    return {
        rule: operating_point(rule_roc(simple, rule, stays=False), PAPER_TABLE_1[rule][1]) for rule in ("rfid", "fused")
    }


def table_2(found: Sequence[TagOutcome], fused: float) -> dict[str, Rates]:
    """The fused rule on each of the paper's scenarios that was recorded."""
    here = {one.variant for one in found}
    return {
        name: rates([one for one in found if one.variant == name], "fused", fused)
        for name in PAPER_TABLE_2
        if name in here
    }


def markdown(
    first: dict[str, Rates], second: dict[str, Rates], at_papers: Mapping[str, tuple[float, float]] | None = None
) -> str:
    """Both tables, the paper's figures in columns of their own; with `at_papers_false_alarms` in lines of their own."""
    names = {"rfid": "RFID only", "fused": "RFID + CV"}
    lines = [
        "| approach | runs | P_D (95 %) | P_D, paper | P_FA (95 %) | P_FA, paper |",
        "|---|---|---|---|---|---|",
    ]
    for rule, row in first.items():
        theirs = PAPER_TABLE_1[rule]
        cells = (_cell(row.detected, row.num_leaves), theirs[0], _cell(row.false_alarm, row.num_still), theirs[1])
        lines.append(f"| {names[rule]} | {row.num_runs} | " + " | ".join(str(cell) for cell in cells) + " |")
    for rule, (detected, false_alarm) in (at_papers or {}).items():
        row, theirs = first[rule], PAPER_TABLE_1[rule]
        cells = (_cell(detected, row.num_leaves), theirs[0], _cell(false_alarm, row.num_still), theirs[1])
        what = f"{names[rule]}, at the paper's P_FA"
        lines.append(f"| {what} | {row.num_runs} | " + " | ".join(str(cell) for cell in cells) + " |")
    lines += [
        "",
        "| scenario | runs | P_D,run (95 %) | paper | P_D (95 %) | paper | P_FA (95 %) | paper | alarms of carried tags that stay |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for name, row in second.items():
        label, run, detected, false_alarm = PAPER_TABLE_2[name]
        cells = (
            _cell(row.detected_run, row.num_runs),
            run,
            _cell(row.detected, row.num_leaves),
            detected,
            _cell(row.false_alarm, row.num_still),
            "-" if false_alarm is None else false_alarm,
            _cell(row.false_alarm_stays, row.num_stays),
        )
        lines.append(f"| {label} | {row.num_runs} | " + " | ".join(str(cell) for cell in cells) + " |")
    return "\n".join(lines) + "\n"


def ladder_markdown(rungs: Mapping[str, Mapping[str, Rates]]) -> str:
    """P_D / P_FA of every scenario where one sensor, or both, are replaced by the truth."""
    names = {**{name: label[0] for name, label in PAPER_TABLE_2.items()}, SIMPLE: "SP-ST, 2 still", "all": "all"}
    columns = [name for name in names if any(name in row for row in rungs.values())]
    lines = [
        "| P_D / P_FA | " + " | ".join(names[name] for name in columns) + " |",
        "|" + "---|" * (1 + len(columns)),
    ]
    for rung, row in rungs.items():
        lines.append(f"| {rung} | " + " | ".join(_pair(row[name]) if name in row else "-" for name in columns) + " |")
    return "\n".join(lines) + "\n"


def _pair(row: Rates) -> str:
    return " / ".join("-" if np.isnan(share) else f"{share:.3f}" for share in (row.detected, row.false_alarm))


def _cell(share: float, count: int) -> str:
    if count == 0:
        return "-"
    low, high = interval(share, count)
    return f"{share:.3f} ({low:.2f} to {high:.2f}) of {count}"


def plain(row: Rates) -> dict[str, Any]:
    """For JSON: NaN as None."""
    values: dict[str, Any] = dataclasses.asdict(row)
    return {key: None if isinstance(value, float) and np.isnan(value) else value for key, value in values.items()}


def location_error_m(
    calibration: Calibration, examples: Sequence[tuple[Observations, Carried]], settings: GollerSettings
) -> Float[np.ndarray, " errors"]:
    """Distance of every located tag from its place, along the antennas' line, at every frame since it was first heard."""
    errors = []
    for seen, truth in examples:
        if not seen.epcs:
            continue
        location = decide(calibration, seen, settings).location
        for row, epc in enumerate(seen.epcs):
            path = truth.position_m[truth.epcs.index(epc), :, 0]
            known = np.asarray(location.known[row])
            errors.append(np.abs(np.asarray(location.position_m[row, :, 0]) - path)[known])
    return np.concatenate(errors) if errors else np.zeros(0)
