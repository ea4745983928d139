"""Tagview's experiments in one run: identification on simulated suites; metrics, tables and plots."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ....core.files import write_atomic
from ....core.numerics import SPEED_OF_LIGHT_M_S
from ....core.progress import OnProgress, unobserved
from ....core.results import write_csv, write_json
from ....recording import Recording
from ....recording.store import open_recording
from ....recording.suite_folder import SPLITS, find_recordings
from ..matching import MatchSettings
from ..sequences import ReadSettings
from ..settings import TagviewSettings
from ..tracer import TagviewTracer
from .detector import DetectorTraining
from .scoring import (
    RecordingScore,
    TrackedRecording,
    plane_depth_m,
    quartiles,
    score_recording,
    summarise,
    track_recording,
)
from .tables import PAPER, report_markdown

Scores = Mapping[str, Mapping[str, Sequence[RecordingScore]]]
"""Scores by group of recordings and by setting."""

_COUNTS = ("one", "two", "three", "four", "five", "six")
_SAME_PHASE = "half_wavelength"  # the suite whose tags have the same phases: its wrong pairs fit as well


@dataclasses.dataclass(frozen=True)
class Matching:
    """One setting of the identification, compared with others on the same traces."""

    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)
    reads: ReadSettings = dataclasses.field(default_factory=ReadSettings)


@dataclasses.dataclass(frozen=True)
class TagviewExperiment:
    """What is run, on recordings made by `experiments.simulate`."""

    recordings_dir: str = "recordings"
    suites: tuple[str, ...] = ()
    split: str = "test"
    max_recordings: int | None = None  # of a variant; all if None
    system: TagviewSettings = dataclasses.field(default_factory=TagviewSettings)
    matching: Mapping[str, Matching] = dataclasses.field(default_factory=dict)
    main: str = "tagview"  # the setting beside which the paper's figures stand
    training: DetectorTraining = dataclasses.field(default_factory=DetectorTraining)

    def __post_init__(self):
        if self.split not in SPLITS:
            raise ValueError(f"split is {self.split!r}; expected one of {', '.join(SPLITS)}.")
        if not self.suites:
            raise ValueError("suites is empty; expected names of suites under `recordings_dir`.")
        if self.main not in self.matching:
            raise ValueError(f"main is {self.main!r}; expected one of {', '.join(self.matching) or 'none given'}.")

    def find(self, split: str) -> list[tuple[str, Path]]:
        """Group (suite and variant) and path of each recording of a split.

        Raises `ValueError` where a suite has none.
        """
        found: list[tuple[str, Path]] = []
        for suite in self.suites:
            recordings = find_recordings(Path(self.recordings_dir) / suite, split, self.max_recordings)
            if not recordings:
                raise ValueError(
                    f"{self.recordings_dir}/{suite}/{split}: no recording. `python -m experiments.simulate suite={suite} "
                    f"paths.recordings_dir={self.recordings_dir}` makes some."
                )
            recordings.sort(key=lambda one: (_count(one.variant), one))
            found += [(suite if one.variant == "all" else f"{suite} {one.variant}", one.path) for one in recordings]
        return found


def _count(variant: str) -> int:
    """Number of tags of a variant named by it; variants with other names come first."""
    return _COUNTS.index(variant) if variant in _COUNTS else -1


def run_tagview(config: TagviewExperiment, folder: Path, *, on_progress: OnProgress = unobserved) -> dict[str, Any]:
    """Track and identify all recordings; writes `metrics.json`, `report.md`, `recordings.csv` and plots.

    Returns the metrics. `on_progress` counts the recordings. Raises `ValueError` for suites without recordings and for recordings to which Tagview does not apply.
    """
    from .. import figures

    todo = config.find(config.split)
    folder.mkdir(parents=True, exist_ok=True)
    tracer = TagviewTracer(dataclasses.replace(config.system, memory_s=1e9))
    scores: dict[str, dict[str, list[RecordingScore]]] = {}
    mm_per_px, num_rows = [], 0
    for number, (group, path) in enumerate(todo):
        recording = open_recording(path)
        on_progress("track", number, len(todo), recording.name)
        reason = tracer.inapplicable(recording)
        if reason is not None:
            raise ValueError(f"{recording.name}: Tagview does not apply: {reason}")
        tracked = track_recording(tracer, recording)
        for name, score in score_settings(
            config.matching, config.system.min_trace_s, tracer, recording, tracked
        ).items():
            scores.setdefault(group, {}).setdefault(name, []).append(score)
        mm_per_px.append(tracked.mm_per_px)
        num_rows = recording.image_shape[0]
        if number == 0:
            picture = np.asarray(recording.colour[0])
            figures.track_plot(folder / "tracks.png", tracked.name, tracked.truth_px, tracked.box_px, picture)
    on_progress("track", len(todo), len(todo))
    metrics = _metrics(config, scores, float(np.mean(mm_per_px)), num_rows)
    main = [one for group in scores.values() for one in group[config.main]]
    pairs = [one for one in main if not one.recording.startswith(_SAME_PHASE)]
    figures.pair_plot(folder / "pairs.png", pairs)
    if accuracy := _accuracy_by_tags(scores):
        figures.accuracy_plot(folder / "accuracy.png", accuracy)
    _write_recordings(folder / "recordings.csv", scores)
    write_json(folder / "metrics.json", metrics)
    write_atomic(folder / "report.md", report_markdown(metrics))
    return metrics


def score_settings(
    matching: Mapping[str, Matching],
    min_trace_s: float,
    tracer: TagviewTracer,
    recording: Recording,
    tracked: TrackedRecording,
) -> dict[str, RecordingScore]:
    """The recording's score with every setting, on the same tracks; traces shorter than `min_trace_s` do not count."""
    carrier_hz = float(np.nanmedian(recording.reads.carrier_hz))
    true_slope = 4 * np.pi * plane_depth_m(recording) * carrier_hz / SPEED_OF_LIGHT_M_S
    min_frames = max(round(min_trace_s * recording.frame_rate_hz), 1)
    scores = {}
    for name, setting in matching.items():
        found, _ = tracer.identify(tracked.camera, tracked.state, setting.match, setting.reads)
        scores[name] = score_recording(tracked, found, min_frames=min_frames, true_slope=true_slope)
    return scores


