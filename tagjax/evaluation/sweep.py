"""A grid of a tracer's parameters over suites, or one parameter at a time: IoU, a table, a picture, and the best point.

TagAttention (ToN 2021), Fig. 17 is such a sweep: v0 at 0.01, 0.1 and 0.5 m/s, for a slow and for a fast object. Every
recording at every point is a line of a file, so that an interrupted sweep can be resumed.
"""

from __future__ import annotations

import dataclasses
import difflib
import itertools
import json
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..core.files import write_atomic, writing
from ..core.progress import OnProgress, unobserved
from ..core.results import markdown_table, to_json_values, write_csv
from ..core.settings import ConfigError, changed, from_mapping
from ..metrics.interval import ratio_estimate
from ..metrics.recordings import RecordingResult, ScoreSettings, evaluate_recording
from ..recording.store import open_recording
from ..report.sweep import curve_panels, one_at_a_time_panels, parameter_panels, value_text
from ..sim.suites import SPLITS, Item, Suite, make_items
from ..tagattention.tracer_settings import make_tracer, named_settings, tracer_clips, with_values
from ..tracing.clips import ClipSettings, clip_loader
from .estimate_text import estimate_text
from .suite_items import result_key

_MAX_NAMES = 12  # of parameters in an error
_MAX_CONDITIONS = 4  # in the columns of table.md; table.csv has all
_MAX_CURVES = 6
"""Up to this many points are plotted as one curve each; more are plotted by parameter."""

_LINES = "lines.jsonl"

Value = int | float | str | bool
"""A parameter's value; integers and strings keep their type."""


@dataclasses.dataclass(frozen=True)
class SweepConfig:
    """The grid and the suites; `suites` holds the settings of each suite by name, as in the files of conf/suite."""

    suites: Mapping[str, Mapping[str, Any]]
    tracer: Mapping[str, Any]
    grid: Mapping[str, tuple[Value, ...]]  # values of the tracer's parameters
    one_at_a_time: bool = False  # each value with the tracer's own of the other parameters; else all combinations
    runs: tuple[str, ...] = ()  # run folders of experiments.train: from where to where they learned is drawn as well
    clips: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # override the tracer's
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)
    recordings_dir: str = "recordings"
    splits: tuple[str, ...] = ("test",)
    width: int | None = None  # of the simulated pictures; the suite's own if None
    max_recordings: int | None = None  # of each variant and split; all if None
    smoke: bool = False
    workers: int = 1  # processes that simulate what is missing

    def __post_init__(self) -> None:
        if not self.suites:
            raise ConfigError("suites is empty; expected names of suites, for example suites=[velocity_threshold].")
        if unknown := sorted(set(self.splits) - set(SPLITS)):
            raise ConfigError(f"splits: found {', '.join(unknown)}; expected some of {', '.join(SPLITS)}.")
        if not self.grid or not all(self.grid.values()):
            raise ConfigError(
                "grid is empty; expected values of the tracer's parameters, for example 'grid={v0_m_s:[0.01,0.1,0.5]}'."
            )
        if self.runs and not self.one_at_a_time:
            raise ConfigError(
                "runs are drawn over a sweep of one parameter at a time; set one_at_a_time=true, or runs=[]."
            )
        known = named_settings(self.tracer)
        if unknown := sorted(set(self.grid) - set(known)):
            near = sorted(known if len(known) <= _MAX_NAMES else difflib.get_close_matches(unknown[0], known, 5, 0.0))
            raise ConfigError(
                f"grid: found {', '.join(unknown)}; expected parameters of the tracer, some of {', '.join(near)}"
                f"{'.' if len(near) == len(known) else ', ... (conf/tracer has all).'}"
            )

    def clip_settings(self) -> ClipSettings:
        """The clip settings of the tracer's configuration, overridden by `clips`."""
        return changed(tracer_clips(self.tracer), self.clips, where="clips")

    def own(self) -> dict[str, Value]:
        """The tracer's own values of the grid's parameters."""
        known = named_settings(self.tracer)
        return {name: known[name] for name in self.grid}

    def points(self) -> list[dict[str, Value]]:
        """Every combination of the grid's values; or the tracer's own, and those that differ from it in one."""
        if self.one_at_a_time:
            own = self.own()
            others = [{**own, name: value} for name, values in self.grid.items() for value in values]
            return [own, *(point for point in others if point != own)]
        return [dict(zip(self.grid, values, strict=True)) for values in itertools.product(*self.grid.values())]


@dataclasses.dataclass(frozen=True)
class Line:
    """One recording at one point of the grid."""

    key: str  # hash of everything that determines the results
    condition: str  # suite and variant
    recording: str
    point: Mapping[str, Value]
    numbers: Mapping[str, float | int | None]
    iou: tuple[float | None, ...]  # by frame, mean over visible tags; no detection counts as 0


