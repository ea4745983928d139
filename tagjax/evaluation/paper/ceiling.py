"""Figures of objects on a table seen from the ceiling: Tagview's Figs. 7 to 11."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from ...baselines.boxes import box_centre_px
from ...baselines.tagview import TagviewTracer
from ...baselines.tagview.experiment.run import score_settings
from ...baselines.tagview.experiment.scoring import (
    RecordingScore,
    TrackedRecording,
    quartiles,
    summarise,
    track_recording,
)
from ...baselines.tagview.figures import accuracy_plot, pair_plot, track_plot
from ...baselines.tagvision import PlaneCamera
from ...baselines.tagvision.experiment import scoring as tagvision_scoring
from ...baselines.tagvision.experiment.simulated_calibration import simulate_calibration
from ...baselines.tagvision.experiment.table_truth import table_truth
from ...baselines.tagvision.matching import match_tags
from ...core.results import write_csv
from ...metrics.interval import Estimate, ratio_estimate
from ...report.paper.bars import bar_figure
from ...report.paper.style import shrink
from ...sim.suites import Item
from .sources import Sources

MAIN = "tagview"
"""The setting of `PaperConfig.tagview_matching` beside which the paper's values stand."""

MOVED_M, MOVED_RAD = np.array([0.3, 0.3, 0.0]), np.radians(20.0)
"""How far the camera is from where it was calibrated, in the uncalibrated case of Fig. 9."""


@dataclasses.dataclass(frozen=True)
class CeilingResult:
    """Tagview's tracks and scores of one recording, by setting."""

    tracked: TrackedRecording
    scores: Mapping[str, RecordingScore]


