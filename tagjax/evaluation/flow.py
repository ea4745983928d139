"""Comparison of flows on the same pairs: scores against truth and against the pictures, tables, and panels."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich.box import SIMPLE
from rich.table import Table

from ..core.files import write_atomic
from ..core.machine import machine
from ..core.names import safe_file_name
from ..core.progress import progress_lines
from ..core.results import write_json
from ..flow.flying_chairs import is_flying_chairs
from ..flow.opencv import FlowFunction
from ..flow.registry import flow_key, make_flow, split_suffixes
from ..metrics.flow import FlowScores, endpoint_error, warped_error
from ..recording.image_files import write_image
from ..report.flow import flow_panel
from ..sim.flow_pairs import FlowPairSettings
from .flow_cases import (
    FlowCase,
    Material,
    chairs_material,
    drawn_material,
    folder_material,
    recording_material,
    sequence_material,
)

_COLUMNS = {
    "epe_px": "EPE px",
    "epe_visible_px": "visible",
    "epe_hidden_px": "hidden",
    "epe_moving_px": "moving",
    "epe_still_px": "still",
    "above_1px": "> 1 px %",
    "above_3px": "> 3 px %",
    "above_5px": "> 5 px %",
    "fl": "Fl %",
    "warped_levels": "warped",
    "median_ms": "ms",
}
_FRACTIONS = ("above_1px", "above_3px", "above_5px", "fl")
_LARGEST_PX, _LARGEST_LEVELS = 3.0, 32.0
"""Errors from these on are white in the panels."""


@dataclasses.dataclass(frozen=True)
class FlowEvaluationSettings:
    """Which flows are compared, and on which pairs."""

    flows: tuple[str, ...] = ("zero", "dis_ultrafast", "dis_fast", "dis")
    num_pairs: int = 64  # synthetic pairs; 0 for none
    pair_seed: int = 2_000_003  # differs from the seeds of training and validation
    photographs: bool = False  # photographs of installed packages on synthetic layers; they may differ between machines
    pairs: FlowPairSettings = dataclasses.field(default_factory=FlowPairSettings)
    recordings: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()  # in Middlebury's format, or of FlyingChairs
    sequences: tuple[str, ...] = ()  # videos and folders of pictures, without truth
    every: int = 5  # of recordings and sequences, every n-th picture and the next
    max_pairs: int = 40  # of one recording, sequence or folder of FlyingChairs
    moving_px: float = 0.5
    num_panels: int = 4  # of each material
    cache: str = "recordings"  # for decoded videos
    progress: bool = True

    def __post_init__(self) -> None:
        if not self.flows:
            raise ValueError("flows is empty; expected at least one, for example flows=[dis,pyramid].")
        if self.num_pairs < 1 and not (self.recordings or self.folders or self.sequences):
            raise ValueError(
                "Nothing to evaluate on: found num_pairs=0 and no recordings, folders or sequences; expected at least one of them."
            )
        for name, minimum in (("num_pairs", 0), ("every", 1), ("max_pairs", 1), ("num_panels", 0)):
            if getattr(self, name) < minimum:
                raise ValueError(f"{name} is {getattr(self, name)}; expected at least {minimum}.")

    def materials(self) -> list[Material]:
        """The data that flows are evaluated on. Raises `RecordingError` for a path that cannot be opened."""
        materials = []
        if self.num_pairs:
            photographs = None
            if self.photographs:
                from ..training.flow_sources import installed_photographs, photograph_stack

                photographs = photograph_stack(installed_photographs(), self.pair_seed)
            materials.append(drawn_material(self.pairs, self.num_pairs, seed=self.pair_seed, photographs=photographs))
        if self.recordings:
            materials.append(recording_material(self.recordings, every=self.every, max_pairs=self.max_pairs))
        materials += [
            chairs_material(path, max_pairs=self.max_pairs) if is_flying_chairs(Path(path)) else folder_material(path)
            for path in self.folders
        ]
        if self.sequences:
            materials.append(
                sequence_material(self.sequences, Path(self.cache), every=self.every, max_pairs=self.max_pairs)
            )
        return materials


def evaluate_flows(settings: FlowEvaluationSettings, folder: Path) -> dict[str, Any]:
    """Score every flow on every case; `folder` then holds metrics.json, flow.md and panels/.

    The summary: of each material and flow the scores of all its pixels (`all`), those of each source, and the mean over
    sources of their end-point errors. Raises `ValueError` for unknown flows and for unreadable data. After an error, and
    on Ctrl-C, unfinished.json and unfinished.md hold the scores of the cases done so far, and the last case.
    """
    names = _labels(settings.flows)
    flows = {label: make_flow(name) for label, name in names.items()}
    materials = settings.materials()
    summary: dict[str, Any] = {
        "flows": {label: flow_key(name) for label, name in names.items()},
        "machine": machine(),
        "materials": {},
    }
    with progress_lines(shown=settings.progress) as report:
        for material in materials:
            scored = _Scored(flows, settings)
            panel_numbers = set(
                np.linspace(0, material.num_cases - 1, settings.num_panels).round().astype(int).tolist()
            )
            done = 0
            try:
                for number, case in enumerate(material.cases()):
                    report(material.name, done, material.num_cases)
                    scored.add(case, folder / "panels" if number in panel_numbers else None)
                    done += 1
            except BaseException as error:
                if done:
                    summary["materials"][material.name] = scored.result()
                if summary["materials"]:
                    ended = f"{done} of {material.num_cases} cases of {material.name} were scored when it ended"
                    summary["unfinished"] = f"{ended} ({type(error).__name__}: {error})."
                    _write(summary, folder, "unfinished.json", "unfinished.md")
                    error.add_note(f"The scores of the finished cases are in {folder / 'unfinished.md'}.")
                raise
            report(material.name, done, material.num_cases)
            summary["materials"][material.name] = scored.result()
    _write(summary, folder, "metrics.json", "flow.md")
    for name in ("unfinished.json", "unfinished.md"):  # from an earlier call
        (folder / name).unlink(missing_ok=True)
    return summary


def _write(summary: Mapping[str, Any], folder: Path, numbers: str, tables: str) -> None:
    write_json(folder / numbers, summary)
    write_atomic(folder / tables, markdown(summary))


def _labels(names: Sequence[str]) -> dict[str, str]:
    """Short names of flows: weights by the name of their file, or by the whole path where two files have the same name."""
    short = []
    for name in names:
        flow, suffixes = split_suffixes(name)
        variant, colon, path = flow.rpartition(":")
        stem = Path(path).stem if Path(path).suffix == ".safetensors" else path
        short.append(variant + colon + stem + suffixes)
    return {stem if short.count(stem) == 1 else name: name for stem, name in zip(short, names, strict=True)}


class _Scored:
    """Scores of several flows on the cases of one material."""

    def __init__(self, flows: Mapping[str, FlowFunction], settings: FlowEvaluationSettings):
        self._flows, self._settings = flows, settings
        self._scores: dict[str, dict[str, FlowScores]] = {name: {} for name in flows}
        self._ms: dict[str, list[float]] = {name: [] for name in flows}
        self._shapes: set[tuple[int, ...]] = set()

    def add(self, case: FlowCase, panels: Path | None) -> None:
        """Score all flows on a case, and draw them if there is a folder for it."""
        predicted = {name: self._call(name, case) for name in self._flows}
        self._shapes.add(case.first.shape)
        for name, flow in predicted.items():
            score = FlowScores.of_pictures(case.first, case.second, flow)
            if case.truth_px is not None:
                moving_px = self._settings.moving_px
                score = score.merge(FlowScores.of_truth(flow, case.truth_px, case.occluded, moving_px=moving_px))
            kept = self._scores[name]
            kept[case.source] = kept.get(case.source, FlowScores()).merge(score)
        if panels is not None:
            write_image(panels / f"{safe_file_name(case.label)}.png", _panel(case, predicted))

    def _call(self, name: str, case: FlowCase) -> np.ndarray:
        start = time.perf_counter()
        flow = np.asarray(jax.block_until_ready(self._flows[name](case.first, case.second)))
        # The first call of a size includes compilation.
        if case.first.shape in self._shapes:
            self._ms[name].append(1e3 * (time.perf_counter() - start))
        return flow

    def result(self) -> dict[str, Any]:
        results: dict[str, Any] = {}
        for name, sources in self._scores.items():
            total = FlowScores()
            for score in sources.values():
                total = total.merge(score)
            each = {source: score.result() for source, score in sources.items()}
            errors = [scores["epe_px"] for scores in each.values() if scores.get("epe_px") is not None]
            results[name] = {
                "all": {**total.result(), "median_ms": float(np.median(self._ms[name])) if self._ms[name] else None},
                "mean_epe_px": float(np.mean(np.asarray(errors, float))) if errors else None,
                "sources": each,
            }
        return results


def _panel(case: FlowCase, flows: Mapping[str, np.ndarray]) -> np.ndarray:
    truth = case.truth_px
    if truth is not None:
        errors = {name: endpoint_error(flow, truth) for name, flow in flows.items()}
    else:
        parts = {name: warped_error(case.first, case.second, flow) for name, flow in flows.items()}
        errors = {name: np.where(inside, error, np.nan) for name, (error, inside) in parts.items()}
    unit, largest = ("px", _LARGEST_PX) if truth is not None else ("levels", _LARGEST_LEVELS)
    return flow_panel(case.first, case.second, truth, flows, errors, largest_error=largest, unit=unit)


def _rows(scores: Mapping[str, Any]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of one material's scores; columns without any value are left out."""
    shown = [key for key in _COLUMNS if any(flow["all"].get(key) is not None for flow in scores.values())]
    rows = [[name, *(_text(key, flow["all"].get(key)) for key in shown)] for name, flow in scores.items()]
    return ["flow", *(_COLUMNS[key] for key in shown)], rows


