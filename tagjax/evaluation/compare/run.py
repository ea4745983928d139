"""A comparison of systems on suites (simulated where missing); the table is written as Markdown, CSV, JSON and a figure."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from rich.box import SIMPLE
from rich.table import Table
from rich.text import Text

from ...core.files import write_atomic
from ...core.progress import OnProgress, unobserved
from ...core.results import write_json
from ...core.settings import ConfigError
from ...metrics.recordings import RecordingResult, ScoreSettings, score_traces
from ...metrics.tags import Scores
from ...recording import Recording, RecordingError
from ...recording.store import open_recording
from ...report.comparison import bar_plot
from ...sim.suites import PLANAR, Item
from ...tracing.tracer import Trace
from ..suite_items import SuiteSelection
from .systems import NAMES, Systems, SystemSettings
from .table import LEGEND, MEASURES, SHORT_HEADINGS, Cell, bars, format_value, markdown, write_cells

Detections = tuple[np.ndarray, np.ndarray]
"""Of every tag at one frame: its estimated position in metres (tag, 3), and whether it is detected (tag,)."""

_STATIONARY_M = 0.05
"""A tag that never moves further than this from its median position is stationary."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class CompareConfig(SuiteSelection):
    """The systems and the suites."""

    lines_allowed = True  # their cells give the reason why nothing is compared

    systems: SystemSettings
    only: tuple[str, ...] = NAMES
    published: Mapping[str, Mapping[str, str]] = dataclasses.field(
        default_factory=dict
    )  # results of the papers, by suite and system
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if unknown := sorted(set(self.only) - set(NAMES)):
            raise ConfigError(f"only: found {', '.join(unknown)}; expected some of {', '.join(NAMES)}.")
        if unknown := sorted({name for systems in self.published.values() for name in systems} - set(NAMES)):
            raise ConfigError(
                f"published: found {', '.join(unknown)}; expected some of {', '.join(NAMES)} below each suite."
            )


@dataclasses.dataclass
class _Tally:
    """Accumulated results of the recordings of a cell."""

    scores: Scores = dataclasses.field(default_factory=Scores)
    error_m: list[np.ndarray] = dataclasses.field(default_factory=list)
    false_alarms: list[np.ndarray] = dataclasses.field(default_factory=list)
    frame_ms: list[float] = dataclasses.field(default_factory=list)
    num: int = 0


