"""All of TagVision's experiments in one run: figures, a table, plots."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...baselines.tagvision import MatchSettings, TagVisionSettings
from ...baselines.tagvision.figures import error_plot, line_plot, matching_plot
from ...core.settings import ConfigError, from_mapping
from ...recording.store import open_recording
from ...report.report import write_json
from ...sim.suites import PLANAR, SPLITS, Item, Suite, make_suite
from ._calibration import PAPER_CAMERA, CalibrationSettings, calibrated, overhead, transform_error_m
from ._lines import LineScores, LineSettings, line_scores
from ._table import TagResult, judge, see, table_truth

PAPER = {"blob_matching": 0.98, "tracking_error_mm": 10.33, "transform_error_mm": 1.56, "others_below": 0.075}
"""What the paper reports of its own experiments."""


@dataclasses.dataclass(frozen=True)
class TagVisionExperiment:
    """What is run. `suite` is one of objects that move over a table; None leaves that part out."""

    suite: Mapping[str, Any] | None = None
    recordings_dir: str = "recordings"  # missing recordings of the suite are simulated
    split: str = "test"
    smoke: bool = False
    workers: int = 1
    lines: tuple[LineSettings, ...] = ()
    calibration: CalibrationSettings = dataclasses.field(default_factory=CalibrationSettings)
    num_calibrations: int = 20
    system: TagVisionSettings = dataclasses.field(default_factory=TagVisionSettings)
    matching: Mapping[str, MatchSettings] = dataclasses.field(default_factory=dict)  # compared on the same tracks
    windows_s: tuple[float, ...] = (1.0, 2.0, 3.0, 5.0)

    def __post_init__(self):
        if self.split not in SPLITS:
            raise ConfigError(f"split is {self.split!r}; expected one of {', '.join(SPLITS)}.")
        if self.num_calibrations < 1 or self.workers < 1:
            raise ConfigError(f"num_calibrations {self.num_calibrations}, workers {self.workers}; expected at least 1.")


def run_tagvision(
    config: TagVisionExperiment, folder: Path, *, on_progress: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Run what the configuration names; writes `metrics.json`, `table.md`, `tags.csv` and plots, returns the metrics.

    Raises `ConfigError`, before anything is done, for a suite without pictures.
    """
    tell = on_progress or (lambda _: None)
    suite = None if config.suite is None else from_mapping(Suite, config.suite, where="suite")
    if suite is not None and suite.story == PLANAR:
        raise ConfigError(
            f"{suite.name} has no pictures, only the phases of lines, which are scored without suite= as well (see "
            "`lines`). Leave it out, or choose a suite of things that move over a table: suite=planar_tracks."
        )
    folder.mkdir(parents=True, exist_ok=True)
    metrics: dict[str, Any] = {"paper": PAPER}
    tell("parallel lines")
    lines = [line_scores(settings) for settings in config.lines]
    if lines:
        metrics["lines"] = {one.settings.name: one.summary() for one in lines}
        panels = [(_title(one), one.curve(1), one.curve()) for one in lines]
        line_plot(folder / "lines.png", lines[0].line_m, panels, float(lines[0].line_m[lines[0].true_line]))
    tell("calibration")
    metrics["calibration"] = _calibrations(config)
    if suite is not None:
        suite = suite.smoke() if config.smoke else suite
        make_suite(
            suite,
            Path(config.recordings_dir),
            workers=config.workers,
            on_done=lambda made: tell(f"simulated {made.name}"),
        )
        items = [item for item in suite.items() if item.split == config.split]
        if not items:
            raise ConfigError(f"{suite.name} has no {config.split} recording: raise suite.counts.{config.split}.")
        metrics["tracks"] = _tracks(config, items, folder, tell)
    write_json(folder / "metrics.json", metrics)
    (folder / "table.md").write_text(table(metrics) + "\n")
    return metrics


def _title(one: LineScores) -> str:
    chosen, told = one.settings, one.summary()
    return f"{chosen.name} ({chosen.reference}): truth best in {told['truth_is_maximum_share_of_rounds']:.0%} of rounds"


def _calibrations(config: TagVisionExperiment) -> dict[str, Any]:
    """Mean transform error on a table of 1.2 x 2 m seen from 2 m by the paper's camera, the board laid in several
    places or in one."""
    area = (-0.6, -1.0, 0.6, 1.0)
    true = overhead(PAPER_CAMERA, (0.02, 0.03, 2.0))
    out = {}
    for name, places in (("one_place", 1), (f"{config.calibration.num_places}_places", config.calibration.num_places)):
        errors = []
        for seed in range(config.num_calibrations):
            settings = dataclasses.replace(config.calibration, num_places=places, seed=config.calibration.seed + seed)
            noise = settings.corner_noise_px
            errors.append(transform_error_m(calibrated(true, area, settings), true, area, pixel_noise_px=noise).mean())
        out[name] = {"transform_error_mm": float(np.mean(errors)) * 1e3, "worst_mm": float(np.max(errors)) * 1e3}
    return out


