"""All of Tagview's experiments in one run, and the training of its detector."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ...baselines.tagview import (
    BoxDetector,
    MatchSettings,
    ReadSettings,
    TagviewSettings,
    TagviewTracer,
    TrainSettings,
    labelled_frames,
    measure_detector,
    save_detector,
    train_detector,
)
from ...core.numerics import SPEED_OF_LIGHT_M_S
from ...recording import Recording
from ...recording.store import open_recording
from ...report.report import write_json
from ._figures import accuracy_plot, pair_plot, track_plot
from ._judge import Judged, Watched, judge, watch
from ._table import PAPER_GROUPS, quartiles, summarise, table

PAPER = {"accuracy": 0.98, "hungarian": 0.91, "tracking_error_px": 4.82, "groups": PAPER_GROUPS}
"""What the paper reports of its own experiments."""

SPLITS = ("train", "validation", "test")


@dataclasses.dataclass(frozen=True)
class Matching:
    """One way to name the traces, compared with others on the same ones."""

    match: MatchSettings = dataclasses.field(default_factory=MatchSettings)
    reads: ReadSettings = dataclasses.field(default_factory=ReadSettings)


@dataclasses.dataclass(frozen=True)
class DetectorTraining:
    """Which recordings the detector is trained and measured on, and how."""

    recipe: TrainSettings = dataclasses.field(default_factory=TrainSettings)
    weights: str = "detector.npz"  # written there, within the run folder unless absolute
    measure_every: int = 4  # of the validation frames


@dataclasses.dataclass(frozen=True)
class TagviewExperiment:
    """What is run, on recordings that `experiments.simulate` has made."""

    recordings_dir: str = "recordings"
    suites: tuple[str, ...] = ()
    split: str = "test"
    max_recordings: int | None = None  # of each variant; all if None
    system: TagviewSettings = dataclasses.field(default_factory=TagviewSettings)
    matching: Mapping[str, Matching] = dataclasses.field(default_factory=dict)
    complete: str = "tagview"  # the entry of `matching` that is set beside the paper's figures
    training: DetectorTraining = dataclasses.field(default_factory=DetectorTraining)

    def __post_init__(self):
        if self.split not in SPLITS:
            raise ValueError(f"split is {self.split!r}; expected one of {', '.join(SPLITS)}.")
        if not self.suites:
            raise ValueError("suites is empty; expected names of suites under `recordings_dir`.")
        if self.complete not in self.matching:
            raise ValueError(
                f"complete is {self.complete!r}; expected one of {', '.join(self.matching) or 'none given'}."
            )


def find_recordings(root: str, suite: str, split: str, most: int | None = None) -> list[tuple[str, Path]]:
    """Group and path of a suite's recordings; raises `ValueError` where there is none."""
    found = []
    for path in (Path(root) / suite / split).glob("*.zarr"):
        parts = path.stem.rsplit("-", 3)
        if len(parts) == 4 and parts[3].isdigit() and (most is None or int(parts[3]) < most):
            group = suite if parts[1] == "all" else f"{suite} {parts[1]}"
            found.append((group, int(parts[3]), path))
    if not found:
        raise ValueError(
            f"{root}/{suite}/{split}: no recording. `python -m experiments.simulate suite={suite} paths.recordings_dir={root}` makes some."
        )
    order = {group: place for place, group in enumerate(_by_count({group for group, _, _ in found}))}
    return [(group, path) for group, _, path in sorted(found, key=lambda one: (order[one[0]], one[1]))]


def _by_count(groups: set[str]) -> list[str]:
    names = ("two", "three", "four")
    return sorted(
        groups, key=lambda group: (names.index(group.split()[-1]) if group.split()[-1] in names else -1, group)
    )


def run_tagview(
    config: TagviewExperiment, folder: Path, *, on_progress: Callable[[str, int, int], None] | None = None
) -> dict[str, Any]:
    """Follow and name everything; writes `metrics.json`, `report.md`, `recordings.csv` and plots, returns the metrics.

    `on_progress` is told the recording at hand, its number and how many there are. Raises `ValueError` for suites
    without recordings and for recordings that Tagview does not apply to.
    """
    folder.mkdir(parents=True, exist_ok=True)
    todo = [
        one
        for suite in config.suites
        for one in find_recordings(config.recordings_dir, suite, config.split, config.max_recordings)
    ]
    tracer = TagviewTracer(dataclasses.replace(config.system, memory_s=1e9))
    found: dict[str, dict[str, list[Judged]]] = {}
    pixel_mm, rows = [], 0
    for number, (group, path) in enumerate(todo):
        recording = open_recording(path)
        if on_progress is not None:
            on_progress(recording.name, number, len(todo))
        reason = tracer.inapplicable(recording)
        if reason is not None:
            raise ValueError(f"{recording.name}: Tagview does not apply: {reason}")
        seen = watch(tracer, recording)
        judged = judge_all(config, tracer, recording, seen)
        for name, one in judged.items():
            found.setdefault(group, {}).setdefault(name, []).append(one)
        pixel_mm.append(seen.mm_px)
        rows = recording.image_shape[0]
        if number == 0:
            track_plot(folder / "tracks.png", seen, np.asarray(recording.colour[0]))
    metrics = _metrics(config, found, float(np.mean(pixel_mm)), rows)
    whole = [one for group in found.values() for one in group[config.complete]]
    pair_plot(folder / "pairs.png", [one for one in whole if not one.recording.startswith("half_wavelength")])
    accuracy = accuracy_by_tags(found)
    if accuracy:
        accuracy_plot(folder / "accuracy.png", accuracy)
    _write_rows(folder / "recordings.csv", found)
    write_json(folder / "metrics.json", metrics)
    (folder / "report.md").write_text(table(metrics))
    return metrics