def _accuracy_by_tags(scores: Scores) -> dict[str, dict[int, float]]:
    """Accuracy of each setting by number of tags, over the suites named ceiling_*."""
    by_count: dict[str, dict[int, list[RecordingScore]]] = {}
    for group, settings in scores.items():
        if group.startswith("ceiling_"):
            for name, ones in settings.items():
                for one in ones:
                    by_count.setdefault(name, {}).setdefault(one.num_tags, []).append(one)
    return {
        name: {count: value for count, ones in counts.items() if (value := summarise(ones)["accuracy"]) is not None}
        for name, counts in by_count.items()
    }


def _metrics(config: TagviewExperiment, scores: Scores, mm_per_px: float, num_rows: int) -> dict[str, Any]:
    groups = {group: {name: summarise(ones) for name, ones in settings.items()} for group, settings in scores.items()}
    ceiling = [group for group in scores if group.startswith("ceiling_")]
    if ceiling:
        groups["ceiling, all"] = {
            name: summarise([one for group in ceiling for one in scores[group][name]]) for name in config.matching
        }
    main = [one for settings in scores.values() for one in settings[config.main]]
    errors = np.concatenate([one.error_px for one in main])
    pairs = [one for one in main if not one.recording.startswith(_SAME_PHASE)]
    error_px, std_px = (float(x) if len(errors) else 0.0 for x in (errors.mean(), errors.std()))
    return {
        "paper": PAPER,
        "main": config.main,
        "groups": groups,
        "tracking": {
            "error_px": error_px,
            "std_px": std_px,
            "error_mm": error_px * mm_per_px,
            "height_px": num_rows,
        },
        "pairs": {kind: quartiles(pairs, kind) for kind in ("r_squared", "slope")},
    }


def _write_recordings(path: Path, scores: Scores) -> None:
    counts = (
        "num_tags", "num_traces", "num_false", "num_correct", "num_identified", "num_stretches", "num_covered", "gap",
    )  # fmt: skip
    rows = [
        (
            group,
            name,
            one.recording,
            *(getattr(one, key) for key in counts),
            f"{one.error_px.mean():.3f}" if len(one.error_px) else None,
        )
        for group, settings in scores.items()
        for name, ones in settings.items()
        for one in ones
    ]
    write_csv(path, ("group", "setting", "recording", *counts, "error_px"), rows)