def run_sweep(config: SweepConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> list[Line]:
    """The lines of all recordings at all points; `folder` then holds them, table.md, table.csv and sweep.png.

    Lines that the folder holds already are not computed again. `on_progress` counts the lines.
    """
    folder.mkdir(parents=True, exist_ok=True)
    learned_ways(config)  # a folder that is no run's raises before the work starts
    points, clips = config.points(), config.clip_settings()
    tracers = [
        make_tracer(with_values(config.tracer, point)) for point in points
    ]  # a wrong value raises before the work starts
    work = [
        item
        for name, values in config.suites.items()
        for item in _items(config, _suite(config, from_mapping(Suite, values, where=f"suite {name}")), on_progress)
    ]
    known = {line.key: line for line in read_lines(folder / _LINES)}
    lines: list[Line] = []
    for item in work:
        keys = [_key(config, item, point) for point in points]
        if all(key in known for key in keys):
            lines += [known[key] for key in keys]
            continue
        recording = open_recording(item.path(Path(config.recordings_dir)))
        load = _caching_loader(clips)
        for key, point, tracer in zip(keys, points, tracers, strict=True):
            on_progress("trace", len(lines), len(work) * len(points), f"{item.name} {point_name(point)}")
            if key not in known:
                settings = dataclasses.replace(config.scores, num_pictures=1)
                result = evaluate_recording(
                    tracer, recording, load, stride=clips.stride, epcs=clips.epcs, settings=settings
                )
                known[key] = Line(key, _condition(item), item.name, point, result.scores().result(), frame_iou(result))
                _append(folder / _LINES, known[key])
            lines.append(known[key])
    on_progress("trace", len(lines), len(lines))
    write_sweep(folder, config, lines)
    return lines


def _suite(config: SweepConfig, suite: Suite) -> Suite:
    suite = suite.smoke() if config.smoke else suite
    if config.width is None:
        return suite
    return dataclasses.replace(suite, capture=dataclasses.replace(suite.capture, width=config.width))


def _items(config: SweepConfig, suite: Suite, report: OnProgress) -> list[Item]:
    items = make_items(
        suite,
        Path(config.recordings_dir),
        splits=config.splits,
        max_per_variant=config.max_recordings,
        workers=config.workers,
        on_progress=report,
    )
    if not items:
        raise ConfigError(f"{suite.name} has no recording of {', '.join(config.splits)}; choose other splits.")
    return items


def _caching_loader(clips: ClipSettings) -> Callable[..., Any]:
    """A loader that caches the clips, so that they are loaded once for all points of the grid."""
    load_piece, cache = clip_loader(clips), {}

    def load(recording: Any, start: int, stop: int, *, epcs: Sequence[str] | None = None) -> Any:
        key = (recording.reversed_from is None, start, stop, None if epcs is None else tuple(epcs))
        if key not in cache:
            cache[key] = load_piece(recording, start, stop, epcs=epcs)
        return cache[key]

    return load


def _key(config: SweepConfig, item: Item, point: Mapping[str, Value]) -> str:
    return result_key(item, with_values(config.tracer, point), config.clip_settings(), config.scores)[:20]


def _condition(item: Item) -> str:
    return item.suite.name if len(item.suite.variants) == 1 else f"{item.suite.name} {item.variant.name}"


def frame_iou(result: RecordingResult) -> tuple[float | None, ...]:
    """Box IoU of every frame, mean over the visible tags; None where none is visible."""
    frames = list(result.frames.values())
    if not frames:
        return ()
    iou = np.stack([np.where(one.detected, one.iou, 0.0) for one in frames])
    visible = np.stack([one.visible for one in frames])
    count = visible.sum(axis=0)
    mean = (iou * visible).sum(axis=0) / np.maximum(count, 1)
    return tuple(round(float(value), 4) if n else None for value, n in zip(mean, count, strict=True))


def _append(path: Path, line: Line) -> None:
    with writing(path), path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(to_json_values(dataclasses.asdict(line))) + "\n")


def read_lines(path: Path) -> list[Line]:
    """The finished lines of a sweep's file; an incomplete last line is removed."""
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    complete = text[: text.rfind("\n") + 1]
    if complete != text:
        write_atomic(path, complete)
    rows = [json.loads(row) for row in complete.splitlines()]
    return [Line(**{**row, "iou": tuple(row["iou"])}) for row in rows]


def point_name(point: Mapping[str, Value]) -> str:
    """A point of the grid as `name=value` pairs."""
    return ", ".join(f"{name}={value_text(value)}" for name, value in point.items())