def _source_rows(scores: Mapping[str, Any]) -> tuple[list[str], list[list[str]]] | None:
    """Headings and rows of end-point errors by source; None for a single one, or without truth."""
    sources = list(next(iter(scores.values()))["sources"])
    if not 2 <= len(sources) <= 8 or all(flow["mean_epe_px"] is None for flow in scores.values()):
        return None
    rows = [
        [
            name,
            *(_text("epe_px", flow["sources"][source].get("epe_px")) for source in sources),
            _text("epe_px", flow["mean_epe_px"]),
        ]
        for name, flow in scores.items()
    ]
    return ["EPE px", *sources, "mean"], rows


def _text(key: str, value: float | None) -> str:
    if value is None:
        return "-"
    if key in _FRACTIONS:
        return f"{100 * value:.1f}"
    return f"{value:.1f}" if key in ("warped_levels", "median_ms") else f"{value:.3f}"


def _tables(summary: Mapping[str, Any]) -> list[tuple[str, list[str], list[list[str]]]]:
    tables = []
    for material, scores in summary["materials"].items():
        tables.append((material, *_rows(scores)))
        if (by_source := _source_rows(scores)) is not None:
            tables.append((f"{material}, by source", *by_source))
    return tables


def flow_tables(summary: Mapping[str, Any]) -> list[Table]:
    """The scores as tables for a terminal, one or two per material."""
    tables = []
    for title, headings, rows in _tables(summary):
        table = Table(title=title, box=SIMPLE, pad_edge=False)
        for number, heading in enumerate(headings):
            widest = max(len(heading), *(len(row[number]) for row in rows))
            table.add_column(heading, justify="right" if number else "left", no_wrap=True, min_width=widest)
        for row in rows:
            table.add_row(*row)
        tables.append(table)
    return tables


def markdown(summary: Mapping[str, Any]) -> str:
    """The same tables as Markdown, after a note if not all cases were scored."""
    parts = [f"**Unfinished**: {summary['unfinished']}\n"] if "unfinished" in summary else []
    for title, headings, rows in _tables(summary):
        lines = [headings, ["---", *["---:"] * (len(headings) - 1)], *rows]
        parts.append(f"**{title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n")
    return "\n".join(parts)
