"""TagVision's experiments in one run: parallel lines, calibration, objects over a table; metrics, tables and plots."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....core.files import write_atomic
from ....core.progress import OnProgress, unobserved
from ....core.results import write_csv, write_json
from ....core.settings import ConfigError, from_mapping
from ....recording.store import open_recording
from ....recording.suite_folder import SPLITS
from ..matching import MatchSettings
from ..settings import TagVisionSettings
from .lines import LineSettings
from .scoring import TagResult, score_tags, summarise, track_recording
from .simulated_calibration import PAPER_CAMERA, CalibrationSettings, overhead, simulate_calibration, transform_error_m
from .tables import PAPER, report_markdown

if TYPE_CHECKING:
    from ....sim.suites import Item, Suite

_AREA_M = (-0.6, -1.0, 0.6, 1.0)  # the paper's table


@dataclasses.dataclass(frozen=True)
class TagVisionExperiment:
    """What is run. `suite` is a suite of objects that move over a table; None leaves that part out."""

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
        if self.suite is not None and not self.matching:
            raise ConfigError("matching is empty; expected at least one setting to match with.")


def run_tagvision(config: TagVisionExperiment, folder: Path, *, on_progress: OnProgress = unobserved) -> dict[str, Any]:
    """Run the configured experiments; writes `metrics.json`, `table.md`, `tags.csv` and plots, returns the metrics.

    Raises `ConfigError`, before any work, for a suite without pictures.
    """
    suite = None if config.suite is None else _table_suite(config.suite)
    folder.mkdir(parents=True, exist_ok=True)
    metrics: dict[str, Any] = {"paper": PAPER}
    if config.lines:
        metrics["lines"] = _lines(config.lines, folder, on_progress)
    metrics["calibration"] = _calibrations(config, on_progress)
    if suite is not None:
        items = _simulate(config, suite.smoke() if config.smoke else suite, on_progress)
        metrics["tracks"] = _tracks(config, items, folder, on_progress)
    write_json(folder / "metrics.json", metrics)
    write_atomic(folder / "table.md", report_markdown(metrics))
    return metrics


def _table_suite(values: Mapping[str, Any]) -> Suite:
    from ....sim.suites import PLANAR, Suite

    suite = from_mapping(Suite, values, where="suite")
    if suite.story == PLANAR:
        raise ConfigError(
            f"{suite.name} has no pictures, only the phases of lines, which this command scores without suite= as well "
            "(see `lines`). Leave it out, or choose a suite of objects that move over a table: suite=planar_tracks."
        )
    return suite


def _simulate(config: TagVisionExperiment, suite: Suite, report: OnProgress) -> list[Item]:
    """The suite's recordings of the split, simulated where missing."""
    from ....sim.suites import make_suite

    make_suite(suite, Path(config.recordings_dir), workers=config.workers, on_progress=report)
    items = [item for item in suite.items() if item.split == config.split]
    if not items:
        raise ConfigError(f"{suite.name} has no {config.split} recording: raise suite.counts.{config.split}.")
    return items


def _lines(settings: Sequence[LineSettings], folder: Path, report: OnProgress) -> dict[str, dict[str, float]]:
    from .. import figures
    from .lines import line_scores

    scores = []
    for number, one in enumerate(settings):
        report("parallel lines", number, len(settings), one.name)
        scores.append(line_scores(one))
    report("parallel lines", len(settings), len(settings))
    summaries = [one.summary() for one in scores]
    titles = [
        f"{one.name} ({one.reference}): truth best in {summary['truth_is_maximum_fraction_of_rounds']:.0%} of rounds"
        for one, summary in zip(settings, summaries, strict=True)
    ]
    panels = [(title, one.curve(1), one.curve()) for title, one in zip(titles, scores, strict=True)]
    figures.line_plot(folder / "lines.png", scores[0].line_m, panels, float(scores[0].line_m[scores[0].true_line]))
    return {one.name: summary for one, summary in zip(settings, summaries, strict=True)}