def table(lines: Iterable[Line]) -> list[dict[str, Any]]:
    """A row for each point, the best first: mean box IoU over conditions, and IoU and lock of each condition.

    Within a condition every scored frame has the same weight, and every condition has the same weight. `against_best` is the
    `Estimate` of the mean difference from the best point, where every recording has the same weight.
    """
    rows: dict[str, dict[str, Any]] = {}
    groups: dict[tuple[str, str], list[Line]] = {}
    recordings: dict[str, dict[tuple[str, str], float]] = {}  # box IoU of those with a frame that counts
    for line in lines:
        point = point_name(line.point)
        rows.setdefault(point, {**line.point})
        groups.setdefault((point, line.condition), []).append(line)
        iou = recordings.setdefault(point, {})
        if line.numbers["num_frames"]:
            iou[line.condition, line.recording] = float(line.numbers["iou"] or 0.0)
    for (point, condition), ones in groups.items():
        count = sum(int(one.numbers["num_frames"] or 0) for one in ones)
        total = sum(float(one.numbers["iou"] or 0.0) * int(one.numbers["num_frames"] or 0) for one in ones)
        locked = [one.numbers["locked"] for one in ones if one.numbers["locked"] is not None]
        rows[point][f"{condition}: IoU"] = total / count if count else math.nan
        rows[point][f"{condition}: locked"] = float(np.mean(locked)) if locked else math.nan
    for row in rows.values():
        row["IoU"] = float(np.mean([value for name, value in row.items() if name.endswith(": IoU")]))
    ordered = sorted(rows, key=lambda point: -rows[point]["IoU"])
    for point in ordered:
        best, own = recordings[ordered[0]], recordings[point]
        against = np.array([own[name] - best[name] for name in own if name in best])
        rows[point]["against_best"] = ratio_estimate(against, np.ones(len(against), np.int64))
    return [rows[point] for point in ordered]


def learned_ways(config: SweepConfig) -> dict[str, list[tuple[float, float]]]:
    """For each parameter of the grid, the values with which `config.runs` began and ended."""
    ways: dict[str, list[tuple[float, float]]] = {name: [] for name in config.grid}
    for run in config.runs:
        path = Path(run) / "parameters.json"
        if not path.is_file():
            raise ConfigError(f"runs: found no {path}; expected finished run folders of experiments.train.")
        found = json.loads(path.read_text(encoding="utf-8"))
        begun = found.get("untrained") or found.get("initial") or {}
        for name, way in ways.items():
            if name not in begun:
                raise ConfigError(f"runs: {path} has no parameter {name}; expected runs with the same tracer.")
            way.append((begun[name], found["learned"][name]))
    return ways


def write_sweep(folder: Path, config: SweepConfig, lines: Sequence[Line]) -> None:
    """table.csv, table.md and sweep.png."""
    rows = table(lines)
    conditions = list(dict.fromkeys(line.condition for line in lines))
    headings = ["IoU", *(f"{one}: {what}" for one in conditions for what in ("IoU", "locked"))]
    against = [row["against_best"] for row in rows]
    write_csv(
        folder / "table.csv",
        [*config.grid, *headings, "against the best", "low", "high"],
        (
            [*(row[name] for name in (*config.grid, *headings)), one.value, one.low, one.high]
            for row, one in zip(rows, against, strict=True)
        ),
    )
    shown = headings if len(conditions) <= _MAX_CONDITIONS else headings[:1]
    cells = [
        [
            *(value_text(row[name]) for name in config.grid),
            *(f"{row[heading]:.3f}" for heading in shown),
            estimate_text(one, digits=3),
        ]
        for row, one in zip(rows, against, strict=True)
    ]
    write_atomic(folder / "table.md", markdown_table([*config.grid, *shown, "against the best"], cells) + "\n")
    points = config.points()
    if config.one_at_a_time:
        own, ways = config.own(), learned_ways(config)
        around = {
            name: {row[name]: row["against_best"] for row in rows if {**row, name: own[name]}.items() >= own.items()}
            for name in config.grid
        }
        one_at_a_time_panels(folder / "sweep.png", around, own, ways, best_iou=rows[0]["IoU"])
    elif len(points) <= _MAX_CURVES:
        curves = {
            condition: {
                point_name(point): _mean_curve(
                    [one.iou for one in lines if one.condition == condition and one.point == point]
                )
                for point in points
            }
            for condition in conditions
        }
        curve_panels(folder / "sweep.png", curves)
    else:
        best = {
            name: {value: max(row["IoU"] for row in rows if row[name] == value) for value in values}
            for name, values in config.grid.items()
        }
        parameter_panels(folder / "sweep.png", best)


def _mean_curve(ones: Sequence[Sequence[float | None]]) -> np.ndarray:
    """Mean over recordings by frame; NaN where no tag is visible in any."""
    length = max((len(one) for one in ones), default=0)
    padded = np.full((len(ones), length), np.nan)
    for row, one in zip(padded, ones, strict=True):
        row[: len(one)] = [np.nan if value is None else value for value in one]
    count = np.sum(np.isfinite(padded), axis=0)
    return np.where(count > 0, np.nansum(padded, axis=0) / np.maximum(count, 1), np.nan)