def run_comparison(config: CompareConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> list[Cell]:
    """Every system on every suite; writes table.md, table.csv, table.json and comparison.png after each suite."""
    folder.mkdir(parents=True, exist_ok=True)
    systems, cells = Systems(config.systems, config.scores), list[Cell]()
    items, done = config.all_items(on_progress), 0
    total = sum(map(len, items.values())) * len(config.only)
    for name in config.suites:
        for system in config.only:
            cell = _cell(systems, system, name, items[name], config, _counter(on_progress, done, total))
            done += len(items[name])
            cells.append(dataclasses.replace(cell, paper=config.published.get(name, {}).get(system)))
        _write(folder, cells)
    on_progress("trace", total, total)
    return cells


def _counter(on_progress: OnProgress, before: int, total: int) -> Callable[[int, str], None]:
    """Reports the number of a cell's recording, after `before` recordings of other cells."""
    return lambda number, now: on_progress("trace", before + number, total, now)


def _cell(
    systems: Systems,
    system: str,
    suite: str,
    items: Sequence[Item],
    config: CompareConfig,
    report: Callable[[int, str], None],
) -> Cell:
    if items[0].suite.story == PLANAR:
        return Cell(suite, system, reason="no pictures: lines only")
    tally, reason = _Tally(), None
    for number, item in enumerate(items):
        report(number, f"{system}: {item.name}")
        recording = open_recording(item.path(Path(config.recordings_dir)))
        try:
            _score(systems, system, item, recording, config.scores, tally)
        except (RecordingError, ValueError) as error:
            # A failure on one of many recordings would leave a mean over fewer recordings than the other cells have.
            if tally.num or isinstance(error, ConfigError):
                raise
            reason = str(error).removeprefix(f"{recording.name}: ")
            break
    if not tally.num:
        return Cell(suite, system, reason=reason)
    scores = tally.scores.result()
    arrays = [np.concatenate(parts) if parts else np.zeros(0) for parts in (tally.error_m, tally.false_alarms)]
    error_m, false_alarms = (part[np.isfinite(part)] for part in arrays)
    return Cell(
        suite,
        system,
        tally.num,
        int(scores["num_frames"] or 0),
        scores.get("identification"),
        scores.get("iou"),
        scores.get("cle_px"),
        float(np.median(error_m)) * 1e3 if len(error_m) else None,
        scores.get("p_d"),
        float(np.mean(false_alarms)) if len(false_alarms) else None,
        float(np.median(tally.frame_ms)),
        settings=systems.settings_label(system),
    )


def _score(
    systems: Systems, system: str, item: Item, recording: Recording, settings: ScoreSettings, tally: _Tally
) -> None:
    epcs = recording.resolve_epcs(None)
    elapsed_s: list[float] = []
    detections: list[Detections] = []
    traces = _timed(systems.traces(system, item, recording, epcs), elapsed_s, detections)
    quiet = dataclasses.replace(settings, num_pictures=1)
    result = score_traces(traces, recording, epcs, stride=systems.stride(system), settings=quiet)
    tally.scores = tally.scores.merge(result.scores())
    tally.num += 1
    # The first piece includes compilation and fills caches.
    first = min(settings.frames_at_once, len(elapsed_s) // 2)
    tally.frame_ms.append(1e3 * float(np.mean(elapsed_s[first:])))
    _tally_positions(result, epcs, detections, tally)


def _tally_positions(
    result: RecordingResult, epcs: Sequence[str], detections: Sequence[Detections], tally: _Tally
) -> None:
    """Position errors of the labelled tags, and detections of stationary tags, most of which are not labelled."""
    truth = result.recording.truth
    position_m, detected = (np.stack(parts) for parts in zip(*detections, strict=True))
    for tag, epc in enumerate(epcs):
        if truth is None or epc not in truth.tag_position_m:
            continue
        true_m = np.asarray(truth.tag_position_m[epc], np.float64)
        known_m = true_m[np.isfinite(true_m).all(axis=-1)]
        if len(known_m) and np.linalg.norm(known_m - np.median(known_m, axis=0), axis=-1).max() < _STATIONARY_M:
            tally.false_alarms.append(detected[:, tag].astype(np.float64))
        frames = result.frames.get(epc)
        if frames is not None:
            distance_m = np.linalg.norm(position_m[:, tag] - true_m, axis=-1)
            tally.error_m.append(distance_m[frames.valid & frames.detected])


def _timed(
    traces: Iterator[tuple[int, Trace]], elapsed_s: list[float], detections: list[Detections]
) -> Iterator[tuple[int, Trace]]:
    """The same traces; appends the computing time and the detections of each to the lists."""
    while True:
        start_s = time.perf_counter()
        item = next(traces, None)
        if item is None:
            return
        elapsed_s.append(time.perf_counter() - start_s)
        detections.append((np.asarray(item[1].centre_m, np.float64), np.asarray(item[1].detected, bool)))
        yield item


def console_table(cells: Iterable[Cell]) -> Table:
    """The table for a terminal of 80 columns, with the reasons of missing results, the papers' results and the legend below."""
    cells = list(cells)
    table = Table(box=SIMPLE, show_edge=False, padding=0)
    for name in ("suite", "system"):
        table.add_column(name, no_wrap=True)
    for name in SHORT_HEADINGS:
        table.add_column(name, no_wrap=True, justify="right")
    reasons: list[str] = []
    for cell in cells:
        values = [format_value(getattr(cell, measure), measure) for measure in MEASURES]
        if cell.reason is not None:
            if cell.reason not in reasons:
                reasons.append(cell.reason)
            values = [f"({reasons.index(cell.reason) + 1})", *[""] * (len(MEASURES) - 1)]
        table.add_row(cell.suite, cell.system, *values)
    suites_by_settings: dict[tuple[str, str], list[str]] = {}
    for cell in cells:
        if cell.settings is not None:
            suites_by_settings.setdefault((cell.system, cell.settings), []).append(cell.suite)
    below = [f"({number}) does not apply: {reason}" for number, reason in enumerate(reasons, 1)]
    below += [
        f"{system} ({settings}): {', '.join(suites)}" for (system, settings), suites in suites_by_settings.items()
    ]
    below += [
        f"{cell.system}, result of its paper, {cell.suite}: {cell.paper}" for cell in cells if cell.paper is not None
    ]
    table.caption = Text("\n".join([*below, *LEGEND]))
    table.caption_justify = "left"
    return table


def _write(folder: Path, cells: list[Cell]) -> None:
    write_atomic(folder / "table.md", markdown(cells) + "\n")
    write_cells(folder / "table.csv", cells)
    write_json(folder / "table.json", [dataclasses.asdict(cell) for cell in cells])
    bar_plot(
        folder / "comparison.png", {"identification": bars(cells, "identification"), "box IoU": bars(cells, "iou")}
    )
