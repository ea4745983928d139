"""What a search by Optuna has found: a table of its trials, how much each parameter matters, and pictures of both.

Needs the sweep and viz extras.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..core.files import write_atomic
from ..core.results import markdown_table, write_csv
from ..report.study import Trial, importance_bars, parallel_coordinates
from ..report.sweep import value_text

_MAX_ROWS = 10  # of the table; the CSV file has all
_MIN_TRIALS = 4  # fewer say nothing of importance


def write_study(storage: str, name: str, folder: Path) -> bool:
    """Write the report of the finished trials; false where there is none to write of."""
    import optuna  # pyright: ignore[reportMissingImports]  # of the sweep extra

    study = optuna.load_study(study_name=name, storage=storage)
    done = [one for one in study.trials if one.state is optuna.trial.TrialState.COMPLETE]
    if not done:
        return False
    largest_first = study.direction is optuna.study.StudyDirection.MAXIMIZE
    trials = [Trial(one.number, one.value, one.params) for one in done if one.value is not None]
    trials.sort(key=lambda one: one.value, reverse=largest_first)
    names = sorted({name for one in trials for name in one.parameters})
    logs = optuna.distributions.LogUniformDistribution, optuna.distributions.IntLogUniformDistribution
    logarithmic = {name for one in done for name, space in one.distributions.items() if isinstance(space, logs)}
    folder.mkdir(parents=True, exist_ok=True)
    _write_tables(folder, trials, names)
    parallel_coordinates(folder / "parallel.png", trials, names, logarithmic)
    if len(trials) >= _MIN_TRIALS and len(names) > 1:
        # The other two evaluators do not run with today's NumPy and scikit-learn.
        evaluator = optuna.importance.MeanDecreaseImpurityImportanceEvaluator(seed=0)
        importance = optuna.importance.get_param_importances(study, evaluator=evaluator)
        importance_bars(folder / "importance.png", dict(importance))
    return True


def _write_tables(folder: Path, trials: Sequence[Trial], names: Sequence[str]) -> None:
    headings = ["trial", "score", *names]
    rows = [[one.number, one.value, *(one.parameters.get(name) for name in names)] for one in trials]
    write_csv(folder / "trials.csv", headings, rows)
    cells = [[str(number), f"{score:.4f}", *map(_short, given)] for number, score, *given in rows[:_MAX_ROWS]]
    write_atomic(folder / "trials.md", markdown_table(headings, cells) + "\n")


def _short(value: Any) -> str:
    if value is None:
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else value_text(value)