def _tracks(
    config: TagVisionExperiment, items: Sequence[Item], folder: Path, tell: Callable[[str], None]
) -> dict[str, Any]:
    results: dict[str, list[TagResult]] = {name: [] for name in config.matching}
    transform_mm = []
    if not results:
        raise ConfigError("matching is empty; expected at least one setting to match with.")
    for number, item in enumerate(items):
        tell(f"{item.name} ({number + 1} of {len(items)})")
        recording = open_recording(item.path(Path(config.recordings_dir)))
        truth = table_truth(item, recording)
        settings = dataclasses.replace(config.calibration, seed=config.calibration.seed + 1000 + number)
        camera = calibrated(truth.camera, truth.area_m, settings)
        error_m = transform_error_m(camera, truth.camera, truth.area_m, pixel_noise_px=settings.corner_noise_px)
        transform_mm.append(float(error_m.mean()) * 1e3)
        seen = see(recording, camera, config.system)
        for name, matching in config.matching.items():
            results[name] += judge(seen, recording, truth, matching, windows_s=config.windows_s)
    _write_tags(folder / "tags.csv", results)
    summaries = {name: summarise(tags) for name, tags in results.items()}
    share = {name: {float(k): v for k, v in one["matching_by_seconds"].items()} for name, one in summaries.items()}
    matching_plot(folder / "matching.png", share)
    right = [tag for tag in results[next(iter(results))] if tag.matched]
    kinds = ("error_mm", "error_own_height_mm", "tag_error_mm")
    named = ("middle of the host", "the same, own height known", "the tag itself")
    curves = {
        said: np.concatenate([getattr(tag, kind) for tag in right] or [np.zeros(0)])
        for said, kind in zip(named, kinds, strict=True)
    }
    error_plot(folder / "errors.png", curves, target_mm=PAPER["tracking_error_mm"])
    transform = {"mean": float(np.mean(transform_mm)), "worst": float(np.max(transform_mm))}
    return {"transform_error_mm": transform, "num_recordings": len(items), "matching": summaries}


def summarise(tags: Sequence[TagResult]) -> dict[str, Any]:
    """Figures over tags; errors are of rightly matched tags unless it says otherwise, None where there is none."""
    right = [tag for tag in tags if tag.matched]
    several = [tag for tag in tags if sum(other.recording == tag.recording for other in tags) > 1]

    def mean(kind: str, chosen: Sequence[TagResult]) -> float | None:
        values = np.concatenate([getattr(tag, kind) for tag in chosen] or [np.zeros(0)])
        return float(values.mean()) if len(values) else None

    windows = sorted({length for tag in tags for length in tag.matched_part})
    by_window = {}
    for length in windows:
        counts = [tag.matched_part[length] for tag in several or tags if length in tag.matched_part]
        total = sum(count for _, count in counts)
        by_window[f"{length:g}"] = sum(hits for hits, _ in counts) / total if total else float("nan")
    claimed = sum(tag.followed[1] for tag in tags)
    return {
        "num_tags": len(tags),
        "blob_matching": float(np.mean([tag.matched for tag in tags])) if tags else None,
        "num_tags_among_several": len(several),
        "blob_matching_among_several": float(np.mean([tag.matched for tag in several])) if several else None,
        "matching_by_seconds": by_window,
        "claims_right": sum(tag.followed[0] for tag in tags) / claimed if claimed else None,
        "claimed_frames": claimed,
        "tracking_error_mm": mean("error_mm", right),
        "tracking_error_own_height_mm": mean("error_own_height_mm", right),
        "tracking_error_all_tags_mm": mean("error_mm", tags),
        "tag_error_mm": mean("tag_error_mm", right),
        "least_score_ratio": _least([tag.score / tag.next_score for tag in several if tag.next_score > 0]),
    }


def _least(values: Sequence[float]) -> float | None:
    return float(min(values)) if values else None


def _write_tags(path: Path, results: Mapping[str, Sequence[TagResult]]) -> None:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("matching", "recording", "epc", "matched", "score", "next_score", "lead_mm", "error_mm"))
        for name, tags in results.items():
            for tag in tags:
                error = f"{tag.error_mm.mean():.2f}" if len(tag.error_mm) else ""
                scores = (f"{tag.score:.4f}", f"{tag.next_score:.4f}", f"{tag.lead_mm:.0f}")
                writer.writerow((name, tag.recording, tag.epc, int(tag.matched), *scores, error))


def table(metrics: Mapping[str, Any]) -> str:
    """The metrics as Markdown tables, the paper's figures beside them."""
    rows = []
    if "lines" in metrics:
        rows += [
            "| lines | truth is maximum (rounds) | error of a round, mm | others: least, median, 90 % below | below 0.075 |"
        ]
        rows += ["|---|---|---|---|---|"]
        for name, one in metrics["lines"].items():
            rows.append(
                f"| {name} | {'yes' if one['truth_is_maximum'] else 'no'} ({one['truth_is_maximum_share_of_rounds']:.2f}) "
                f"| {one['error_of_a_round_mm']:.1f} | {one['others_least']:.3f}, {one['others_median']:.3f}, "
                f"{one['others_90_percent_below']:.3f} | {one['others_below_0.075']:.2f} |"
            )
        rows.append("")
    rows += ["| calibration | transform error, mm | worst | paper |", "|---|---|---|---|"]
    for name, one in metrics["calibration"].items():
        rows.append(f"| {name} | {one['transform_error_mm']:.2f} | {one['worst_mm']:.2f} | 1.56 |")
    if "tracks" in metrics:
        own = metrics["tracks"]["transform_error_mm"]
        rows += [f"| the recordings' | {own['mean']:.2f} | {own['worst']:.2f} | 1.56 |", ""]
        rows += ["| matching | all tags | among several | claims right | error, mm | own height, mm | tag, mm |"]
        rows += ["|---|---|---|---|---|---|---|", "| the paper's | 0.98 | | | 10.33 | | |"]
        for name, one in metrics["tracks"]["matching"].items():
            cells = (
                _cell(one["blob_matching"], one["num_tags"]),
                _cell(one["blob_matching_among_several"], one["num_tags_among_several"]),
                _cell(one["claims_right"]),
                _cell(one["tracking_error_mm"]),
                _cell(one["tracking_error_own_height_mm"]),
                _cell(one["tag_error_mm"]),
            )
            rows.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(rows)


def _cell(value: float | None, count: int | None = None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f} of {count}" if count is not None else f"{value:.3g}"
