"""Error budgets of tracers on suites: table, figure and results in the run folder."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from ...core.files import write_atomic
from ...core.progress import OnProgress, unobserved
from ...core.results import write_csv, write_json
from ...core.settings import ConfigError
from ...metrics.interval import Estimate, estimates
from ...metrics.recordings import ScoreSettings, score_traces
from ...metrics.tags import Scores
from ...report.intervals import interval_bars
from ..suite_items import SuiteSelection
from .reads import TrueReads
from .swaps import NAMES, make_swaps, swapped_traces
from .table import MEASURES, BudgetRow, markdown

UNCHANGED, TOGETHER = "none", "all"


@dataclasses.dataclass(frozen=True, kw_only=True)
class BudgetConfig(SuiteSelection):
    """The suites, the tracers (settings as under conf/tracer, by name), and the swaps, which are tried alone and together."""

    tracers: Mapping[str, Mapping[str, Any] | None]  # one that is None is left out
    swaps: tuple[str, ...] = NAMES
    true_reads: TrueReads = dataclasses.field(default_factory=TrueReads)
    scores: ScoreSettings = dataclasses.field(default_factory=ScoreSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.tracers.values()):
            raise ConfigError("tracers: found none; expected at least one.")
        if unknown := sorted(set(self.swaps) - set(NAMES)):
            raise ConfigError(f"swaps: found {', '.join(unknown)}; expected some of {', '.join(NAMES)}.")
        if self.scores.smooth:
            raise ConfigError("scores.smooth is true; expected false: an error budget is of online tracing.")

    def combinations(self) -> dict[str, tuple[str, ...]]:
        """Names of the swaps of each row: none, each one, and all where there are several."""
        rows = {UNCHANGED: (), **{name: (name,) for name in self.swaps}}
        return rows | ({TOGETHER: self.swaps} if len(self.swaps) > 1 else {})


def run_budget(config: BudgetConfig, folder: Path, *, on_progress: OnProgress = unobserved) -> list[BudgetRow]:
    """Every tracer with every combination of swaps on every suite.

    Writes table.md, table.csv, result.json and error_budget.png after each recording.
    """
    folder.mkdir(parents=True, exist_ok=True)
    swaps, rows = make_swaps(config.true_reads), list[BudgetRow]()
    quiet = dataclasses.replace(config.scores, num_pictures=0)
    tracers = {name: settings for name, settings in config.tracers.items() if settings is not None}
    items, numbers = config.all_items(on_progress), itertools.count()
    total = sum(map(len, items.values())) * len(tracers) * len(config.combinations())
    for suite in config.suites:
        cells = {(tracer, row): list[Scores]() for tracer in tracers for row in config.combinations()}
        found = list[BudgetRow]()
        for item in items[suite]:
            recording = config.open(item)
            for (tracer, row), scores in cells.items():
                on_progress("trace", next(numbers), total, f"{item.name}: {tracer}, {row}")
                chosen = [swaps[name] for name in config.combinations()[row]]
                traces, epcs, stride = swapped_traces(tracers[tracer], item, recording, chosen, quiet)
                scores.append(score_traces(traces, recording, epcs, stride=stride, settings=quiet).scores())
            found = [_row(suite, tracer, row, scores) for (tracer, row), scores in cells.items()]
            _write(folder, rows + found)
        rows += found
    on_progress("trace", total, total)
    return rows


def _row(suite: str, tracer: str, truth: str, scores: Sequence[Scores]) -> BudgetRow:
    means, undefined = estimates([one.means for one in scores]), Estimate(None, None, None, 0.0, 0, 0)
    return BudgetRow(suite, tracer, truth, {name: means.get(name, undefined) for name in MEASURES})


def _write(folder: Path, rows: list[BudgetRow]) -> None:
    write_atomic(folder / "table.md", markdown(rows) + "\n")
    write_csv(
        folder / "table.csv",
        ["suite", "tracer", "truth", "measure", *(field.name for field in dataclasses.fields(Estimate))],
        (
            [row.suite, row.tracer, row.truth, name, *dataclasses.astuple(estimate)]
            for row in rows
            for name, estimate in row.estimates.items()
        ),
    )
    write_json(folder / "result.json", [dataclasses.asdict(row) for row in rows])
    panels: dict[str, dict[str, dict[str, Estimate]]] = {}
    for row in rows:
        for name, heading in MEASURES.items():
            panel = panels.setdefault(f"{row.tracer}: {heading}", {})
            panel.setdefault(row.suite, {})[row.truth] = row.estimates[name]
    interval_bars(folder / "error_budget.png", panels, columns=len(MEASURES), ylabel="truth in place of")