def judge_all(
    config: TagviewExperiment, tracer: TagviewTracer, recording: Recording, seen: Watched
) -> dict[str, Judged]:
    """The recording named with every setting."""
    truth = recording.truth
    assert truth is not None
    depth_m = float(np.nanmedian([np.nanmedian(truth.tag_position_m[epc][:, 2]) for epc in seen.epcs]))
    carrier_hz = float(np.nanmedian(recording.reads.carrier_hz))
    true_slope = 4 * np.pi * depth_m * carrier_hz / SPEED_OF_LIGHT_M_S
    least = max(round(config.system.least_trace_s * recording.frame_rate_hz), 1)
    return {
        name: judge(seen, tracer, way.match, way.reads, least_frames=least, true_slope=true_slope)
        for name, way in config.matching.items()
    }


def accuracy_by_tags(found: Mapping[str, Mapping[str, Sequence[Judged]]]) -> dict[str, dict[int, float]]:
    """Accuracy of each setting by number of tags, over the suites named ceiling_*."""
    out: dict[str, dict[int, list[Judged]]] = {}
    for group, settings in found.items():
        if group.startswith("ceiling_"):
            for name, judged in settings.items():
                for one in judged:
                    out.setdefault(name, {}).setdefault(one.num_tags, []).append(one)
    return {
        name: {count: value for count, judged in counts.items() if (value := summarise(judged)["accuracy"]) is not None}
        for name, counts in out.items()
    }


def _metrics(
    config: TagviewExperiment, found: Mapping[str, Mapping[str, Sequence[Judged]]], mm_px: float, rows: int
) -> dict[str, Any]:
    groups = {
        group: {name: summarise(judged) for name, judged in settings.items()} for group, settings in found.items()
    }
    tables = [group for group in found if group.startswith("ceiling_")]
    if tables:
        groups["ceiling, all"] = {
            name: summarise([one for group in tables for one in found[group][name]]) for name in config.matching
        }
    whole = [one for settings in found.values() for one in settings[config.complete]]
    errors = np.concatenate([one.error_px for one in whole])
    like = [one for one in whole if not one.recording.startswith("half_wavelength")]
    error_px, std_px = (float(x) if len(errors) else 0.0 for x in (errors.mean(), errors.std()))
    return {
        "paper": PAPER,
        "complete": config.complete,
        "groups": groups,
        "tracking": {"error_px": error_px, "std_px": std_px, "error_mm": error_px * mm_px, "height_px": rows},
        "pairs": {kind: quartiles(like, kind) for kind in ("r_squared", "slope")},
    }


def _write_rows(path: Path, found: Mapping[str, Mapping[str, Sequence[Judged]]]) -> None:
    names = ("num_tags", "num_traces", "num_false", "num_right", "num_named", "num_stretches", "num_found", "gap")
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("group", "setting", "recording", *names, "error_px"))
        for group, settings in found.items():
            for name, judged in settings.items():
                for one in judged:
                    error = f"{one.error_px.mean():.3f}" if len(one.error_px) else ""
                    writer.writerow((group, name, one.recording, *(getattr(one, key) for key in names), error))


def train_tagview(
    config: TagviewExperiment, folder: Path, *, on_step: Callable[[int, float], None] | None = None
) -> dict[str, Any]:
    """Train the detector on the suites' train split, measure it on the validation split, write its weights.

    Raises `ValueError` for suites without train recordings; those without validation are left out of the measure.
    """
    training, settings = config.training, config.training.recipe
    frames, measured, used = [], [], {}
    for suite in config.suites:
        paths = find_recordings(config.recordings_dir, suite, "train", config.max_recordings)
        used[suite] = len(paths)
        for _, path in paths:
            frames += labelled_frames(open_recording(path), every=settings.every, least_side_px=settings.least_side_px)
        for path in sorted((Path(config.recordings) / suite / "validation").glob("*.zarr")):
            measured += labelled_frames(
                open_recording(path), every=training.measure_every, least_side_px=settings.least_side_px
            )
    network, recipe = train_detector(frames, settings, on_step=on_step)
    chosen = dataclasses.replace(config.system.detector, kind="ssd")
    scores = measure_detector(BoxDetector(network, chosen), measured) if measured else {}
    about = {
        "network": {"widths": list(settings.widths), "depth": settings.depth},
        "recipe": recipe,
        "data": {"train recordings": used, "validation frames": len(measured)},
        "validation": {name: value for name, value in scores.items() if np.isfinite(value)},
    }
    save_detector(folder / training.weights, network, about)
    write_json(folder / "training.json", about)
    return about