def _calibrations(config: TagVisionExperiment, report: OnProgress) -> dict[str, Any]:
    """Mean transform error on a table of 1.2 x 2 m seen from 2 m by the paper's camera, with the board at one position
    or at several."""
    true, several = overhead(PAPER_CAMERA, (0.02, 0.03, 2.0)), config.calibration.num_board_positions
    out, numbers = {}, itertools.count()
    total = 2 * config.num_calibrations
    for name, count in (("one_place", 1), (f"{several}_places", several)):
        errors = []
        for seed in range(config.num_calibrations):
            report("calibration", next(numbers), total)
            settings = dataclasses.replace(
                config.calibration, num_board_positions=count, seed=config.calibration.seed + seed
            )
            found = simulate_calibration(true, _AREA_M, settings)
            errors.append(transform_error_m(found, true, _AREA_M, pixel_noise_px=settings.corner_noise_px).mean())
        out[name] = {"transform_error_mm": float(np.mean(errors)) * 1e3, "worst_mm": float(np.max(errors)) * 1e3}
    report("calibration", total, total)
    return out


def _tracks(config: TagVisionExperiment, items: Sequence[Item], folder: Path, report: OnProgress) -> dict[str, Any]:
    """Blob matching and tracking error on the suite's recordings, each with a calibration of its own."""
    from .table_truth import table_truth

    results: dict[str, list[TagResult]] = {name: [] for name in config.matching}
    transform_mm = []
    for number, item in enumerate(items):
        report("track", number, len(items), item.name)
        recording = open_recording(item.path(Path(config.recordings_dir)))
        truth = table_truth(item, recording)
        settings = dataclasses.replace(config.calibration, seed=config.calibration.seed + 1000 + number)
        camera = simulate_calibration(truth.camera, truth.area_m, settings)
        error_m = transform_error_m(camera, truth.camera, truth.area_m, pixel_noise_px=settings.corner_noise_px)
        transform_mm.append(float(error_m.mean()) * 1e3)
        tracked = track_recording(recording, camera, config.system)
        for name, matching in config.matching.items():
            results[name] += score_tags(tracked, recording, truth, matching, windows_s=config.windows_s)
    report("track", len(items), len(items))
    _write_tags(folder / "tags.csv", results)
    summaries = {name: summarise(tags) for name, tags in results.items()}
    _plot_tracks(folder, results, summaries)
    transform = {"mean": float(np.mean(transform_mm)), "worst": float(np.max(transform_mm))}
    return {"transform_error_mm": transform, "num_recordings": len(items), "matching": summaries}


def _plot_tracks(
    folder: Path, results: Mapping[str, Sequence[TagResult]], summaries: Mapping[str, Mapping[str, Any]]
) -> None:
    from .. import figures

    by_time = {name: {float(k): v for k, v in one["matching_by_seconds"].items()} for name, one in summaries.items()}
    figures.matching_plot(folder / "matching.png", by_time)
    matched = [tag for tag in results[next(iter(results))] if tag.matched]
    labels = {
        "error_mm": "centre of the object",
        "error_own_height_mm": "the same, at the object's own height",
        "tag_error_mm": "the tag itself",
    }
    curves = {
        label: np.concatenate([getattr(tag, kind) for tag in matched] or [np.zeros(0)])
        for kind, label in labels.items()
    }
    figures.error_plot(folder / "errors.png", curves, target_mm=PAPER["tracking_error_mm"])


def _write_tags(path: Path, results: Mapping[str, Sequence[TagResult]]) -> None:
    rows = [
        (
            name,
            tag.recording,
            tag.epc,
            int(tag.matched),
            f"{tag.score:.4f}",
            f"{tag.next_score:.4f}",
            f"{tag.tag_offset_mm:.0f}",
            f"{tag.error_mm.mean():.2f}" if len(tag.error_mm) else None,
        )
        for name, tags in results.items()
        for tag in tags
    ]
    write_csv(
        path, ("matching", "recording", "epc", "matched", "score", "next_score", "tag_offset_mm", "error_mm"), rows
    )