def tracks(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 7: centres of the traces and of the objects over a picture."""
    one, recording = _result(sources, items[0]), sources.recording(items[0])
    tracked = one.tracked
    track_plot(path, tracked.name, tracked.truth_px, tracked.box_px, np.asarray(recording.colour[0]))
    shrink(path)
    rows: list[tuple[str, int, int, str, str]] = []
    for kind, boxes in (("object", tracked.truth_px), ("trace", tracked.box_px)):
        for number, centres in enumerate(box_centre_px(boxes)):
            frames = np.flatnonzero(np.isfinite(centres[:, 0]))
            rows += [(kind, number, int(f), f"{centres[f, 0]:.2f}", f"{centres[f, 1]:.2f}") for f in frames]
    write_csv(path.with_suffix(".csv"), ("of", "number", "frame", "x_px", "y_px"), rows)
    error = one.scores[MAIN].error_px
    return (
        f"{tracked.name}. Error of the centres {error.mean():.2f} px (standard deviation {error.std():.2f} px), "
        f"{error.mean() * tracked.mm_per_px:.1f} mm, in a picture {recording.intrinsics.width} pixels wide."
    )


def pairs(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 8: R^2 and linear coefficient of correct and of incorrect pairs."""
    scores = [_result(sources, item).scores[MAIN] for item in items]
    pair_plot(path, scores)
    rows = [
        (one.recording, kind, int(right), f"{value:.5g}")
        for one in scores
        for kind in ("r_squared", "slope")
        for value, right in getattr(one, kind).T
    ]
    write_csv(path.with_suffix(".csv"), ("recording", "of", "correct", "value"), rows)
    parts = []
    for kind, name in (("r_squared", "R²"), ("slope", "slope over 4πh/λ")):
        found = quartiles(scores, kind)
        texts = [
            f"{which} {value[1]:.2f} ({value[0]:.2f} to {value[2]:.2f})" for which, value in found.items() if value
        ]
        parts.append(f"{name} {', '.join(texts)}")
    hungarian = summarise([_result(sources, item).scores["hungarian"] for item in items])["accuracy"]
    return f"Median and quartiles: {'; '.join(parts)}. The Hungarian algorithm alone identifies {_number(hungarian)}."


def systems(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 9: Tagview, and TagVision with a calibrated camera and with one that was moved since its calibration."""
    counts: dict[str, list[tuple[int, int]]] = {"Tagview": []}
    for item in items:
        score = _result(sources, item).scores[MAIN]
        counts["Tagview"].append((score.num_correct, score.num_traces))
        for name, right in tagvision_matches(sources, item).items():
            counts.setdefault(name, []).append((sum(right), len(right)))
    reported = {"Tagview": 0.98, "TagVision,\ncalibrated": 0.98, "TagVision,\nuncalibrated": 0.30}
    return _bars(path, counts, reported)


_SETTINGS = {"tagview": "Tagview", "hungarian": "Hungarian algorithm alone"}


def by_number(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 10: accuracy by the number of tags, of Tagview and of the Hungarian algorithm alone."""
    by_count: dict[str, dict[int, list[RecordingScore]]] = {}
    for item in items:
        for name, score in _result(sources, item).scores.items():
            by_count.setdefault(name, {}).setdefault(score.num_tags, []).append(score)
    accuracy = {
        name: {
            count: float(value)
            for count, ones in sorted(counts.items())
            if (value := summarise(ones)["accuracy"]) is not None
        }
        for name, counts in by_count.items()
    }
    accuracy_plot(path, {_SETTINGS.get(name, name): values for name, values in accuracy.items()})
    rows = [
        (name, count, sum(one.num_correct for one in ones), sum(one.num_traces for one in ones), len(ones))
        for name, counts in by_count.items()
        for count, ones in sorted(counts.items())
    ]
    write_csv(path.with_suffix(".csv"), ("setting", "num_tags", "correct", "traces", "recordings"), rows)
    texts = [f"{count} tags {value:.2f}" for count, value in accuracy[MAIN].items()]
    return f"Accuracy of Tagview: {', '.join(texts)}."


def by_model(sources: Sources, items: list[Item], path: Path) -> str:
    """Fig. 11: accuracy by the tags' model."""
    counts: dict[str, list[tuple[int, int]]] = {}
    for item in items:
        score = _result(sources, item).scores[MAIN]
        counts.setdefault(_MODELS.get(item.variant.name, item.variant.name), []).append(
            (score.num_correct, score.num_traces)
        )
    return _bars(path, counts, {})


_MODELS = {"squiggle": "Squiggle", "short": "Short", "square": "Square", "two_by_two": "2 × 2"}  # noqa: RUF001


def tagvision_matches(sources: Sources, item: Item) -> dict[str, list[bool]]:
    """Whether TagVision matches each tag to its object, with a calibrated and with an uncalibrated camera.

    The uncalibrated camera was moved by `MOVED_M` and turned by `MOVED_RAD` about the vertical since its calibration; the
    antenna is where it was. Which object a track follows is judged by the true calibration in both cases.
    """
    config, recording = sources.config, sources.recording(item)
    truth = table_truth(item, recording)
    camera = simulate_calibration(truth.camera, truth.area_m, config.calibration)
    sources.report(f"{item.name}, TagVision")
    tracked = tagvision_scoring.track_recording(recording, camera, config.tagvision)
    hosts = {number: tagvision_scoring.nearest_host(one, truth.hosts_m) for number, one in tracked.paths_m.items()}
    read_s = (recording.reads.time_ns - recording.time_ns[0]) * 1e-9
    away = moved(camera)
    height_m = config.tagvision.height_m
    paths = {
        "TagVision,\ncalibrated": tracked.paths_m,
        "TagVision,\nuncalibrated": {
            number: through(one, camera, away, height_m) for number, one in tracked.paths_m.items()
        },
    }
    out = {}
    for name, own in paths.items():
        matches = match_tags(
            tracked.epcs, tracked.time_s, own, recording.reads, read_s, tracked.antenna_m, config.tagvision.match
        )
        out[name] = [hosts.get(matches[epc].track) == epc for epc in tracked.epcs]
    return out


def moved(camera: PlaneCamera) -> PlaneCamera:
    """A camera with the same lens, at another place over the plane and turned about the vertical."""
    cosine, sine = np.cos(MOVED_RAD), np.sin(MOVED_RAD)
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    rotation = camera.rotation @ turn
    return PlaneCamera(camera.intrinsics, rotation, -rotation @ (camera.position_m + MOVED_M))


def through(path_m: np.ndarray, seen_by: PlaneCamera, taken_for: PlaneCamera, height_m: float) -> np.ndarray:
    """A path on the plane as it looks where the pictures of one camera are taken for those of another."""
    known, out = np.isfinite(path_m).all(axis=1), np.full(path_m.shape, np.nan)
    out[known] = taken_for.to_plane(seen_by.to_picture(path_m[known]), height_m)
    return out


def _result(sources: Sources, item: Item) -> CeilingResult:
    """Tagview on a recording, once for all figures."""

    def make() -> CeilingResult:
        sources.report(f"{item.name}, Tagview")
        config, recording = sources.config, sources.recording(item)
        tracer = sources.once(("tagview",), lambda: TagviewTracer(dataclasses.replace(config.tagview, memory_s=1e9)))
        tracked = track_recording(tracer, recording)
        min_trace_s = config.tagview.min_trace_s
        return CeilingResult(tracked, score_settings(config.tagview_matching, min_trace_s, tracer, recording, tracked))

    return sources.once(("ceiling", item.name), make)


def _bars(path: Path, counts: Mapping[str, list[tuple[int, int]]], reported: Mapping[str, float]) -> str:
    """Bars of fractions with intervals by recording; a sentence with the values."""
    bars: dict[str, Estimate] = {
        name: ratio_estimate(np.array([right for right, _ in ones], float), np.array([count for _, count in ones]))
        for name, ones in counts.items()
    }
    bar_figure(path, bars, ylabel="identification accuracy", reported=reported)
    rows = [
        (name.replace("\n", " "), one.total, one.count, one.value, one.low, one.high, one.num_recordings)
        for name, one in bars.items()
    ]
    headings = ("of", "correct", "all", "accuracy", "low", "high", "recordings")
    write_csv(path.with_suffix(".csv"), headings, rows)
    texts = [f"{name.replace(chr(10), ' ')} {one.total:.0f} of {one.count}" for name, one in bars.items()]
    return f"Identified: {'; '.join(texts)}."


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.2f}"
